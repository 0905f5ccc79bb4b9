"""Packages of `dextouch` are entered through their `__init__` and the names that it lists alone."""

import ast
import re
import subprocess
import sys
from importlib import import_module
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]
LIBRARY = ROOT / "shared" / "dextouch"
# Modules that users' code imports by name.
PROMISED = (
    "dextouch.clients.gym_env",
    "dextouch.geometry.rotations",
    "dextouch.hands.actions",
    "dextouch.hands.robot_hand",
    "dextouch.metrics.policy",
    "dextouch.metrics.tactile",
    "dextouch.tactile.layout",
)
# Line of an import in a code block of a page; names in brackets may go on for several lines.
IMPORT = re.compile(
    r"^[ >]*((?:from dextouch[\w.]* import (?:\([^)]*\)|.+))|import dextouch.*)$", re.MULTILINE
)


def dotted(path):
    parts = ["dextouch", *path.relative_to(LIBRARY).with_suffix("").parts]
    return ".".join(parts[:-1] if parts[-1] == "__init__" else parts)


def door_of(init):
    """The module that lists what a package exports: the stub of one whose names are lazy."""
    stub = init.with_suffix(".pyi")
    return ast.parse((stub if stub.is_file() else init).read_text(encoding="utf-8"))


PACKAGES = {dotted(path): door_of(path) for path in sorted(LIBRARY.glob("*/**/__init__.py"))}
MODULES = {dotted(path) for path in LIBRARY.rglob("*.py")} - PACKAGES.keys()


def imports(package):
    """The names that a package takes from itself and its modules, in pairs with their home."""
    found = []
    for node in ast.walk(PACKAGES[package]):
        if isinstance(node, ast.ImportFrom):
            # A stub's imports are relative.
            parts = [package if node.level else "", node.module or ""]
            home = ".".join(part for part in parts if part)
            if f"{home}.".startswith(f"{package}."):
                found += [(alias, home) for alias in node.names]
    return found


def listed(package):
    """The public names of a package: of its `__all__`, else those that it imports lazily."""
    for node in PACKAGES[package].body:
        if isinstance(node, ast.Assign) and ast.unparse(node.targets[0]) == "__all__":
            return ast.literal_eval(node.value)
    return [alias.asname for alias, _ in imports(package)]


def imported(package):
    """The names that a package takes from its modules, and these modules."""
    return {alias.name: home for alias, home in imports(package) if home != package}


def is_private(module, importer):
    """Whether a module belongs to a package that does not name it, and the importer is outside."""
    package, _, name = module.rpartition(".")
    if module not in MODULES or package not in PACKAGES:
        return False
    return name not in listed(package) and not f"{importer}.".startswith(f"{package}.")


def offences(source, importer=""):
    """The private modules that a source text imports from outside their package."""
    found = set()
    for node in ast.walk(ast.parse(source)):
        if isinstance(node, ast.ImportFrom) and node.module:
            found |= {node.module, *(f"{node.module}.{alias.name}" for alias in node.names)}
        elif isinstance(node, ast.Import):
            found |= {alias.name for alias in node.names}
    return {module for module in found if is_private(module, importer)}


@pytest.mark.parametrize("package", sorted(PACKAGES))
def test_a_package_exports_what_its_init_lists(package):
    public, homes = listed(package), imported(package)
    modules = {name for name in public if f"{package}.{name}" in MODULES | PACKAGES.keys()}
    # A name that is both would hide the module of that name.
    assert not homes.keys() & modules
    assert homes.keys() | modules == set(public)
    door = import_module(package)
    assert sorted(door.__all__) == sorted(public)
    assert set(homes) <= set(dir(door))
    for name, home in homes.items():
        assert getattr(door, name) is getattr(import_module(home), name)
    for alias, home in imports(package):
        if home == package:
            assert getattr(door, alias.name) is import_module(f"{package}.{alias.name}")
    with pytest.raises(AttributeError, match=f"{package}.*no_such_name"):
        _ = door.no_such_name


def test_promised_modules_are_public():
    for module in PROMISED:
        package, _, name = module.rpartition(".")
        assert module in MODULES
        assert name in listed(package)


@pytest.mark.parametrize(
    "line",
    [
        "from dextouch.streams.batch import decode_batch",
        "from dextouch.streams import Sample, batch",
        "import dextouch.streams.batch",
        "import dextouch.streams.batch as batch",
        "def late():\n    from dextouch.clocks.clock_model import find_steps",
        "from dextouch.bridges.lerobot.layout import frames_of",
        "from dextouch.hands.hand_files.loading import load_hand",
        "from dextouch.episodes.maintenance.repair import repair_group",
    ],
)
@pytest.mark.parametrize("importer", ["", "dextouch.worlds.routes"])
def test_an_import_past_a_door_is_found(line, importer):
    assert len(offences(line, importer)) == 1


@pytest.mark.parametrize(
    ("line", "importer"),
    [
        ("from dextouch.streams import decode_batch", ""),
        ("from dextouch.streams.batch import decode_batch", "dextouch.streams.samples"),
        ("from dextouch.bridges.export_files import blocks", "dextouch.bridges.lerobot.video"),
        ("from dextouch.hands.actions import reanchor", "dextouch.worlds.routes"),
        ("from dextouch.hands.hand_files import load_hand", ""),
        ("from dextouch.episodes.files import disk_errors", "dextouch.episodes.maintenance.repair"),
        ("from dextouch.metrics import tactile", ""),
        ("from dextouch.errors import ShapeError", ""),
    ],
)
def test_doors_and_what_is_behind_ones_own_are_open(line, importer):
    assert not offences(line, importer)


@pytest.mark.long
@pytest.mark.parametrize("folder", ["services", "benchmarks", "shared"])
def test_code_enters_packages_through_their_doors(folder):
    found = {}
    for path in sorted((ROOT / folder).rglob("*.py")):
        importer = dotted(path) if path.is_relative_to(LIBRARY) else ""
        found[str(path.relative_to(ROOT))] = offences(path.read_text(encoding="utf-8"), importer)
    wrong = {path: sorted(modules) for path, modules in found.items() if modules}
    assert not wrong, f"import these from their packages: {wrong}"


def test_pages_enter_packages_through_their_doors():
    assert IMPORT.findall(">>> from dextouch.a import (\n    b,\n)\nx") == [
        "from dextouch.a import (\n    b,\n)"
    ]
    wrong = {
        page.name: modules
        for page in (ROOT / "docs").rglob("*.md")
        for line in IMPORT.findall(page.read_text(encoding="utf-8"))
        if (modules := offences(line))
    }
    assert not wrong, f"import these from their packages: {wrong}"


@pytest.mark.long
@pytest.mark.parametrize(
    ("line", "unwanted"),
    [
        ("import dextouch", {"numpy"}),
        ("from dextouch.schemas import Problem", {"numpy", "msgpack"}),
        ("from dextouch.streams import pack", {"google_crc32c", "pydantic", "simplejpeg"}),
        ("from dextouch.clients import RolloutClient", {"google_crc32c", "httpx", "zarr"}),
        ("from dextouch.episodes import EpisodeStore", {"av", "obstore", "scipy", "zarr"}),
        ("from dextouch.worlds import World", {"fastapi", "redis", "structlog"}),
        ("from dextouch.serving import ChildProcess", {"fastapi", "pydantic", "redis"}),
    ],
)
def test_a_door_imports_only_what_is_asked_for(line, unwanted):
    code = f"import sys\n{line}\nprint(*sys.modules)"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert not unwanted & set(done.stdout.split())
