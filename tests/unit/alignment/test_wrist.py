"""Wrist motion from a tracker strapped on elsewhere."""

import numpy as np
import pytest

from dextouch.errors import InvalidInputError, NonFiniteError, ShapeError
from dextouch.geometry.rotations import rotation_from_vector
from dextouch.geometry.transforms import invert, transform
from dextouch.hands.actions import IDENTITY_POSE_9D, pose_from_9d
from services.alignment.retargeting.wrist import pose_difference, poses_in_base, wrist_motion_9d

RNG = np.random.default_rng(0)


def random_poses(n):
    return transform(rotation_from_vector(RNG.normal(size=(n, 3))), RNG.normal(size=(n, 3)))


def test_motion_does_not_depend_on_where_the_world_is():
    trackers, (mount, moved_world) = random_poses(20), random_poses(2)
    motion = wrist_motion_9d(trackers, T_tracker_wrist=mount)
    again = wrist_motion_9d(moved_world @ trackers, T_tracker_wrist=mount)
    np.testing.assert_allclose(again, motion, atol=1e-12)
    assert motion[0].tolist() == IDENTITY_POSE_9D.tolist()
    wrists = trackers @ mount
    distance_m, angle_rad = pose_difference(wrists[0] @ pose_from_9d(motion), wrists)
    assert distance_m.max() < 1e-12
    assert angle_rad.max() < 1e-7


def test_difference_of_poses_is_in_metres_and_radians():
    shifted = transform(
        rotation_from_vector(np.array([[0.0, 0.3, 0.0]])), np.array([[0.0, 0.4, 0.3]])
    )
    distance_m, angle_rad = pose_difference(np.eye(4)[None], shifted)
    np.testing.assert_allclose((distance_m[0], angle_rad[0]), (0.5, 0.3), atol=1e-12)


def test_a_body_comes_to_the_base_through_tracker_and_world():
    (T_world_base, T_tracker_body), Ts_base_body = random_poses(2), random_poses(5)
    Ts_world_tracker = T_world_base @ Ts_base_body @ invert(T_tracker_body)
    got = poses_in_base(Ts_world_tracker, T_world_base=T_world_base, T_tracker_body=T_tracker_body)
    np.testing.assert_allclose(got, Ts_base_body, atol=1e-12)


@pytest.mark.parametrize(
    ("matrix", "error", "words"),
    [
        (np.eye(3), ShapeError, "got shape"),
        (np.full((4, 4), np.nan), NonFiniteError, "NaN"),
        (np.diag([1.0, 1.0, -1.0, 1.0]), InvalidInputError, "det -1.00"),
        (np.diag([1.001, 1.0, 1.0, 1.0]), InvalidInputError, "no rigid transform"),
        (np.eye(4) * 2 - np.eye(4)[:, ::-1], InvalidInputError, "no rigid transform"),
        (np.diag([1.0, 1.0, 1.0, 2.0]), InvalidInputError, "last row"),
    ],
)
def test_calibrations_that_are_no_transforms_are_refused_by_name(matrix, error, words):
    good, poses = np.eye(4), random_poses(3)
    with pytest.raises(error, match=f"T_world_base.*{words}"):
        poses_in_base(poses, T_world_base=matrix, T_tracker_body=good)
    with pytest.raises(error, match=f"T_tracker_body.*{words}"):
        poses_in_base(poses, T_world_base=good, T_tracker_body=matrix)


def test_poses_that_are_none_are_refused():
    with pytest.raises(ShapeError, match="poses of the tracker"):
        poses_in_base(np.eye(4), T_world_base=np.eye(4), T_tracker_body=np.eye(4))
    with pytest.raises(NonFiniteError, match="poses of the tracker"):
        poses_in_base(np.full((2, 4, 4), np.inf), T_world_base=np.eye(4), T_tracker_body=np.eye(4))
