"""Poses that viewers see: in the world, with the mounts of the calibration, and never old ones."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from dextouch.streams import ClockCapabilities, Sample, StreamDescriptor
from services.acquisition.clock import StationClock
from services.acquisition.devices import build_drivers
from services.acquisition.devices.finger_tracker import FingerTrackerSettings
from services.acquisition.devices.pose_tracker import PoseTrackerSettings
from services.acquisition.station import ArrivalDelay, LiveView

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


def camera_stamps(rng, *, bits, tick_ns, skew, seconds):
    """True times of images at 10 Hz, and the stamps of a counter that wraps, both ns."""
    t_ns = np.arange(round(seconds * 10)) * 100_000_000 + 3_600_000_000_000
    ticks = (t_ns * (1 + skew) + rng.integers(2**bits * tick_ns)) // tick_ns
    return t_ns, (ticks.astype(np.int64) % 2**bits) * tick_ns


def delays_s(bits, tick_ns, arrivals_ns, device_ns):
    capabilities = ClockCapabilities(device_time=True, device_time_bits=bits, tick_ns=tick_ns)
    about = {"kind": "image", "shape": (4, 4, 3), "dtype": "uint8", "unit": "rgb8"}
    named = {"name": "camera_head", "nominal_rate_hz": 10.0, "capabilities": capabilities}
    delay, found = ArrivalDelay(StreamDescriptor.model_validate(about | named)), []
    for t_host_ns, t_device_ns in zip(arrivals_ns, device_ns, strict=True):
        delay.add(Sample(int(t_host_ns), np.zeros(1), int(t_device_ns)))
        found.append(delay.late_ns / 1e9)
    return np.array(found)


@pytest.mark.parametrize(("bits", "tick_ns"), [(32, 1_000), (16, 100_000), (62, 1)])
def test_samples_that_wait_in_a_queue_are_late_by_their_own_clock(rng, bits, tick_ns):
    skew = 1e-4
    t_ns, device_ns = camera_stamps(rng, bits=bits, tick_ns=tick_ns, skew=skew, seconds=400)
    # A queue that grows for ten seconds, stands, and is worked off.
    queue_s = np.interp(t_ns - t_ns[0], [2e11, 2.1e11, 2.2e11, 2.21e11], [0, 5, 5, 0])
    path_s = 0.03 + rng.exponential(0.004, len(t_ns))
    arrivals_ns = t_ns + np.rint(1e9 * (queue_s + path_s)).astype(np.int64)
    found = delays_s(bits, tick_ns, arrivals_ns, device_ns)
    expected = queue_s + path_s - path_s.min()
    np.testing.assert_allclose(found[100:], expected[100:], atol=300 * skew + 0.005)


def test_a_device_that_begins_anew_is_not_late(rng):
    t_ns, device_ns = camera_stamps(rng, bits=62, tick_ns=1, skew=0.0, seconds=10)
    device_ns[50:] -= device_ns[50]
    found = delays_s(62, 1, t_ns + 20_000_000, device_ns)
    np.testing.assert_allclose(found, 0.0, atol=1e-6)


@pytest.mark.parametrize(("bits", "tick_ns", "pause_s"), [(62, 1, 3600), (16, 100_000, 28)])
def test_a_device_that_paused_is_not_late(rng, bits, tick_ns, pause_s):
    t_ns, device_ns = camera_stamps(
        rng, bits=bits, tick_ns=tick_ns, skew=-1e-4, seconds=pause_s + 20
    )
    is_on = (t_ns < t_ns[100]) | (t_ns >= t_ns[-100])
    found = delays_s(bits, tick_ns, t_ns[is_on] + 20_000_000, device_ns[is_on])
    np.testing.assert_allclose(found, 0.0, atol=0.003)
