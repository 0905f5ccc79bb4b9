"""The site is built without most extras: every module of `dextouch` can be imported there."""

import importlib.metadata
import json
import subprocess
import sys
import tomllib
from pathlib import Path

from packaging.requirements import Requirement
from packaging.utils import canonicalize_name

ROOT = Path(__file__).parents[2]
# Imports as docs/extensions/front_door.py does, with packages mocked (as by Sphinx) and missing.
CHILD = """
import importlib, json, pkgutil, runpy, sys
from importlib.machinery import ModuleSpec
from types import ModuleType

def anything(self, name):
    if name.startswith("__"):
        raise AttributeError(name)
    return Class(name, (), {"__getattr__": anything})

class Class(type):
    __getattr__ = anything
    # As of Sphinx's, no unions can be made of them.
    __or__ = __ror__ = None

class Mocked(ModuleType):
    __path__ = []
    __getattr__ = anything

class Finder:
    def __init__(self, finder):
        self.finder = finder
    def __getattr__(self, name):
        return getattr(self.finder, name)
    def find_spec(self, name, path=None, target=None):
        top = name.partition(".")[0]
        if top in mocked:
            return ModuleSpec(name, self, is_package=True)
        return None if top in missing else self.finder.find_spec(name, path, target)
    def create_module(self, spec):
        return Mocked(spec.name)
    def exec_module(self, module):
        pass

mocked = set(runpy.run_path(sys.argv[1])["autodoc_mock_imports"])
missing = set(json.load(sys.stdin))
sys.meta_path[:] = map(Finder, sys.meta_path)
import dextouch

failed = {}
for module in pkgutil.walk_packages(dextouch.__path__, "dextouch."):
    try:
        importlib.import_module(module.name)
    except Exception as error:
        failed[module.name] = repr(error)
print(json.dumps(failed))
"""


def installed_for_the_site():
    """Distributions that the extra `docs` brings, by its requirements and theirs in turn."""
    project = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]
    extras = project["optional-dependencies"]
    left = [*map(Requirement, [*project["dependencies"], *extras["docs"]])]
    seen = set()
    while left:
        wanted = left.pop()
        name = canonicalize_name(wanted.name)
        for extra in sorted({"", *wanted.extras} - {e for n, e in seen if n == name}):
            seen.add((name, extra))
            if name == project["name"]:
                left += map(Requirement, extras.get(extra, ()))
                continue
            try:
                lines = importlib.metadata.requires(name) or ()
            except importlib.metadata.PackageNotFoundError:  # of Sphinx, which tests do not need
                continue
            needed = (Requirement(line) for line in lines)
            left += [
                one for one in needed if not one.marker or one.marker.evaluate({"extra": extra})
            ]
    return {name for name, _ in seen}


def test_every_module_is_imported_with_the_packages_of_the_site(tmp_path):
    brought = installed_for_the_site()
    assert {"zarr", "fastapi", "starlette", "gymnasium"} <= brought
    missing = [
        package
        for package, names in importlib.metadata.packages_distributions().items()
        if not brought & {canonicalize_name(name) for name in names}
        and package not in {"dextouch", "services"}
    ]
    assert {"torch", "mcap", "scipy", "numba"} <= set(missing)
    done = subprocess.run(
        [sys.executable, "-c", CHILD, str(ROOT / "docs/conf.py")],
        input=json.dumps(missing),
        cwd=tmp_path,
        env={"PYTHONPATH": f"{ROOT}:{ROOT / 'shared'}", "OMP_NUM_THREADS": "1"},
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode == 0, done.stderr[-2000:]
    assert json.loads(done.stdout) == {}
