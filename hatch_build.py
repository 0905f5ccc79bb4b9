"""Build hook of the wheel: `services` is installed as `dextouch_services`, without weights.

A top-level package called `services` would collide with those of other distributions
(docs/decisions/0022-name-of-the-services-in-a-wheel.md). Checkouts and editable installations keep
the name of the folder. Weights are a wheel of their own, which extras with networks ask for
(docs/decisions/0024-weights-in-a-wheel-of-their-own.md).
"""

import io
import re
import shutil
import tempfile
import tokenize
import tomllib
from pathlib import Path
from typing import Any

from hatchling.builders.hooks.plugin.interface import BuildHookInterface

FOLDER, INSTALLED = "services", "dextouch_services"
# A module named in a string, such as "services.cli.main:main" or in a docstring.
# From Python 3.12 on, the text of an f-string ends before its first expression.
_IN_STRING = re.compile(r"(?<![\w./])services(?=\.(?:[a-z_{]|\Z))")
WEIGHTS = ".safetensors"
# Extras with this distribution read weights.
_READER = "safetensors"
_STRINGS = ("STRING", "FSTRING_MIDDLE")


def installed_source(source: str) -> str:
    """Source code that imports and names the modules of `services` as those of the wheel.

    Raises:
        ValueError: the package is used by an expression such as `services.twin`, which would have
            to be told apart from other variables.
    """
    lines = source.splitlines(keepends=True)
    imports_package = re.search(rf"^\s*import {FOLDER}\b", source, re.MULTILINE) is not None
    edits: list[tuple[tuple[int, int], tuple[int, int], str]] = []
    before = ""
    for token in tokenize.generate_tokens(io.StringIO(source).readline):
        text = token.string
        if tokenize.tok_name[token.type] in _STRINGS and token.start[0] == token.end[0]:
            text = _IN_STRING.sub(INSTALLED, text)
        elif tokenize.tok_name[token.type] in _STRINGS:
            for row in range(token.start[0], token.end[0] + 1):
                lines[row - 1] = _IN_STRING.sub(INSTALLED, lines[row - 1])
        elif token.type == tokenize.NAME and text == FOLDER:
            if before in {"from", "import"}:
                text = INSTALLED
            elif imports_package:
                raise ValueError(f"line {token.start[0]}: import the module by `from {FOLDER}…`")
        if text != token.string and token.start[0] == token.end[0]:
            edits.append((token.start, token.end, text))
        before = token.string
    # From the last to the first of a line, so that columns stay right.
    for (row, first), (_, last), text in sorted(edits, reverse=True):
        line = lines[row - 1]
        lines[row - 1] = line[:first] + text + line[last:]
    return "".join(lines)


def write_installed(source: Path, target: Path) -> None:
    """Copy a package with all of its files but weights, and Python code as it is installed."""
    for path in sorted(source.rglob("*")):
        if not path.is_file() or path.suffix in {".pyc", WEIGHTS}:
            continue
        copy = target / path.relative_to(source)
        copy.parent.mkdir(parents=True, exist_ok=True)
        if path.suffix == ".py":
            text = path.read_text(encoding="utf-8")
            try:
                copy.write_text(installed_source(text), encoding="utf-8")
            except ValueError as error:
                raise ValueError(f"{path}: {error}") from error
        else:
            shutil.copyfile(path, copy)


def required_weights(root: Path, extras: dict[str, list[str]]) -> list[str]:
    """Requirements of the wheel of the weights, by the extras; none without weights beside it.

    Docker builds install what the package depends on before its code.
    """
    if not any((root / FOLDER).rglob(f"*{WEIGHTS}")):
        return []
    text = (root / "weights/pyproject.toml").read_text(encoding="utf-8")
    project = tomllib.loads(text)["project"]
    pin = f"{project['name']}=={project['version']}"
    readers = (
        name for name, wanted in extras.items() if any(w.startswith(_READER) for w in wanted)
    )
    return [f"{pin}; extra == '{name}'" for name in readers]


class ServicesHook(BuildHookInterface[Any]):
    """Puts `services` into wheels under its other name."""

    def initialize(self, version: str, build_data: dict[str, Any]) -> None:
        """Write the renamed package and have it included; nothing for an editable installation."""
        if version == "editable":
            return
        self._folder = tempfile.mkdtemp(prefix="dextouch_wheel_")
        renamed = Path(self._folder) / INSTALLED
        write_installed(Path(self.root) / FOLDER, renamed)
        build_data["force_include"][str(renamed)] = INSTALLED
        extras = self.metadata.core.optional_dependencies
        build_data["dependencies"] += required_weights(Path(self.root), extras)
        # The table of scripts names a module of the checkout.
        scripts = self.metadata.core.scripts
        for name, place in scripts.items():
            scripts[name] = _IN_STRING.sub(INSTALLED, place)

    def finalize(self, version: str, build_data: dict[str, Any], artifact_path: str) -> None:
        """Remove what was written."""
        if version != "editable":
            shutil.rmtree(self._folder, ignore_errors=True)
