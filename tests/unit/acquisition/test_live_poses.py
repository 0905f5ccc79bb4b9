"""Poses that viewers see: in the world, with the mounts of the calibration, and never old ones."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from dextouch.streams import Sample
from services.acquisition.clock import StationClock
from services.acquisition.devices import build_drivers
from services.acquisition.devices.finger_tracker import FingerTrackerSettings
from services.acquisition.devices.pose_tracker import PoseTrackerSettings
from services.acquisition.station import LiveView

HALF_SECOND_NS = 500_000_000
SETTINGS = [
    PoseTrackerSettings(stream="head", link="bridge", port=1),
    PoseTrackerSettings(stream="wrist_left", link="bridge", port=2),
    FingerTrackerSettings(side="left", link="bridge", port=3),
]


def rigid(rng):
    """A random transform, its rotation by SciPy, and the same as x y z w qx qy qz."""
    rotation, t = Rotation.random(random_state=rng), rng.normal(size=3)
    T = np.eye(4)
    T[:3, :3], T[:3, 3] = rotation.as_matrix(), t
    x, y, z, w = rotation.as_quat()
    return T, np.array([*t, w, x, y, z], dtype=np.float32)


@pytest.fixture
def rng():
    return np.random.default_rng(3)


def view(**calibration):
    matrices = {name: tuple(map(tuple, T)) for name, T in calibration.items()}
    return LiveView(build_drivers(SETTINGS, StationClock()), matrices)


def test_a_body_is_where_its_tracker_and_mount_say(rng):
    T_world_tracker, pose = rigid(rng)
    T_tracker_wrist, _ = rigid(rng)
    for mount in (None, T_tracker_wrist):
        live = view() if mount is None else view(T_tracker_left_wrist_left=mount)
        live.accept({"wrist_left": [Sample(7, pose)]})
        found = live.poses(8)["wrist_left"]
        expected = T_world_tracker if mount is None else T_world_tracker @ mount
        np.testing.assert_allclose(found, expected, atol=1e-5)


def test_keypoints_are_in_wrist_axes(rng):
    points_wrist = rng.normal(size=(25, 3))
    points_wrist[4] = np.nan
    T_keypoints_wrist, _ = rigid(rng)
    R, t = T_keypoints_wrist[:3, :3], T_keypoints_wrist[:3, 3]
    live = view(T_keypoints_left_wrist_left=T_keypoints_wrist)
    measured = (points_wrist @ R.T + t).astype(np.float32)
    live.accept({"keypoints_left": [Sample(7, measured)]})
    np.testing.assert_allclose(live.poses(8)["keypoints_left"], points_wrist, atol=1e-5)


def test_an_old_pose_is_not_shown_but_its_age_is(rng):
    live = view()
    live.accept({"head": [Sample(0, rigid(rng)[1])]})
    kinds = {"pose", "keypoints"}
    assert set(live.poses(HALF_SECOND_NS)) == {"head"}
    assert live.poses(HALF_SECOND_NS + 1) == {}
    ages_s = {"head": 2.0, "wrist_left": None, "keypoints_left": None}
    assert live.ages_s(kinds, 4 * HALF_SECOND_NS) == ages_s


@pytest.mark.parametrize("pose", [[0.0] * 7, [np.nan] * 7])
def test_a_lost_pose_is_none(pose):
    live = view()
    live.accept({"head": [Sample(0, np.array(pose, dtype=np.float32))]})
    assert live.poses(1) == {}
