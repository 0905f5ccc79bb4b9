"""Files as a wheel installs them: `services` is `dextouch_services` there, and all are small."""

import importlib.util
import zlib
from pathlib import Path

import pytest

from tests.system.wheel_environment import MAX_WHEEL_BYTES

ROOT = Path(__file__).parents[2]
_SPEC = importlib.util.spec_from_file_location("hatch_build", ROOT / "hatch_build.py")
hatch_build = importlib.util.module_from_spec(_SPEC)
_SPEC.loader.exec_module(hatch_build)

SOURCE = '''"""Docs of `services.twin.tasks`, not of services."""
from services.twin import serving
from services import twin; import importlib
import os.path
    # services.comments stay

NAMES = ["services.a.b:main", "a/services.x", f"services.{os}", 'its services', 1]
TEXT = """
services.a.b and other services.
my_services.twin, a.services.twin
"""
services = {}
services.get("services.last"), services
'''
EXPECTED = '''"""Docs of `dextouch_services.twin.tasks`, not of services."""
from dextouch_services.twin import serving
from dextouch_services import twin; import importlib
import os.path
    # services.comments stay

NAMES = ["dextouch_services.a.b:main", "a/services.x", f"dextouch_services.{os}", 'its services', 1]
TEXT = """
dextouch_services.a.b and other services.
my_services.twin, a.services.twin
"""
services = {}
services.get("dextouch_services.last"), services
'''


def test_imports_and_names_in_strings_are_renamed_and_nothing_else():
    assert hatch_build.installed_source(SOURCE).splitlines() == EXPECTED.splitlines()


def test_an_expression_with_the_package_is_refused():
    with pytest.raises(ValueError, match="line 2"):
        hatch_build.installed_source("import services.twin\nservices.twin.main()\n")


def test_the_wheel_stays_small():
    folders = ("shared/dextouch", "services", "deploy", "docs")
    paths = (path for folder in folders for path in (ROOT / folder).rglob("*") if path.is_file())
    sizes = {
        path.relative_to(ROOT): len(zlib.compress(path.read_bytes()))
        for path in paths
        if path.suffix not in {".pyc", hatch_build.WEIGHTS}
    }
    largest = sorted(sizes, key=sizes.__getitem__)[-5:]
    # Beside the files it has their list, with hashes, and headers.
    assert 1.06 * sum(sizes.values()) < MAX_WHEEL_BYTES, largest


@pytest.mark.long
def test_every_file_has_a_name_of_the_wheel(tmp_path):
    hatch_build.write_installed(ROOT / "services", tmp_path / "dextouch_services")
    for path in tmp_path.rglob("*.py"):
        text = path.read_text()
        compile(text, str(path), "exec")
        lines = [
            one
            for one in text.splitlines()
            if one.lstrip().startswith(("from services", "import services"))
        ]
        assert not lines, path
