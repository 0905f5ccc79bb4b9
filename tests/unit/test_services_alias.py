"""Code outside of the repository imports `dextouch_services`, also from a checkout."""

import importlib
import subprocess
import sys

import pytest


def test_modules_are_the_same_objects():
    alias = importlib.import_module("dextouch_services.acquisition.devices")
    assert alias is importlib.import_module("services.acquisition.devices")
    assert alias.__name__ == "services.acquisition.devices"
    assert alias.__spec__.name == "services.acquisition.devices"
    from dextouch_services.acquisition.devices import GloveSettings

    from services.acquisition.devices import GloveSettings as Own

    assert GloveSettings is Own


@pytest.mark.long
def test_either_name_may_come_first():
    code = (
        "import dextouch_services.twin.tasks as a, services.twin.tasks as b;"
        "import services.twin.tasks.task as c, dextouch_services.twin.tasks.task as d;"
        "assert a is b and c is d"
    )
    subprocess.run([sys.executable, "-c", code], check=True, timeout=60)


def test_unknown_modules_are_not_found():
    with pytest.raises(ModuleNotFoundError, match=r"dextouch_services\.nothing"):
        importlib.import_module("dextouch_services.nothing")


def test_a_module_can_be_run():
    words = [sys.executable, "-m", "dextouch_services.cli.main", "--help"]
    done = subprocess.run(words, check=True, capture_output=True, text=True, timeout=60)
    assert "dextouch" in done.stdout
