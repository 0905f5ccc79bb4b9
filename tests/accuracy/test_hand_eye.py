"""Mounts found from simulated views against the true ones, and from a recording."""

import json
import sys
from functools import cache
from pathlib import Path

import cv2
import numpy as np
import pytest

from benchmarks.simulated import board_scenes as scenes
from benchmarks.simulated.board_scenes import Motion, mount_difference
from dextouch.errors import InvalidInputError, NonFiniteError
from dextouch.geometry import invert, transform
from services.alignment.calibration.hand_eye import (
    BoardViews,
    HandEyeNoise,
    solve_hand_eye,
)
from services.alignment.calibration.motion import (
    DegenerateMotionError,
    move,
    park,
    scaled_park,
    twist,
)

RECORDED_POSES = Path(__file__).parents[3] / "shared/data/hand_eye/pose_samples.json"
NUM_SEEDS = 20
# Scenes cost more than solving them.
make_scene = cache(scenes.make_scene)


def errors_deg_mm(T_tracker_camera, scene):
    angle_rad, distance_m = mount_difference(T_tracker_camera, scene.T_tracker_camera)
    return np.rad2deg(angle_rad), distance_m * 1e3


def nees(result, scene):
    """Normalised squared error by degree of freedom."""
    error = twist(invert(result.T_tracker_camera) @ scene.T_tracker_camera)
    return error @ np.linalg.solve(result.covariance, error) / 6


@pytest.mark.long
@pytest.mark.parametrize("with_corners", [True, False])
def test_mount_is_as_near_as_promised_and_its_sigma_honest(with_corners, capsys):
    ours, theirs, normalised, published = [], [], [], []
    for seed in range(NUM_SEEDS):
        scene = make_scene(seed)
        tracker, board = scene.Ts_world_tracker, scene.Ts_camera_board
        result = solve_hand_eye(tracker, board, views=scene.views if with_corners else None)
        ours.append(errors_deg_mm(result.T_tracker_camera, scene))
        theirs.append(errors_deg_mm(scaled_park(tracker, board)[0], scene))
        normalised.append(nees(result, scene))
        angle_rad, distance_m = mount_difference(result.T_tracker_camera, scene.T_tracker_camera)
        published.append(
            [angle_rad / result.sigma_rotation_rad, distance_m / result.sigma_translation_m]
        )
        assert result.left_out_views == ()
    median, median_park = np.median(ours, axis=0), np.median(theirs, axis=0)
    with capsys.disabled():
        sys.stdout.write(
            f"\nhand-eye, corners {with_corners}: {median[0]:.3f} deg, bound 0.06 (Park "
            f"{median_park[0]:.3f}) | {median[1]:.2f} mm, bounds 0.8 and 0.85 "
            f"(Park {median_park[1]:.2f}) | NEES {np.mean(normalised):.2f}, bounds 0.5 and 2"
        )
    assert median[0] <= 0.06
    # Without corners the size of the board is known less well.
    assert median[1] <= (0.8 if with_corners else 0.85)
    assert (median <= median_park).all()
    assert 0.5 <= np.mean(normalised) <= 2
    # A sigma is the length of three axes' sigmas: the mean square of error by sigma is one, of 20
    # scenes within 0.2 (60 degrees of freedom).
    ratios = np.square(published).mean(axis=0)
    assert (ratios >= 0.5).all()
    assert (ratios <= 1.8).all()


@pytest.mark.long
@pytest.mark.parametrize("factor", [0.3, 3.0])
def test_wrongly_declared_noise_is_corrected(factor):
    """The views know better: sigma stays honest where the declaration is three times off."""
    usual = HandEyeNoise()
    declared = HandEyeNoise(**{name: factor * value for name, value in vars(usual).items()})
    normalised = []
    for seed in range(NUM_SEEDS):
        scene = make_scene(seed)
        result = solve_hand_eye(
            scene.Ts_world_tracker, scene.Ts_camera_board, views=scene.views, noise=declared
        )
        normalised.append(nees(result, scene))
    assert 0.5 <= np.mean(normalised) <= 2


def test_our_park_is_opencvs():
    scene = make_scene(3)
    tracker, board = scene.Ts_world_tracker, scene.Ts_camera_board
    R, t = cv2.calibrateHandEye(
        tracker[:, :3, :3],
        tracker[:, :3, 3],
        board[:, :3, :3],
        board[:, :3, 3],
        method=cv2.CALIB_HAND_EYE_PARK,
    )
    angle_rad, distance_m = mount_difference(park(tracker, board), transform(R, t.ravel()))
    assert angle_rad < 2e-4
    assert distance_m < 2e-4


def test_exact_views_give_the_exact_mount():
    scene = make_scene(1, Motion(pixel_px=0.0, tracker_rotation_deg=0.0, tracker_translation_m=0.0))
    for views in (None, scene.views):
        result = solve_hand_eye(scene.Ts_world_tracker, scene.Ts_camera_board, views=views)
        angle_rad, distance_m = mount_difference(result.T_tracker_camera, scene.T_tracker_camera)
        assert angle_rad < 1e-6
        assert distance_m < 1e-6


DEGENERATE = {
    "about x": (Motion(tilt_deg=40.0, axes=(1.0, 0.0, 0.0)), 2),
    "about y": (Motion(tilt_deg=40.0, axes=(0.0, 1.0, 0.0)), 2),
    "about z": (Motion(tilt_deg=60.0, axes=(0.0, 0.0, 1.0)), 2),
    "hardly turned": (Motion(tilt_deg=4.0), 3),
    "not turned": (Motion(tilt_deg=0.0), 3),
}


@pytest.mark.long
@pytest.mark.parametrize("name", DEGENERATE)
def test_degenerate_motion_is_refused_with_the_axes_to_add(name):
    motion, num_missing = DEGENERATE[name]
    for seed in range(10):
        scene = make_scene(seed, motion)
        with pytest.raises(DegenerateMotionError, match="also turn the tracker") as refusal:
            solve_hand_eye(scene.Ts_world_tracker, scene.Ts_camera_board)
        assert len(refusal.value.details["missing_axes"]) == num_missing


def test_repeated_views_are_refused():
    for seed in range(10):
        scene = make_scene(seed, Motion(num_views=4))
        same, two = scene.repeated([0] * 20), scene.repeated([0, 1] * 10)
        for few in (same, two):
            with pytest.raises(DegenerateMotionError):
                solve_hand_eye(few.Ts_world_tracker, few.Ts_camera_board)


@pytest.mark.parametrize(
    ("axis", "possible"),
    [
        ((0.0, 0.0, 1.0), [["x", "y"]]),
        ((1.0, 0.0, 0.0), [["y", "z"]]),
        # Of x and y, which are equally near, either may be named.
        ((1.0, 1.0, 0.1), [["x", "z"], ["y", "z"]]),
    ],
)
def test_missing_axes_are_those_the_tracker_was_not_turned_about(axis, possible):
    rng = np.random.default_rng(0)
    scene = make_scene(0)
    turns = rng.uniform(-0.7, 0.7, 20)[:, None] * np.array(axis)
    tracker = move(np.column_stack([turns, 0.1 * rng.normal(size=(20, 3))]))
    board = invert(scene.T_tracker_camera) @ invert(tracker) @ scene.T_world_board
    with pytest.raises(DegenerateMotionError) as refusal:
        solve_hand_eye(tracker, board)
    assert refusal.value.details["missing_axes"] in possible


@pytest.mark.long
def test_healthy_motion_is_never_refused():
    motions = (Motion(), Motion(num_views=10), Motion(tilt_deg=22.0, sideways_m=0.05))
    for seed in range(50):
        scene = make_scene(100 + seed, motions[seed % len(motions)])
        result = solve_hand_eye(scene.Ts_world_tracker, scene.Ts_camera_board)
        angle_deg, distance_mm = errors_deg_mm(result.T_tracker_camera, scene)
        # Not refused and not believed too much: no seed lies beyond five of its own sigmas.
        assert angle_deg < 5 * np.rad2deg(result.sigma_rotation_rad), seed
        assert distance_mm < 5e3 * result.sigma_translation_m, seed


def test_views_that_are_far_off_are_left_out_and_named():
    scene = make_scene(5)
    board = scene.Ts_camera_board.copy()
    board[3] = board[3] @ move(np.array([0.3, 0.0, 0.0, 0.0, 0.02, 0.0]))
    board[11, :3, 3] += 0.1
    result = solve_hand_eye(scene.Ts_world_tracker, board)
    assert result.left_out_views == (3, 11)
    angle_deg, distance_mm = errors_deg_mm(result.T_tracker_camera, scene)
    assert angle_deg < 0.2
    assert distance_mm < 3


def test_views_without_anything_in_common_are_refused():
    scene = make_scene(6)
    with pytest.raises(InvalidInputError, match=r"contradict|disagree"):
        solve_hand_eye(scene.Ts_world_tracker, scene.Ts_camera_board[::-1])


def test_an_inverted_side_is_named():
    for seed in range(10):
        scene = make_scene(seed)
        tracker, board = scene.Ts_world_tracker, scene.Ts_camera_board
        for wrong, name in (
            ((invert(tracker), board), "Ts_world_tracker"),
            ((tracker, invert(board)), "Ts_camera_board"),
        ):
            with pytest.raises(InvalidInputError, match="is probably inverted") as refusal:
                solve_hand_eye(*wrong)
            assert refusal.value.details["inverted"] == name


@pytest.mark.long
@pytest.mark.parametrize("scale", [0.95, 0.975, 1.025, 1.05, 25.0 / 28.0, 1e-3, 1e3])
@pytest.mark.parametrize("with_corners", [True, False])
def test_a_board_of_another_size_than_was_entered_is_named(scale, with_corners):
    """The board is `scale` as large as entered: a scaled page, a wrong number, millimetres."""
    for seed in range(10):
        scene = make_scene(seed)
        board = scene.Ts_camera_board.copy()
        board[:, :3, 3] /= scale
        seen = scene.views
        views = BoardViews(
            [points / scale for points in seen.points_board],
            seen.pixels_px,
            seen.K,
            seen.distortion,
        )
        with pytest.raises(InvalidInputError, match="expected 1") as refusal:
            solve_hand_eye(scene.Ts_world_tracker, board, views=views if with_corners else None)
        assert refusal.value.details["scale"] == pytest.approx(scale, rel=8e-3)


def test_the_uncertain_size_of_a_board_is_part_of_sigma():
    """A print near what a ruler says: the mount is as far off as its sigma says."""
    ratios = []
    for seed in range(NUM_SEEDS):
        scene = make_scene(seed)
        scale = 1.0 + 5e-3 * np.random.default_rng(seed).normal()
        board = scene.Ts_camera_board.copy()
        board[:, :3, 3] /= scale
        result = solve_hand_eye(scene.Ts_world_tracker, board)
        distance_m = mount_difference(result.T_tracker_camera, scene.T_tracker_camera)[1]
        ratios.append(
            [
                distance_m / result.sigma_translation_m,
                (result.board_scale - scale) / result.sigma_board_scale,
            ]
        )
    rms = np.sqrt(np.square(ratios).mean(axis=0))
    # 20 scenes: the mean square of the scale's errors has 20 degrees of freedom (0.5 … 1.7).
    assert 0.7 < rms[0] < 1.3
    assert 0.65 < rms[1] < 1.35


def test_bad_views_are_named():
    scene = make_scene(7)
    with pytest.raises(InvalidInputError):
        solve_hand_eye(scene.Ts_world_tracker[:3], scene.Ts_camera_board[:3])
    with pytest.raises(InvalidInputError):
        solve_hand_eye(scene.Ts_world_tracker, scene.Ts_camera_board[:-1])
    tracker = scene.Ts_world_tracker.copy()
    tracker[4, 0, 3] = np.nan
    with pytest.raises(NonFiniteError, match=r"\[4\]"):
        solve_hand_eye(tracker, scene.Ts_camera_board)
    mirrored = scene.Ts_world_tracker.copy()
    mirrored[:, :3, 0] *= -1
    with pytest.raises(InvalidInputError, match="rigid"):
        solve_hand_eye(mirrored, scene.Ts_camera_board)
    with pytest.raises(InvalidInputError, match="pixel_px"):
        HandEyeNoise(pixel_px=0.0)


@pytest.mark.skipif(not RECORDED_POSES.is_file(), reason="no recordings in ../shared/data")
def test_recorded_poses_put_the_board_in_one_place(capsys):
    samples = np.array(json.loads(RECORDED_POSES.read_text()))
    tracker, board = samples[:, 0], invert(samples[:, 1])
    result = solve_hand_eye(tracker, board)
    places_m = (tracker @ result.T_tracker_camera @ board)[:, :3, 3]
    spread_m = np.linalg.norm(places_m - places_m.mean(axis=0), axis=1).mean()
    with capsys.disabled():
        sys.stdout.write(
            f"\nhand-eye, 50 recorded poses: board spread {spread_m * 1e3:.2f} mm (mean), bound 4.3"
        )
    assert spread_m <= 4.3e-3
    assert result.left_out_views == ()
    with pytest.raises(InvalidInputError) as refusal:
        solve_hand_eye(tracker, samples[:, 1])
    assert refusal.value.details["inverted"] == "Ts_camera_board"


@pytest.mark.skipif(not RECORDED_POSES.is_file(), reason="no recordings in ../shared/data")
def test_halves_of_the_recorded_poses_agree(capsys):
    samples = np.array(json.loads(RECORDED_POSES.read_text()))
    tracker, board = samples[:, 0], invert(samples[:, 1])
    halves = [solve_hand_eye(tracker[k::2], board[k::2]) for k in (0, 1)]
    angle_rad, distance_m = mount_difference(*(half.T_tracker_camera for half in halves))
    sigma_m = np.hypot(*(half.sigma_translation_m for half in halves))
    with capsys.disabled():
        sys.stdout.write(
            f"\nhand-eye, recorded halves: {np.rad2deg(angle_rad):.3f} deg, bound 0.2 | "
            f"{distance_m * 1e3:.1f} mm, bound {3e3 * sigma_m:.1f} (3 sigma)"
        )
    assert np.rad2deg(angle_rad) <= 0.2
    assert distance_m <= 3 * sigma_m
