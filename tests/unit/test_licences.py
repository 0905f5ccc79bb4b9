"""The package's metadata name the licences of vendored files, and include their texts."""

import json
import re
import tomllib
from pathlib import Path

ROOT = Path(__file__).parents[2]
PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
# Names in texts of licences and notices, and their SPDX identifiers.
NAMED = {
    "Apache-2.0": r"Apache license 2|Apache License\s+Version 2\.0",
    "BSD-3-Clause": r"BSD-3-Clause",
    "ISC": r"and/or distribute this software for any\s+purpose with or without\s+fee",
    "MIT": r"\bMIT\b",
    "MPL-2.0": r"Mozilla Public License,? (Version )?2\.0",
    "others": r"\bBSD-2|\bISC\b|\bL?GPL|General Public|Zlib|Unlicense|CC0|Creative Commons",
}


def records():
    """What is recorded of vendored packages, with its folder."""
    for path in sorted(ROOT.glob("*/*/**/static/vendor/vendored.json")):
        for package in json.loads(path.read_text()):
            yield path.parent, package


def vendored_licences():
    """Files with licences and notices of vendored packages."""
    is_licence = re.compile(r"(LICENSE|NOTICE|COPYING)(\.\w+)?$").search
    return {
        str((folder / name).relative_to(ROOT))
        for folder, package in records()
        for name in package["files"]
        if is_licence(name)
    }


def parts(expression):
    """The operands of AND."""
    return set(expression.split(" AND "))


def test_the_expression_has_the_licence_of_every_vendored_package():
    packages = [package for _, package in records()]
    assert {"swagger-ui-dist", "uplot"} <= {package["package"] for package in packages}
    vendored = set().union(*(parts(package["licence"]) for package in packages))
    assert parts(PROJECT["license"]) == {"Apache-2.0"} | vendored


def test_texts_of_all_vendored_licences_are_in_the_wheel():
    matched = {
        str(path.relative_to(ROOT)) for glob in PROJECT["license-files"] for path in ROOT.glob(glob)
    }
    assert matched == {"LICENSE"} | vendored_licences()


def test_each_record_has_the_licences_that_the_texts_name():
    for folder, package in records():
        names = [name for name in package["files"] if "LICENSE" in name]
        text = "\n".join((folder / name).read_text() for name in names)
        found = {name for name, pattern in NAMED.items() if re.search(pattern, text)}
        recorded = set(re.findall(r"[\w.-]+", package["licence"])) - {"AND", "OR"}
        assert recorded == found, package["package"]
