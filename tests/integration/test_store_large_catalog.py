"""A catalog of many takes with real metadata is read from its file."""

import json
import os
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[2]


def measured(folder, count):
    command = [sys.executable, "-m", "tests.integration.store_large_catalog", folder, str(count)]
    paths = [str(ROOT), *(path for path in sys.path if path)]
    environment = os.environ | {"PYTHONPATH": os.pathsep.join(paths)}
    out = subprocess.check_output(command, cwd=ROOT, env=environment)
    return json.loads(out.splitlines()[-1])


def test_many_are_counted_and_have_the_metadata_of_real_takes(tmp_path):
    assert measured(tmp_path / "store", 40)["num"] == 40
    # A take of a station with three trackers and two calibrated gloves has 59 kB of calibration.
    sizes = [path.stat().st_size for path in tmp_path.glob("store/episodes/e-*/zarr.json")]
    # One of them is the take itself, and nine are committed while it is measured.
    assert len(sizes) == 39 + 9
    assert min(sizes) > 50_000


@pytest.mark.slow
def test_a_thousand_are_listed_at_once(tmp_path):
    report = measured(tmp_path / "store", 1000)
    print(json.dumps(report))  # noqa: T201
    assert report["num"] == 1000
    # Several times what it takes without other programs beside it.
    assert report["takes_ms"] < 25
    assert report["after_a_take_ms"] < 100
    assert report["hours_ms"] < 10
    assert report["build_ms"] < 2000 * 6
