"""Mounts and time offsets against known ones; refusals of motion that does not show them."""

import json
import sys
from pathlib import Path

import numpy as np
import pytest

from dextouch.errors import InvalidInputError
from dextouch.geometry.rotations import rotation_from_vector
from dextouch.geometry.transforms import invert, transform
from services.alignment.calibration.hand_eye import (
    DegenerateMotionError,
    mount_difference,
    solve_hand_eye,
)
from services.alignment.calibration.time_offset import estimate_time_offset

RECORDED_POSES = Path(__file__).parents[3] / "shared/data/hand_eye/pose_samples.json"


def noisy(Ts, rng, rotation_deg, translation_mm):
    turn = rotation_from_vector(rng.normal(scale=np.deg2rad(rotation_deg), size=(len(Ts), 3)))
    shift = rng.normal(scale=translation_mm * 1e-3, size=(len(Ts), 3))
    return Ts @ transform(turn, shift)


def views(seed, *, num=20, turn_deg=35.0, axes=(1, 1, 1), noise=1.0):
    rng = np.random.default_rng(seed)
    mount = transform(rotation_from_vector(rng.normal(size=3)), rng.normal(scale=0.05, size=3))
    Z = transform(rotation_from_vector(rng.normal(size=3)), rng.normal(scale=0.5, size=3))
    turns = rng.normal(scale=np.deg2rad(turn_deg), size=(num, 3)) * np.array(axes)
    base = transform(rotation_from_vector(rng.normal(size=3)), np.array([0.3, 0.1, 0.4]))
    shifts = 0.1 * rng.normal(size=(num, 3))
    tracker = base @ transform(rotation_from_vector(turns), shifts)
    board = invert(mount) @ invert(tracker) @ Z
    return noisy(tracker, rng, 0.05 * noise, 0.5 * noise), noisy(board, rng, 0.03, 0.3), mount


def test_mount_is_found_as_well_as_its_sigma_says(capsys):
    errors, ratios = [], []
    for seed in range(4):
        tracker, board, mount = views(seed)
        result = solve_hand_eye(tracker, board)
        angle, distance = mount_difference(result.T_tracker_camera, mount)
        errors.append((np.rad2deg(angle), distance * 1e3))
        ratios.append((angle / result.sigma_rotation_rad, distance / result.sigma_translation_m))
    median = np.median(errors, axis=0)
    with capsys.disabled():
        sys.stdout.write(
            f"\nhand-eye, 20 views: {median[0]:.3f} deg, bound 0.06 | {median[1]:.2f} mm, bound 1.0"
            f" | error in sigmas {np.max(ratios):.1f}, bound 3"
        )
    assert median[0] <= 0.06
    assert median[1] <= 1.0
    assert np.max(ratios) <= 3
    assert np.median(ratios) >= 0.2


def test_exact_views_give_the_exact_mount():
    rng = np.random.default_rng(1)
    tracker, _, mount = views(1, noise=0.0)
    Z = transform(rotation_from_vector(rng.normal(size=3)), rng.normal(size=3))
    board = invert(mount) @ invert(tracker) @ Z
    angle, distance = mount_difference(solve_hand_eye(tracker, board).T_tracker_camera, mount)
    assert angle < 1e-8
    assert distance < 1e-8


@pytest.mark.parametrize(
    ("turn_deg", "axes", "missing"),
    [(40, (0, 0, 1), "x and y"), (40, (1, 0, 0), "y and z"), (3, (1, 1, 1), "x and y and z")],
)
def test_missing_motion_is_named(turn_deg, axes, missing):
    tracker, board, _ = views(2, turn_deg=turn_deg, axes=axes)
    with pytest.raises(DegenerateMotionError, match=missing):
        solve_hand_eye(tracker, board)


def test_inverted_series_is_recognised():
    tracker, board, _ = views(3)
    with pytest.raises(InvalidInputError, match=r"Ts_camera_board is probably inverted"):
        solve_hand_eye(tracker, invert(board))


def test_bad_poses_are_refused():
    tracker, board, _ = views(4)
    with pytest.raises(InvalidInputError):
        solve_hand_eye(tracker[:3], board[:3])
    with pytest.raises(InvalidInputError):
        solve_hand_eye(tracker, board[:-1])
    with pytest.raises(InvalidInputError):
        solve_hand_eye(tracker * np.nan, board)
    with pytest.raises(InvalidInputError, match="rigid"):
        solve_hand_eye(2 * tracker, board)


@pytest.mark.skipif(not RECORDED_POSES.is_file(), reason="no recordings in ../shared/data")
def test_recorded_poses_agree_with_themselves(capsys):
    samples = np.array(json.loads(RECORDED_POSES.read_text()))
    tracker, board = samples[:, 0], invert(samples[:, 1])
    halves = [solve_hand_eye(tracker[k::2], board[k::2]) for k in (0, 1)]
    angle, distance = mount_difference(*(half.T_tracker_camera for half in halves))
    sigma = np.hypot(*(half.sigma_translation_m for half in halves))
    with capsys.disabled():
        sys.stdout.write(
            f"\nhand-eye, recorded halves: {np.rad2deg(angle):.3f} deg, bound 0.2 | "
            f"{distance * 1e3:.1f} mm, bound {3e3 * sigma:.1f} (3 sigma)"
        )
    assert np.rad2deg(angle) <= 0.2
    assert distance <= 3 * sigma
    with pytest.raises(InvalidInputError, match="inverted"):
        solve_hand_eye(tracker, samples[:, 1])


def shaking(t_s, seed, num_axes, max_hz):
    rng = np.random.default_rng(seed)
    rate_hz, phase = (
        rng.uniform(0.3, max_hz, (num_axes, 8)),
        rng.uniform(0, 2 * np.pi, (num_axes, 8)),
    )
    return np.sin(2 * np.pi * rate_hz * t_s[:, None, None] + phase).sum(axis=2)


def two_streams(seed, *, num_axes=3, max_hz=6.0, noise=0.2, seconds=10.0):
    rng = np.random.default_rng(seed)
    offset_s = rng.uniform(-0.3, 0.3)
    t_a, t_b = np.arange(0, seconds, 1 / 60) + 0.003, np.arange(0, seconds, 1 / 90)
    a = shaking(t_a, seed, num_axes, max_hz)
    b = 2.5 * shaking(t_b, seed, num_axes, max_hz) + 1.0
    a, b = (x + noise * x.std() * rng.normal(size=x.shape) for x in (a, b))
    base_ns = 1_700_000_000_000_000_000
    stamp = lambda t_s: np.rint(t_s * 1e9).astype(np.int64) + base_ns  # noqa: E731
    return (stamp(t_a), a, stamp(t_b - offset_s), b), offset_s


@pytest.mark.parametrize(("num_axes", "bound_ms"), [(1, 2.5), (3, 1.0)])
def test_time_offset_against_truth(num_axes, bound_ms, capsys):
    errors_ms, sigmas = [], []
    for seed in range(4):
        streams, offset_s = two_streams(seed, num_axes=num_axes)
        found = estimate_time_offset(*streams)
        errors_ms.append(found.offset_ns * 1e-6 - offset_s * 1e3)
        sigmas.append(abs(errors_ms[-1]) / (found.sigma_ns * 1e-6))
    rms_ms = float(np.sqrt(np.mean(np.square(errors_ms))))
    with capsys.disabled():
        sys.stdout.write(
            f"\ntime offset, {num_axes} axes, 10 s: {rms_ms:.2f} ms, bound {bound_ms} | "
            f"error in sigmas {max(sigmas):.1f}, bound 3"
        )
    assert rms_ms <= bound_ms
    assert max(sigmas) <= 3


def test_motion_that_shows_no_offset_is_refused():
    (t_a, a, t_b, b), _ = two_streams(1)
    with pytest.raises(DegenerateMotionError, match="same brisk motion"):
        estimate_time_offset(t_a, a * 0, t_b, b)
    with pytest.raises(DegenerateMotionError, match="same brisk motion"):
        estimate_time_offset(t_a, a, t_b, np.random.default_rng(0).normal(size=b.shape))
    repeating = [np.sin(2 * np.pi * 2 * (t - t_a[0]) * 1e-9) for t in (t_a, t_b)]
    with pytest.raises(DegenerateMotionError, match="repeats"):
        estimate_time_offset(t_a, repeating[0], t_b, repeating[1])


def test_bad_signals_are_refused():
    (t_a, a, t_b, b), _ = two_streams(2)
    with pytest.raises(InvalidInputError):
        estimate_time_offset(t_a[::-1], a, t_b, b)
    with pytest.raises(InvalidInputError):
        estimate_time_offset(t_a, a * np.nan, t_b, b)
    with pytest.raises(InvalidInputError):
        estimate_time_offset(t_a, a, t_b, b[:, :2])
    with pytest.raises(InvalidInputError, match="lasts"):
        estimate_time_offset(t_a[:30], a[:30], t_b, b)
