"""Wrist and head actions: exact first step, invariance, re-anchoring, and storage in float32."""

import sys

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from benchmarks.simulated.board_scenes import make_scene
from dextouch.errors import DegenerateRotationError, NonFiniteError
from dextouch.geometry import invert, transform
from dextouch.geometry.rotations import rotation_angle, rotation_from_vector
from dextouch.hands.actions import (
    IDENTITY_POSE_9D,
    POSE_SLICES,
    HandTrajectory,
    actions_from_poses,
    pose_from_9d,
    pose_to_9d,
    poses_from_actions,
    reanchor,
    relative_pose_9d,
)
from services.alignment.calibration.hand_eye import solve_hand_eye, solve_robot_base
from services.alignment.calibration.motion import move
from services.alignment.recording_error import pose_difference
from tests.accuracy.test_robot_base import pairs

BOUND_M, BOUND_DEG = 1e-6, 1e-4
NUM_STEPS = 120
ANGLES = st.one_of(
    st.floats(0, np.pi),
    st.floats(np.pi - 1e-7, np.pi),
    st.floats(0, 1e-7),
    st.sampled_from([0.0, np.pi / 2, np.pi]),
)
VECTORS = st.tuples(*[st.floats(-1, 1)] * 3).filter(lambda v: np.linalg.norm(v) > 1e-3)
PLACES = st.tuples(*[st.floats(-2, 2)] * 3)
FAR_PLACES = st.tuples(*[st.floats(-1e3, 1e3)] * 3)


# Numbers only: what checks shapes at run time draws lots, which hypothesis forbids in strategies.
POSES = st.tuples(VECTORS, ANGLES, PLACES)


def pose_of(drawn):
    axis, angle, place = (np.array(part) for part in drawn)
    return transform(rotation_from_vector(angle * axis / np.linalg.norm(axis)), place)


def wandering(rng, num_steps=NUM_STEPS):
    """A pose that walks some decimetres and turns every way."""
    steps = np.cumsum(rng.normal(size=(num_steps, 6)) * [0.1, 0.1, 0.1, 0.01, 0.01, 0.01], axis=0)
    start = move(rng.normal(size=6))
    return start @ move(steps)


def trajectory_of(rng):
    left, right, head = (wandering(rng) for _ in range(3))
    joints = rng.normal(size=(2, NUM_STEPS, 20))
    return HandTrajectory(left, right, joints[0], joints[1], head)


def poses_of(trajectory):
    return np.stack(
        [
            trajectory.Ts_world_wrist_left,
            trajectory.Ts_world_wrist_right,
            trajectory.Ts_world_camera_head,
        ]
    )


def moved(trajectory, T):
    left, right, head = T @ poses_of(trajectory)
    return HandTrajectory(
        left, right, trajectory.joints_left_rad, trajectory.joints_right_rad, head
    )


def difference(Ts_a, Ts_b):
    """Largest distance (m) and angle (degrees) of two sets of poses."""
    distance_m, angle_rad = pose_difference(Ts_a.reshape(-1, 4, 4), Ts_b.reshape(-1, 4, 4))
    return float(distance_m.max()), float(np.rad2deg(angle_rad.max()))


def told(capsys, name, found, bounds):
    with capsys.disabled():
        sys.stdout.write(
            f"\n{name}: {found[0]:.1e} m, bound {bounds[0]:.0e} | {found[1]:.1e} deg, bound "
            f"{bounds[1]:.0e}"
        )


def test_the_first_step_is_exactly_the_identity():
    for seed in range(50):
        trajectory = trajectory_of(np.random.default_rng(seed))
        for index in (0, 7, NUM_STEPS - 1):
            actions = actions_from_poses(trajectory, trajectory.anchor(index))
            for part in POSE_SLICES:
                assert actions[index, part].tolist() == [0, 0, 0, 1, 0, 0, 0, 1, 0]
                assert actions.astype(np.float32)[index, part].tolist() == [
                    *[0, 0, 0, 1, 0, 0, 0, 1, 0]
                ]
                again = reanchor(actions, 3)
                assert again[3, part].tolist() == [0, 0, 0, 1, 0, 0, 0, 1, 0]
        for poses in poses_of(trajectory):
            assert relative_pose_9d(poses)[0].tolist() == IDENTITY_POSE_9D.tolist()


def test_a_wrist_that_rests_does_not_move():
    trajectory = trajectory_of(np.random.default_rng(0))
    still = np.repeat(trajectory.Ts_world_wrist_left[:1], NUM_STEPS, axis=0)
    trajectory = HandTrajectory(
        still,
        trajectory.Ts_world_wrist_right,
        trajectory.joints_left_rad,
        trajectory.joints_right_rad,
        trajectory.Ts_world_camera_head,
    )
    actions = actions_from_poses(trajectory, trajectory.anchor(0))
    assert (actions[:, POSE_SLICES[0]] == IDENTITY_POSE_9D).all()
    assert (actions[1:, POSE_SLICES[1]] != IDENTITY_POSE_9D).any(axis=1).all()


def test_actions_do_not_see_any_global_transform(capsys):
    worst = 0.0
    for seed in range(50):
        rng = np.random.default_rng(seed)
        trajectory = trajectory_of(rng)
        actions = actions_from_poses(trajectory, trajectory.anchor(0))
        T = transform(rotation_from_vector(rng.normal(size=3) * 2), rng.uniform(-100, 100, 3))
        other = moved(trajectory, T)
        again = actions_from_poses(other, other.anchor(0))
        worst = max(worst, float(np.abs(again - actions).max()))
    with capsys.disabled():
        sys.stdout.write(f"\nglobal transforms up to 100 m: {worst:.1e}, bound 1e-06")
    assert worst <= 1e-6


@settings(max_examples=60)
@given(st.tuples(VECTORS, ANGLES, FAR_PLACES), st.lists(POSES, min_size=2, max_size=20))
def test_relative_motion_does_not_see_where_the_world_is(new_world, poses):
    T_new_world, Ts = pose_of(new_world), np.stack([pose_of(pose) for pose in poses])
    mount = Ts[-1]
    motion = relative_pose_9d(Ts @ mount)
    again = relative_pose_9d(T_new_world @ Ts @ mount)
    np.testing.assert_allclose(again, motion, atol=1e-9)
    np.testing.assert_array_equal(again[0], IDENTITY_POSE_9D)


@pytest.mark.long
@pytest.mark.parametrize("dtype", [np.float64, np.float32])
def test_poses_come_back_from_stored_actions_whatever_the_anchor(dtype, capsys):
    worst = np.zeros(2)
    for seed in range(50):
        rng = np.random.default_rng(seed)
        trajectory = trajectory_of(rng)
        actions = actions_from_poses(trajectory, trajectory.anchor(0)).astype(dtype)
        index = int(rng.integers(1, NUM_STEPS))
        there = reanchor(actions, index).astype(dtype)
        direct = actions_from_poses(trajectory, trajectory.anchor(index))
        back = reanchor(there, 0).astype(dtype)
        for anchored, anchor in ((there, index), (back, 0)):
            poses = poses_of(poses_from_actions(anchored, trajectory.anchor(anchor)))
            worst = np.maximum(worst, difference(poses, poses_of(trajectory)))
        for part in POSE_SLICES:
            found = difference(pose_from_9d(there[:, part]), pose_from_9d(direct[:, part]))
            worst = np.maximum(worst, found)
    told(capsys, f"re-anchored and back, {np.dtype(dtype).name}", worst, (BOUND_M, BOUND_DEG))
    assert worst[0] <= BOUND_M
    assert worst[1] <= BOUND_DEG


@pytest.mark.long
@given(POSES)
def test_nine_numbers_in_float32_are_the_pose(pose):
    T = pose_of(pose)
    found = difference(pose_from_9d(pose_to_9d(T).astype(np.float32)), T)
    assert found[0] <= BOUND_M
    assert found[1] <= BOUND_DEG


def test_nine_numbers_in_float32_are_the_pose_of_many(capsys):
    rng = np.random.default_rng(1)
    axes = rng.normal(size=(20_000, 3))
    axes /= np.linalg.norm(axes, axis=1, keepdims=True)
    angles = np.concatenate([rng.uniform(0, np.pi, 10_000), np.pi - rng.uniform(0, 1e-6, 10_000)])
    Ts = transform(rotation_from_vector(angles[:, None] * axes), rng.uniform(-2, 2, (20_000, 3)))
    worst = difference(pose_from_9d(pose_to_9d(Ts).astype(np.float32)), Ts)
    told(capsys, "20 000 poses as nine float32", worst, (BOUND_M, BOUND_DEG))
    assert worst[0] <= BOUND_M
    assert worst[1] <= BOUND_DEG


@given(VECTORS, st.floats(0.1, 5), st.sampled_from([-1, 1]), st.floats(0, 5e-8))
def test_six_numbers_that_span_no_plane_are_refused(column, factor, sign, off):
    first = np.array(column)
    across = np.cross(first, np.eye(3)[np.argmin(np.abs(first))])
    parallel = np.concatenate([np.zeros(3), first, sign * factor * first + off * across])
    with pytest.raises(DegenerateRotationError, match="expected two independent columns"):
        pose_from_9d(parallel)
    with pytest.raises(DegenerateRotationError, match="zero"):
        pose_from_9d(np.concatenate([np.zeros(6), first]))
    with pytest.raises(NonFiniteError):
        pose_from_9d(np.concatenate([np.zeros(3), first, [np.nan, 0.0, 0.0]]))


@given(POSES, st.floats(0.1, 10), st.floats(0.1, 10), st.floats(-3, 3))
def test_columns_of_any_length_and_lean_give_the_same_pose(drawn, a, b, lean):
    T = pose_of(drawn)
    pose = pose_to_9d(T)
    first, second = pose[3:6].copy(), pose[6:].copy()
    pose[3:6], pose[6:] = a * first, b * (second + lean * first)
    assert rotation_angle(T[:3, :3].T @ pose_from_9d(pose)[:3, :3]) < 1e-9


def noisy(Ts, rng):
    """As a tracker of 0.5 mm and 0.05 degrees an axis sees it."""
    return Ts @ move(rng.normal(size=(len(Ts), 6)) * ([8.7e-4] * 3 + [5e-4] * 3))


def test_the_wrist_comes_to_the_robots_base(capsys):
    errors = []
    for seed in range(20):
        tracker, effector, T_world_base, T_effector_tracker = pairs(seed)
        found = solve_robot_base(tracker, effector)
        rng = np.random.default_rng(1000 + seed)
        # The effector is the wrist; it works where it was calibrated.
        Ts_base_wrist = effector[rng.integers(0, len(effector), 50)] @ move(
            rng.normal(size=(50, 6)) * ([0.2] * 3 + [0.05] * 3)
        )
        Ts_world_tracker = noisy(T_world_base @ Ts_base_wrist @ T_effector_tracker, rng)
        got = invert(found.T_world_base) @ Ts_world_tracker @ invert(found.T_effector_tracker)
        distance_m, angle_rad = pose_difference(got, Ts_base_wrist)
        errors.append((np.median(distance_m) * 1e3, np.rad2deg(np.median(angle_rad))))
    errors = np.array(errors)
    middle, worst = np.median(errors, axis=0), errors.max(axis=0)
    with capsys.disabled():
        sys.stdout.write(
            f"\nwrist in the base, 20 calibrations: {middle[0]:.2f} mm (worst {worst[0]:.2f}), "
            f"bounds 1.2 and 2 | {middle[1]:.3f} deg (worst {worst[1]:.3f}), bounds 0.15 and 0.2"
        )
    assert middle[0] <= 1.2
    assert worst[0] <= 2.0
    assert middle[1] <= 0.15
    assert worst[1] <= 0.2


def test_the_heads_camera_comes_to_the_robots_base(capsys):
    errors = []
    for seed in range(6):
        scene = make_scene(seed)
        mount = solve_hand_eye(scene.Ts_world_tracker, scene.Ts_camera_board, views=scene.views)
        tracker, effector, T_world_base, _ = pairs(seed)
        base = solve_robot_base(tracker, effector)
        rng = np.random.default_rng(seed)
        # Within a metre of the base, as a head above the table is.
        Ts_base_tracker = move(rng.normal(size=(50, 6)) * ([0.3] * 3 + [0.3] * 3))
        truth = Ts_base_tracker @ scene.T_tracker_camera
        Ts_world_tracker = noisy(T_world_base @ Ts_base_tracker, rng)
        got = invert(base.T_world_base) @ Ts_world_tracker @ mount.T_tracker_camera
        distance_m, angle_rad = pose_difference(got, truth)
        errors.append((np.median(distance_m) * 1e3, np.rad2deg(np.median(angle_rad))))
    middle = np.median(errors, axis=0)
    with capsys.disabled():
        sys.stdout.write(
            f"\nhead camera in the base, 6 calibrations: {middle[0]:.2f} mm, bound 2 | "
            f"{middle[1]:.3f} deg, bound 0.2"
        )
    assert middle[0] <= 2.0
    assert middle[1] <= 0.2
