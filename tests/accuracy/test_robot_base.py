"""Robot bases found from simulated pairs of poses against the true ones."""

import sys

import numpy as np
import pytest

from benchmarks.simulated.board_scenes import mount_difference
from dextouch.errors import InvalidInputError, NonFiniteError, ShapeError
from dextouch.geometry import invert, transform
from dextouch.geometry.rotations import rotation_from_vector
from services.alignment.calibration.hand_eye import solve_robot_base
from services.alignment.calibration.motion import DegenerateMotionError, move, twist


def pairs(seed, *, num=20, turn_rad=0.6, axes=(1, 1, 1), span_m=0.25, has_mount=True):
    """Noisy pairs, the true base and the true place of the tracker on the effector."""
    rng = np.random.default_rng(seed)
    T_world_base = transform(rotation_from_vector(rng.normal(size=3)), rng.normal(size=3))
    mount = transform(rotation_from_vector(rng.normal(size=3)), rng.normal(scale=0.05, size=3))
    T_effector_tracker = mount if has_mount else np.eye(4)
    turns = rotation_from_vector(rng.uniform(-turn_rad, turn_rad, (num, 3)) * np.array(axes))
    effector = transform(turns, np.array([0.4, 0.0, 0.3]) + rng.uniform(-span_m, span_m, (num, 3)))
    tracker = T_world_base @ effector @ T_effector_tracker

    def noise(rotation_deg, translation_mm):
        scale = np.repeat([np.deg2rad(rotation_deg), translation_mm * 1e-3], 3)
        return move(rng.normal(size=(num, 6)) * scale)

    return tracker @ noise(0.05, 0.5), effector @ noise(0.02, 0.2), T_world_base, T_effector_tracker


@pytest.mark.long
@pytest.mark.parametrize("is_given", [True, False])
def test_base_is_found_and_its_sigma_honest(is_given, capsys):
    errors, normalised = [], []
    for seed in range(20):
        tracker, effector, T_world_base, T_effector_tracker = pairs(seed)
        given = T_effector_tracker if is_given else None
        result = solve_robot_base(tracker, effector, T_effector_tracker=given)
        angle_rad, distance_m = mount_difference(result.T_world_base, T_world_base)
        errors.append((np.rad2deg(angle_rad), distance_m * 1e3))
        error = twist(invert(result.T_world_base) @ T_world_base)
        normalised.append(error @ np.linalg.solve(result.covariance, error) / 6)
        assert result.left_out_views == ()
        if is_given:
            np.testing.assert_allclose(result.T_effector_tracker, T_effector_tracker, atol=1e-12)
        else:
            assert mount_difference(result.T_effector_tracker, T_effector_tracker)[0] < 2e-3
    median = np.median(errors, axis=0)
    with capsys.disabled():
        sys.stdout.write(
            f"\nrobot base, 20 pairs, mount given {is_given}: {median[0]:.3f} deg, bound 0.06 | "
            f"{median[1]:.2f} mm, bound 0.8 | NEES {np.mean(normalised):.2f}, bounds 0.5 and 2"
        )
    assert median[0] <= 0.06
    assert median[1] <= 0.8
    assert 0.5 <= np.mean(normalised) <= 2


def test_a_given_place_makes_the_base_more_certain():
    tracker, effector, _, T_effector_tracker = pairs(0)
    alone = solve_robot_base(tracker, effector)
    helped = solve_robot_base(tracker, effector, T_effector_tracker=T_effector_tracker)
    assert helped.sigma_rotation_rad < alone.sigma_rotation_rad
    assert helped.sigma_translation_m < alone.sigma_translation_m


def test_pairs_that_are_far_off_are_left_out_and_named():
    tracker, effector, T_world_base, T_effector_tracker = pairs(1)
    tracker = tracker.copy()
    tracker[7, :3, 3] += 0.2
    tracker[15] = tracker[15] @ move(np.array([0.0, 0.4, 0.0, 0.0, 0.0, 0.0]))
    for given in (None, T_effector_tracker):
        result = solve_robot_base(tracker, effector, T_effector_tracker=given)
        assert result.left_out_views == (7, 15)
        angle_rad, distance_m = mount_difference(result.T_world_base, T_world_base)
        assert angle_rad < 3e-3
        assert distance_m < 3e-3


def test_too_many_outliers_are_refused():
    tracker, effector, _, T_effector_tracker = pairs(2)
    tracker = tracker.copy()
    tracker[:7, :3, 3] += np.random.default_rng(0).normal(scale=0.3, size=(7, 3))
    for given in (None, T_effector_tracker):
        with pytest.raises(InvalidInputError, match=r"disagree|contradict"):
            solve_robot_base(tracker, effector, T_effector_tracker=given)


@pytest.mark.parametrize(
    ("turn_rad", "axes", "missing"),
    [(1.0, (0, 0, 1), ["x", "y"]), (0.05, (1, 1, 1), ["x", "y", "z"])],
)
def test_degenerate_turns_are_refused_with_the_axes_to_add(turn_rad, axes, missing):
    for seed in range(10):
        tracker, effector, *_ = pairs(seed, turn_rad=turn_rad, axes=axes, has_mount=False)
        with pytest.raises(DegenerateMotionError, match="turn the effector") as refusal:
            solve_robot_base(tracker, effector)
        assert refusal.value.details["missing_axes"] == missing
        # Where the tracker's place is known, turns are not needed.
        solve_robot_base(tracker, effector, T_effector_tracker=np.eye(4))


def test_places_that_hardly_differ_are_refused_where_the_mount_is_given():
    tracker, effector, _, T_effector_tracker = pairs(3, span_m=0.01)
    with pytest.raises(DegenerateMotionError, match="move the effector") as refusal:
        solve_robot_base(tracker, effector, T_effector_tracker=T_effector_tracker)
    assert refusal.value.details["missing_axes"] == ["x", "y", "z"]


@pytest.mark.long
def test_healthy_pairs_are_never_refused():
    for seed in range(20):
        tracker, effector, T_world_base, mount = pairs(100 + seed, num=10 + seed % 20)
        for given in (None, mount):
            result = solve_robot_base(tracker, effector, T_effector_tracker=given)
            angle_rad, distance_m = mount_difference(result.T_world_base, T_world_base)
            # Not refused and not believed too much: none lies beyond five of its own sigmas.
            assert angle_rad < 5 * result.sigma_rotation_rad, seed
            assert distance_m < 5 * result.sigma_translation_m, seed


def test_an_inverted_side_is_named():
    tracker, effector, *_ = pairs(4)
    for wrong, name in (
        ((invert(tracker), effector), "Ts_world_tracker"),
        ((tracker, invert(effector)), "Ts_base_effector"),
    ):
        with pytest.raises(InvalidInputError, match=f"{name} is probably inverted"):
            solve_robot_base(*wrong)


def test_bad_input_is_refused():
    tracker, effector, *_ = pairs(5)
    with pytest.raises(NonFiniteError):
        solve_robot_base(tracker * np.nan, effector)
    with pytest.raises(ShapeError):
        solve_robot_base(tracker[:-1], effector)
    with pytest.raises(InvalidInputError, match="at least 4"):
        solve_robot_base(tracker[:3], effector[:3])
    with pytest.raises(ShapeError, match="T_effector_tracker"):
        solve_robot_base(tracker, effector, T_effector_tracker=np.eye(3))
