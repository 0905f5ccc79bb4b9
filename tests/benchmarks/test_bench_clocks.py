"""`python -m benchmarks clocks`: one short run, scores, and options that mean nothing.

What a run says of speed is not judged here: that is for a quiet machine.
"""

import json
import subprocess
import sys

import numpy as np
import pytest

from benchmarks.clocks import benchmark
from benchmarks.clocks.benchmark import OFFLINE, ONLINE, score
from benchmarks.clocks.scenes import (
    BASE_DELAY_NS,
    MORE_SCENES,
    SCENES,
    STAMPLESS_SCENES,
    STOP_SCENES,
    Scene,
    simulate,
)
from benchmarks.command import stage_parser
from benchmarks.stages import named
from dextouch.errors import InvalidInputError, UnknownNameError


@pytest.fixture(scope="module")
def run(tmp_path_factory):
    """A quick run in a process of its own, as shape checks must not be timed."""
    folder = tmp_path_factory.mktemp("bench")
    command = [sys.executable, "-m", "benchmarks", "clocks", "--quick"]
    options = ["--scenes", "base,step -30 ms,stop 500 ms", "--seconds", "30", "--out", str(folder)]
    done = subprocess.run([*command, *options], capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    return done.stdout, folder


def test_a_quick_run_measures_every_way(run):
    text, folder = run
    figures = json.loads((folder / "bench_clocks.json").read_text())
    found = {(r["scene"], r["way"]): r["scores"][0]["rms_ms"] for r in figures["results"]}
    for scene in ("base", "step -30 ms"):
        assert all((scene, way) in found for way in (*ONLINE, *OFFLINE))
        assert found[scene, "ours, online"] < 0.3 < found[scene, "arrival stamps"]
    verdicts = {r["what"]: r["verdict"] for r in figures["requirements"]}
    assert verdicts["online RMS, seven scenes"] == "pass"
    assert verdicts["offline RMS, stops"] == "pass"
    assert verdicts["online RMS, stamps of 1 ms"] == "not measured"
    assert "least squares" in text


def shifted(take, error_ns):
    return take.true_ns + BASE_DELAY_NS + error_ns


def test_scores_leave_out_what_no_online_clock_can_know():
    take = simulate(Scene(step_ms=-30.0), seconds=40.0, seed=0)
    since_s = (take.true_ns - take.step_true_ns) * 1e-9
    hurt = (since_s >= 0) & (since_s < 1.0)
    wrong_ns = shifted(take, np.where(hurt, 9_000_000, 100_000))
    online, offline = (score(wrong_ns, take, is_online=kind) for kind in (True, False))
    assert online.rms_ms == pytest.approx(0.1)
    assert online.recovery_s == pytest.approx(1.0, abs=0.05)
    assert offline.rms_ms > 1
    assert offline.recovery_s is None
    slow_ns = shifted(take, np.where(since_s >= 0, 400_000, 0))
    assert score(slow_ns, take, is_online=True).recovery_s > 5


def test_a_scene_is_what_it_says():
    take = simulate(Scene(drops=0.1, grid_ms=16.0, step_ms=200.0), seconds=60.0, seed=1)
    assert len(take) == pytest.approx(0.9 * 3600, rel=0.03)
    assert (take.t_host_ns - take.true_ns >= BASE_DELAY_NS - 1).all()
    assert (np.diff(take.t_host_ns) >= 0).all()
    jumps = np.diff(take.t_device_ns) - np.diff(take.sequence) * 1e9 / 60
    assert np.flatnonzero(np.abs(jumps) > 1e8).size == 1


def test_stops_late_paths_and_wrong_stamps_are_what_they_say():
    quiet = {"drops": 0.0, "jitter_ms": 0.0, "outliers": 0.0, "skew_ppm": 0.0, "grid_ms": 1e-3}
    stopped = simulate(Scene(stop_ms=80.0, num_stops=5, **quiet), seconds=60.0, seed=0)
    waits_s = np.diff(stopped.true_ns - stopped.t_device_ns) * 1e-9
    np.testing.assert_allclose(waits_s[np.abs(waits_s) > 1e-3], [0.08] * 5, atol=1e-6)
    late = simulate(Scene(late_path_ms=20.0, **quiet), seconds=60.0, seed=0)
    delays_ms = (late.t_host_ns - late.true_ns) * 1e-6
    assert np.mean(delays_ms > 21) == pytest.approx(0.25, abs=0.001)
    wrong = simulate(Scene(wrong_stamps=0.01, **quiet), seconds=600.0, seed=0)
    ahead_s = (wrong.t_device_ns - wrong.sequence * 10**9 / 60) * 1e-9
    assert np.mean(ahead_s - ahead_s.min() > 0.019) == pytest.approx(0.01, abs=0.002)


@pytest.mark.parametrize("words", [["--seconds", "5"], ["--rounds", "0"]])
def test_options_that_mean_nothing_are_refused(words, tmp_path):
    parser = stage_parser("clocks")
    benchmark.add_options(parser)
    with pytest.raises(InvalidInputError, match=words[0]):
        benchmark.measure(parser.parse_args(words), tmp_path, pytest.fail)
    with pytest.raises(UnknownNameError, match="wander"):
        benchmark.measure(parser.parse_args(["--scenes", "storm"]), tmp_path, pytest.fail)


def test_every_scene_can_be_named_in_a_list():
    scenes = SCENES | MORE_SCENES | STOP_SCENES | STAMPLESS_SCENES
    assert named("scene", scenes, ",".join(scenes)) == scenes
