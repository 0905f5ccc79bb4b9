"""What is not installed is named with the extra that brings it, by every command; no tracebacks."""

import importlib.metadata
import json
import re
import subprocess
import sys
import tomllib
from pathlib import Path

import pytest
from packaging.requirements import Requirement
from packaging.utils import canonicalize_name

from services.cli.extras import EXTRA_OF, missing_package

ROOT = Path(__file__).parents[3]
# An environment without the packages of the command line.
WITHOUT = """
import contextlib, io, json, sys

class Without:
    def __init__(self, finder):
        self.finder = finder
    def __getattr__(self, name):
        return getattr(self.finder, name)
    def find_spec(self, name, path=None, target=None):
        absent = name.partition(".")[0] in sys.argv[1:]
        return None if absent else self.finder.find_spec(name, path, target)

sys.meta_path[:] = [Without(finder) for finder in sys.meta_path]
"""
# Runs every line of standard input as a command.
CHILD = f"""{WITHOUT}
from services.cli import main

answers = {{}}
for line in sys.stdin.read().splitlines():
    err = io.StringIO()
    with contextlib.redirect_stdout(io.StringIO()), contextlib.redirect_stderr(err):
        try:
            status = main.main(line.split())
        except SystemExit as end:
            status = end.code
    answers[line] = (status, err.getvalue())
print(json.dumps(answers))
"""
NAMED = re.compile(r"pip install [^`]*\[(\w+)\]")
# One of each command, and the words of those that have some.
COMMANDS = (
    "demo --seeds 1",
    "up",
    "twin record --task stand_bottle --seeds 0",
    "station serve --mock-store x",
    "station calibrate show nothing",
    "store list",
    "export --format mcap nothing --to x.mcap",
    "export --format lerobot nothing --to x",
    "import --format mcap nothing.mcap",
    "align run --all",
    "align serve --help",
    "train data --count 0",
    "train world-model",
    "train imagined",
    "train policy",
    "train judge",
    "serve",
    "evaluate",
    "rate serve --help",
    "rate report",
)
HELP = "\n".join(("--help", "train --help", *COMMANDS))


def run_without(folder, packages, lines):
    (folder / "data/store/episodes").mkdir(parents=True)
    environment = {"PYTHONPATH": f"{ROOT}:{ROOT / 'shared'}", "PATH": "", "HOME": str(folder)}
    child = subprocess.run(
        [sys.executable, "-c", CHILD, *packages],
        input=lines,
        cwd=folder,
        env=environment | {"OMP_NUM_THREADS": "1"},
        capture_output=True,
        text=True,
        check=False,
    )
    assert child.returncode == 0, child.stderr[-2000:]
    return json.loads(child.stdout)


def test_services_of_the_light_image_need_no_more_than_its_extras():
    dockerfile = (ROOT / "deploy/Dockerfile").read_text()
    installed = re.search(r"'\.\[(.*?)\]'", dockerfile)[1].split(",")
    absent = [package for package, extra in EXTRA_OF.items() if extra not in installed]
    assert {"torch", "pyarrow"} <= set(absent)
    folders = ("acquisition", "alignment", "dashboard", "episode_store", "evaluation.studies")
    apps = [*(f"services.{folder}.app" for folder in folders), "services.twin.world"]
    code = f"{WITHOUT}import {', '.join(apps)}"
    done = subprocess.run(
        [sys.executable, "-c", code, *absent], cwd=ROOT, capture_output=True, text=True, check=False
    )
    assert done.returncode == 0, done.stderr[-1000:]


@pytest.mark.long
@pytest.mark.parametrize(
    ("installed", "refused"),
    [
        ((), set(COMMANDS)),
        # Reading a file needs no more until there is one.
        (("store",), set(COMMANDS) - {"import --format mcap nothing.mcap"}),
        (
            ("store", "station", "serve"),
            {
                "demo --seeds 1",
                "up",
                "twin record --task stand_bottle --seeds 0",
                "export --format lerobot nothing --to x",
                "align run --all",
                "train data --count 0",
                "train world-model",
                "train imagined",
                "train policy",
                "train judge",
                "serve",
                "evaluate",
            },
        ),
        (
            ("store", "station", "serve", "align", "twin", "gym", "export"),
            {
                "demo --seeds 1",
                "up",
                "train world-model",
                "train imagined",
                "train policy",
                "train judge",
                "serve",
                "evaluate",
            },
        ),
    ],
    ids=["base", "store", "station", "no model"],
)
def test_commands_name_the_extra_that_is_missing(tmp_path, installed, refused):
    absent = [package for package, extra in EXTRA_OF.items() if extra not in installed]
    answers = run_without(tmp_path, absent, HELP)
    assert answers["--help"][0] == answers["train --help"][0] == 0
    named = {line: NAMED.search(err) for line, (_, err) in answers.items()}
    assert {line for line, match in named.items() if match} == refused
    for line in refused:
        assert answers[line][0] == 3, answers[line]
        assert named[line][1] not in installed
        # Ports of the machine may be taken by others; `up` says so before.
        told = [text for text in answers[line][1].splitlines() if "is taken" not in text]
        assert len(told) == 1
    if "twin" in installed:
        # Only what `up` can leave out is missing.
        assert "--without world_model" in answers["up"][1]


@pytest.mark.long
def test_recorded_takes_are_replayed_without_the_twin(tmp_path):
    absent = [package for package, extra in EXTRA_OF.items() if extra == "twin"]
    line = "evaluate recorded --episodes nothing"
    status, err = run_without(tmp_path, absent, line)[line]
    assert status != 0
    assert "nothing" in err
    assert not NAMED.search(err), err


def test_extras_bring_what_is_said_of_them():
    text = (ROOT / "pyproject.toml").read_text(encoding="utf-8")
    extras = tomllib.loads(text)["project"]["optional-dependencies"]
    distributions = importlib.metadata.packages_distributions()
    for package, extra in EXTRA_OF.items():
        if package in distributions:  # not every optional one is installed
            wanted = {re.split(r"[\[<>=]", line)[0] for line in extras[extra]}
            brings = {name.lower().replace("_", "-") for name in distributions[package]}
            assert wanted & brings, f"{package}: not in extra {extra!r}"


def test_whatever_an_extra_brings_and_we_import_has_a_hint():
    project = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]
    extras = project["optional-dependencies"]
    brought = {
        canonicalize_name(Requirement(line).name)
        for extra in set(EXTRA_OF.values())
        for line in extras[extra]
    }
    paths = [path for folder in ("services", "shared") for path in (ROOT / folder).rglob("*.py")]
    pattern = re.compile(r"^\s*(?:from|import) (\w+)", re.MULTILINE)
    imported = {name for path in paths for name in pattern.findall(path.read_text())}
    named = {
        package
        for package, names in importlib.metadata.packages_distributions().items()
        if package in imported and brought & {canonicalize_name(name) for name in names}
    }
    assert named - {"dextouch", "services"} <= set(EXTRA_OF)


def test_all_is_offered_for_what_it_brings():
    text = (ROOT / "pyproject.toml").read_text(encoding="utf-8")
    everything = tomllib.loads(text)["project"]["optional-dependencies"]["all"][0]
    brought = set(re.search(r"\[(.*)\]", everything)[1].split(","))
    for package, extra in EXTRA_OF.items():
        message = str(missing_package(ModuleNotFoundError("no", name=package)))
        assert ("the extra 'all'" in message) == (extra in brought), package


def test_a_module_of_ours_that_is_missing_is_an_error_of_ours():
    assert missing_package(ModuleNotFoundError("no", name="services.nothing")) is None
