"""Minutes of stations without faults, real bytes and decoders: nothing is raised."""

import json
import os
import subprocess
import sys
from pathlib import Path

import pytest

from tests.integration.health_clean_run import SKEW_PPM, STATIONS, told

ROOT = Path(__file__).parents[2]
RATES_HZ = {"small": 60, "human": 60, "robot": 60, "justfloat": 60, "wuji": 120}


def assert_clean(station, minutes, found):
    assert found["raised"] == []
    names, _ = STATIONS[station]
    assert found["streams"] == dict.fromkeys(names, "OK")
    assert (found["level"], found["unjudged"]) == ("OK", 0)
    rate_hz = RATES_HZ[station.removeprefix("small_")]
    assert found["samples"]["tactile_left"] == pytest.approx(rate_hz * 60 * minutes, abs=3)
    if "justfloat" not in station:
        tolerance_ppm = 3 if minutes >= 0.5 else 10
        assert found["skew_ppm"]["head"] == pytest.approx(-SKEW_PPM, abs=tolerance_ppm)


@pytest.mark.parametrize(
    ("station", "minutes"), [("small", 0.5), ("small_wuji", 0.25), ("small_justfloat", 0.25)]
)
def test_a_clean_while_raises_nothing(station, minutes):
    assert_clean(station, minutes, told(station, minutes))


@pytest.mark.slow
@pytest.mark.parametrize("station", ["human", "robot", "wuji", "justfloat"])
def test_ten_clean_minutes_raise_nothing(station):
    # In a process without the shape checks of tests, with which it takes many times as long.
    command = [sys.executable, "-m", "tests.integration.health_clean_run", station, "10"]
    paths = {"PYTHONPATH": f"{ROOT}{os.pathsep}{ROOT / 'shared'}"}
    done = subprocess.run(
        command, cwd=ROOT, env=os.environ | paths, capture_output=True, check=True, timeout=1800
    )
    assert_clean(station, 10, json.loads(done.stdout))
