"""Wrist motion from a tracker strapped on elsewhere."""

import numpy as np

from dextouch.geometry.rotations import rotation_from_vector
from dextouch.geometry.transforms import transform
from dextouch.hands.actions import IDENTITY_POSE_9D, pose_from_9d
from services.alignment.retargeting.wrist import pose_difference, wrist_motion_9d

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
