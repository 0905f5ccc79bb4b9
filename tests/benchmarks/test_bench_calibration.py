"""`python -m benchmarks calibration`: one short run, and its parts that can be wrong.

What a run says of speed is not judged here: that is for a quiet machine.
"""

import json
import subprocess
import sys
from contextlib import contextmanager

import numpy as np
import pytest

from benchmarks.calibration import benchmark
from benchmarks.calibration.benchmark import (
    METHODS,
    OURS,
    OURS_POSES,
    OURS_SIZE_KNOWN,
    PARK,
    CameraResult,
    MethodResult,
    SceneResult,
    not_worse_share,
    requirements,
    scene_makers,
    score,
)
from benchmarks.command import stage_parser
from benchmarks.figures import Figure
from benchmarks.simulated.board_scenes import Motion, board_points, make_scene
from dextouch.errors import DegenerateRotationError, InvalidInputError, LimitExceededError

NAMES = [method.name for method in METHODS]
BY_NAME = {method.name: method for method in METHODS}
EXACT = Motion(pixel_px=0.0, tracker_rotation_deg=0.0, tracker_translation_m=0.0)


@pytest.fixture(scope="module")
def run(tmp_path_factory):
    """A quick run in a process of its own, as shape checks must not be timed."""
    folder = tmp_path_factory.mktemp("bench")
    command = [sys.executable, "-m", "benchmarks", "calibration", "--quick"]
    outputs = ["--json", str(folder / "figures.json"), "--out", str(folder / "out")]
    done = subprocess.run([*command, *outputs], capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    return folder, done.stdout, json.loads((folder / "figures.json").read_text())


def test_every_method_is_measured_on_every_seed(run):
    _, _, figures = run
    assert list(figures["hand_eye"]) == NAMES
    for result in figures["hand_eye"].values():
        for key in ("ms", "error_deg", "error_mm"):
            assert len(result[key]) == benchmark.AMOUNTS.quick["seeds"]
            assert min(result[key]) > 0


def test_every_promise_that_needs_no_quiet_machine_is_kept(run):
    _, _, figures = run
    verdicts = {row["what"]: row["verdict"] for row in figures["requirements"]}
    assert verdicts["degenerate scenes refused, axes to add named"] == "pass"
    assert verdicts["healthy scenes refused"] == "pass"
    # Two cameras have no spread to speak of.
    assert verdicts["intrinsics, 25 views: sigma over spread, largest of 9"] == "not measured"


@pytest.mark.parametrize("name", NAMES)
def test_every_method_finds_an_exact_mount(name):
    """A rival that is called wrongly would lose for the wrong reason."""
    solved = score(BY_NAME[name], make_scene(0, EXACT))
    assert solved.error_deg < 1e-3
    assert solved.error_mm < 1e-2


def test_opencvs_methods_are_different_ones():
    scene = make_scene(0)
    errors = {score(BY_NAME[name], scene).error_mm for name in NAMES[3:]}
    assert len(errors) == len(NAMES[3:])


def test_a_mount_of_nan_is_no_answer():
    scene = make_scene(1, Motion(num_views=4)).repeated([0] * 20)
    with pytest.raises(DegenerateRotationError, match="NaN"):
        BY_NAME[PARK].solve(scene)


def test_a_seed_makes_one_scene_with_the_noise_it_should_have():
    scene, again, other = (make_scene(seed) for seed in (3, 3, 4))
    np.testing.assert_array_equal(scene.Ts_world_tracker, again.Ts_world_tracker)
    assert not np.array_equal(scene.Ts_world_tracker, other.Ts_world_tracker)
    exact = make_scene(3, EXACT)
    noise_px = np.array(scene.views.pixels_px) - np.array(exact.views.pixels_px)
    assert abs(noise_px.std() - 0.3) < 0.02
    shift_m = scene.Ts_world_tracker[:, :3, 3] - exact.Ts_world_tracker[:, :3, 3]
    assert abs(shift_m.std() - 5e-4) < 1e-4
    assert board_points().shape == (54, 3)


def test_scenes_that_cannot_be_seen_are_refused(monkeypatch):
    monkeypatch.setattr("benchmarks.simulated.board_scenes.MAX_TRIES", 50)
    with pytest.raises(LimitExceededError):
        make_scene(0, Motion(distance_m=(0.14, 0.15), tilt_deg=1.0))


def test_only_the_first_kind_of_scene_is_healthy():
    assert [is_healthy for _, is_healthy in scene_makers().values()] == [True] + 7 * [False]


def result(name, degrees, millimetres, *, sigma=None):
    sigmas = None if sigma is None else Figure.of([sigma] * len(degrees))
    return MethodResult(
        name,
        len(degrees),
        ms=Figure.of([1.0] * len(degrees)),
        error_deg=Figure.of(degrees),
        error_mm=Figure.of(millimetres),
        nees=None if sigma is None else Figure.of([1.0] * len(degrees)),
        sigma_deg=sigmas,
        sigma_mm=sigmas,
    )


def test_shares_count_seeds_with_and_without_tolerance():
    ours = result(OURS, [1.0, 2.0, 3.0, 4.0], [1.0, 1.0, 1.0, 1.0], sigma=2.0)
    rival = result(PARK, [2.0, 1.5, 1.9, 1.0], [1.0, 0.9, 2.0, 2.0])
    assert not_worse_share(ours, rival, tolerance_sigmas=0.0) == (0.25, 0.75)
    assert not_worse_share(ours, rival, tolerance_sigmas=0.5) == (0.5, 1.0)
    with pytest.raises(InvalidInputError, match="no sigma"):
        not_worse_share(rival, ours, tolerance_sigmas=0.0)


def counts(num_seeds, num_refused, num_named):
    numbers = {"num_seeds": num_seeds, "num_refused": num_refused, "num_named": num_named}
    return {**numbers, "cause": "", "rivals": {}}


def test_requirements_say_what_failed():
    good = result(OURS, [0.05], [0.5], sigma=0.05)
    bad = result(OURS_POSES, [0.07], [0.9], sigma=0.05)
    rival = result(PARK, [0.01], [0.6])
    camera = CameraResult(25, *[Figure.of([0.004])] * 5, sigma_over_spread={"fx": 0.4, "fy": 1.9})
    refusals = [
        SceneResult("healthy", is_healthy=True, **counts(50, 1, 0)),
        SceneResult("no turns", is_healthy=False, **counts(4, 4, 3)),
    ]
    known = result(OURS_SIZE_KNOWN, [0.05], [0.5], sigma=0.05)
    results = {OURS: good, OURS_POSES: bad, OURS_SIZE_KNOWN: known, PARK: rival}
    found = requirements(results, [camera], refusals)
    assert [r.verdict() for r in found] == [
        *("pass", "pass", "pass", "pass", "pass"),
        *("FAIL", "FAIL", "pass", "pass", "pass"),
        *("FAIL", "pass"),
        *("FAIL", "FAIL", "pass"),
        *("FAIL", "FAIL"),
    ]


@contextmanager
def no_bar(what, num_steps):
    yield lambda name: None


def test_runs_that_measure_nothing_are_refused(tmp_path):
    parser = stage_parser("calibration")
    benchmark.add_options(parser)
    with pytest.raises(InvalidInputError, match="--seeds"):
        benchmark.measure(parser.parse_args(["--seeds", "0"]), tmp_path, no_bar)
