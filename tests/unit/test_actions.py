"""The 67-D action: layout, invariance under a global transform, re-anchoring round trips."""

import numpy as np
import pytest

from dextouch.errors import NonFiniteError, ShapeError
from dextouch.geometry import transform
from dextouch.geometry.rotations import rotation_from_vector
from dextouch.hands import actions as act
from dextouch.hands.robot_hand import RobotHand


def random_transforms(rng, count):
    return transform(rotation_from_vector(rng.normal(size=(count, 3))), rng.normal(size=(count, 3)))


@pytest.fixture
def trajectory():
    rng = np.random.default_rng(7)
    return act.HandTrajectory(
        random_transforms(rng, 12),
        random_transforms(rng, 12),
        rng.normal(size=(12, 20)),
        rng.normal(size=(12, 20)),
        random_transforms(rng, 12),
    )


def moved(trajectory, T):
    return act.HandTrajectory(
        T @ trajectory.Ts_world_wrist_left,
        T @ trajectory.Ts_world_wrist_right,
        trajectory.joints_left_rad,
        trajectory.joints_right_rad,
        T @ trajectory.Ts_world_camera_head,
    )


def test_first_step_is_exactly_the_identity(trajectory):
    relative = act.relative_pose_9d(trajectory.Ts_world_wrist_left)
    assert relative[0].tolist() == [0, 0, 0, 1, 0, 0, 0, 1, 0]


def test_actions_do_not_see_a_global_transform(trajectory):
    T = random_transforms(np.random.default_rng(1), 1)[0]
    other = moved(trajectory, T)
    np.testing.assert_allclose(
        act.actions_from_poses(other, other.anchor(0)),
        act.actions_from_poses(trajectory, trajectory.anchor(0)),
        atol=1e-9,
    )


def test_poses_come_back(trajectory):
    actions = act.actions_from_poses(trajectory, trajectory.anchor(0))
    back = act.poses_from_actions(actions, trajectory.anchor(0))
    np.testing.assert_allclose(
        back.Ts_world_wrist_right, trajectory.Ts_world_wrist_right, atol=1e-9
    )
    np.testing.assert_allclose(
        back.Ts_world_camera_head, trajectory.Ts_world_camera_head, atol=1e-9
    )
    np.testing.assert_array_equal(back.joints_left_rad, trajectory.joints_left_rad)


def test_reanchoring_equals_building_there_and_comes_back(trajectory):
    actions = act.actions_from_poses(trajectory, trajectory.anchor(0))
    there = act.reanchor(actions, 5)
    np.testing.assert_allclose(
        there, act.actions_from_poses(trajectory, trajectory.anchor(5)), atol=1e-9
    )
    np.testing.assert_allclose(act.reanchor(there, 0), actions, atol=1e-9)


def test_commanded_actions_take_the_measured_anchor(trajectory):
    measured = act.actions_from_poses(trajectory, trajectory.anchor(0))
    commanded = measured + 0.0
    commanded[:, 0] += 0.01
    got = act.reanchor(commanded, 4, anchor_action=measured[4])
    poses = act.poses_from_actions(commanded, trajectory.anchor(0))
    np.testing.assert_allclose(got, act.actions_from_poses(poses, trajectory.anchor(4)), atol=1e-9)


@pytest.mark.parametrize("shape", [(0, 67), (3, 66), (67,)])
def test_wrong_shapes_are_refused(shape):
    with pytest.raises(ShapeError):
        act.check_actions(np.zeros(shape))


def test_nan_is_refused_and_named():
    actions = np.zeros((4, 67))
    actions[2, 10] = np.nan
    with pytest.raises(NonFiniteError, match="row 2, column 10"):
        act.check_actions(actions)


@pytest.mark.parametrize("side", ["left", "right"])
def test_fingers_flex_towards_the_palm(side):
    hand = RobotHand(side)
    q = np.zeros((2, 20))
    q[1, 4::4] = 0.5
    tips = hand.fingertips_m(q)
    palm = 1.0 if side == "right" else -1.0
    assert (palm * (tips[1, 1:, 1] - tips[0, 1:, 1]) > 0.03).all()
    assert hand.joint_names[4].endswith("index_finger_mcp_flex")
    # Wrist-to-tip distances at zero, from the maker's table (research anchor, mm).
    np.testing.assert_allclose(
        np.linalg.norm(tips[0], axis=1) * 1e3, [132.5, 179.3, 180.6, 174.3, 164.7], atol=1.0
    )
