"""The configuration can be shown and written without the packages that only compute."""

import json
import os
import subprocess
import sys

import pytest

from services.cli.configuration import SECTIONS

# Of the extras other than `serve`, which reads settings.
ABSENT = frozenset(
    {
        *("torch", "safetensors", "diffusers", "transformers", "PIL"),
        *("mujoco", "gymnasium", "scipy", "numba", "cv2", "serial", "hid", "usb"),
        *("zarr", "av", "obstore", "mcap", "pyarrow", "rerun"),
    }
)
DRIVER = f"""
import importlib.abc, sys

class Absent(importlib.abc.MetaPathFinder):
    def find_spec(self, name, path=None, target=None):
        if name.partition(".")[0] in {set(ABSENT)}:
            raise ModuleNotFoundError(f"No module named {{name!r}}", name=name)

sys.meta_path.insert(0, Absent())
from services.cli.main import main
sys.exit(main(sys.argv[1:]))
"""


def run(folder, *words, **variables):
    return subprocess.run(
        [sys.executable, "-c", DRIVER, *words],
        capture_output=True,
        text=True,
        check=False,
        cwd=folder,
        timeout=120,
        env={**os.environ, **variables},
    )


@pytest.mark.long
def test_config_shows_all_sections_without_torch(tmp_path):
    done = run(tmp_path, "config", "show", "--json", "shown.json", DEXTOUCH_WORLD_MODEL_PORT="9")
    assert done.returncode == 0, done.stderr
    shown = json.loads((tmp_path / "shown.json").read_text())["sections"]
    assert set(shown) == set(SECTIONS)
    assert shown["world_model"]["port"] == {"value": "9", "origin": "DEXTOUCH_WORLD_MODEL_PORT"}


@pytest.mark.long
@pytest.mark.parametrize("sections", [(), tuple(SECTIONS)], ids=["services", "all"])
def test_config_example_needs_no_torch(tmp_path, sections):
    done = run(tmp_path, "config", "example", *sections)
    assert done.returncode == 0, done.stderr
    assert "\n[world_model]\n" in done.stdout
    here = subprocess.run(
        [sys.executable, "-m", "services.cli.main", "config", "example", *sections],
        capture_output=True,
        text=True,
        check=True,
        cwd=tmp_path,
    ).stdout.splitlines()
    # What follows from the processor is known only to torch.
    told = done.stdout.splitlines()
    assert [one for one in told if "bfloat16" not in one] == [
        one for one in here if "bfloat16" not in one
    ]


@pytest.mark.long
def test_a_command_that_computes_still_names_what_is_missing(tmp_path):
    done = run(tmp_path, "serve", "--port", "0")
    assert done.returncode == 3
    assert "pip install" in done.stderr
    assert "Traceback" not in done.stderr
