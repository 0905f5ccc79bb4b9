"""OpenVR's poses at a station, from a fake of the Python module `openvr` with its structures."""

import ctypes
import sys
import types

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from dextouch.errors import DeviceError, UnavailableError
from services.acquisition.clock import StationClock
from services.acquisition.sdk_bridges.lighthouse_trackers import OpenVrTrackers

SERIALS = {2: "LHR-LEFT", 5: "LHR-HEAD", 7: "LHB-BASE"}
RUNNING_OK, OUT_OF_RANGE = 200, 201
# openvr.h: +x right, +y up, −z forward. Our world has z up: a quarter turn about x.
OURS_FROM_OPENVR = Rotation.from_euler("x", 90, degrees=True)


class HmdMatrix34_t(ctypes.Structure):  # noqa: N801 - as in openvr.h
    _fields_ = (("m", (ctypes.c_float * 4) * 3),)


class TrackedDevicePose_t(ctypes.Structure):  # noqa: N801
    _fields_ = (
        ("mDeviceToAbsoluteTracking", HmdMatrix34_t),
        ("vVelocity", ctypes.c_float * 3),
        ("vAngularVelocity", ctypes.c_float * 3),
        ("eTrackingResult", ctypes.c_int),
        ("bPoseIsValid", ctypes.c_bool),
        ("bDeviceIsConnected", ctypes.c_bool),
    )


class FakeOpenVr(types.ModuleType):
    """The module, its one system, and its devices."""

    VRApplication_Background = 3
    k_unMaxTrackedDeviceCount = 64  # noqa: N815
    TrackedDeviceClass_Invalid, TrackedDeviceClass_HMD, TrackedDeviceClass_Controller = 0, 1, 2
    TrackedDeviceClass_GenericTracker, TrackedDeviceClass_TrackingReference = 3, 4
    TrackingUniverseStanding, TrackingUniverseRawAndUncalibrated = 1, 2
    Prop_SerialNumber_String = 1002
    VREvent_Quit = 700
    TrackedDevicePose_t = TrackedDevicePose_t

    class VREvent_t(ctypes.Structure):  # noqa: N801
        _fields_ = (("eventType", ctypes.c_uint32),)

    class OpenVRError(Exception):
        pass

    def __init__(self):
        super().__init__("openvr")
        self.error_code = types.SimpleNamespace(OpenVRError=self.OpenVRError)
        self.is_running, self.quits, self.origins, self.num_shutdowns = True, 0, set(), 0
        # Pose of each device: rotation and position in OpenVR's axes, result, valid, connected.
        self.poses = {
            index: [Rotation.identity(), np.zeros(3), RUNNING_OK, True, True] for index in SERIALS
        }
        self.moves = True
        self.count = 0

    def init(self, application):
        assert application == self.VRApplication_Background
        if not self.is_running:
            raise self.OpenVRError("VRInitError_Init_NoServerForBackgroundApp")
        return self

    def shutdown(self):
        self.num_shutdowns += 1

    def pollNextEvent(self, event):  # noqa: N802
        event.eventType = self.VREvent_Quit if self.quits else 0
        self.quits, is_event = max(0, self.quits - 1), bool(self.quits)
        return is_event

    def acknowledgeQuit_Exiting(self):  # noqa: N802
        self.is_running = False

    def getTrackedDeviceClass(self, index):  # noqa: N802
        return {2: 3, 5: 1, 7: 4}.get(index, 0)

    def getStringTrackedDeviceProperty(self, index, prop):  # noqa: N802
        assert prop == self.Prop_SerialNumber_String
        return SERIALS[index]

    def getDeviceToAbsoluteTrackingPose(self, origin, seconds, poses):  # noqa: N802
        assert seconds == 0.0
        self.origins.add(origin)
        self.count += self.moves
        for index, (R, t, result, is_valid, is_connected) in self.poses.items():
            pose = poses[index]
            numbers = np.column_stack([R.as_matrix(), t])
            for row in range(3):
                pose.mDeviceToAbsoluteTracking.m[row][:] = numbers[row].tolist()
            # A tracker's noise: no two measurements are alike.
            pose.vVelocity[0] = 1e-6 * self.count
            pose.eTrackingResult, pose.bPoseIsValid = result, is_valid
            pose.bDeviceIsConnected = is_connected


@pytest.fixture
def openvr(monkeypatch):
    fake = FakeOpenVr()
    monkeypatch.setitem(sys.modules, "openvr", fake)
    return fake


def expected_pose(R, t):
    """By scipy: the pose of the same body in a world with z up."""
    x, y, z, w = (OURS_FROM_OPENVR * R * OURS_FROM_OPENVR.inv()).as_quat()
    return np.array([*OURS_FROM_OPENVR.apply(t), w, x, y, z])


def assert_same_pose(got, expected):
    np.testing.assert_allclose(got[:3], expected[:3], atol=1e-6)
    assert abs(abs(got[3:] @ expected[3:]) - 1.0) < 1e-6


def test_axes_of_the_header(openvr, serve, connect, read):
    # One metre up, two to the right, three forward; turned by 90° about the vertical.
    turn = Rotation.from_euler("y", 90, degrees=True)
    openvr.poses[2][:2] = turn, np.array([2.0, 1.0, -3.0])
    port = serve(OpenVrTrackers({"LHR-LEFT": "left"})).port
    driver = connect(kind="pose_tracker", stream="wrist_left", port=port)
    (sample, *_) = read(driver)
    half = np.sqrt(0.5)
    # In a world with z up: right is x, forward is y, and the vertical is z.
    assert_same_pose(sample.values, np.array([2.0, 3.0, 1.0, half, 0.0, 0.0, half]))


@pytest.mark.parametrize("seed", range(3))
def test_any_pose_is_the_one_of_scipy(openvr, serve, connect, read, seed):
    rng = np.random.default_rng(seed)
    R, t = Rotation.random(random_state=rng), rng.normal(size=3)
    openvr.poses[2][:2] = R, t
    port = serve(OpenVrTrackers({"LHR-LEFT": "left"}, origin="raw")).port
    driver = connect(kind="pose_tracker", stream="wrist_left", port=port)
    for sample in read(driver, 3):
        assert_same_pose(sample.values, expected_pose(R, t))
    assert openvr.origins == {openvr.TrackingUniverseRawAndUncalibrated}


def test_stamps_are_on_the_clock_of_the_station(openvr, serve, connect, read):
    port = serve(OpenVrTrackers({"LHR-LEFT": "left"})).port
    driver = connect(kind="pose_tracker", stream="wrist_left", port=port)
    before_ns = StationClock().now_ns()
    stamps_ns = [sample.t_device_ns for sample in read(driver, 5)][1:]
    # The first may have waited for the station; float64 seconds keep microseconds for centuries.
    assert before_ns - 10**9 <= stamps_ns[0] < stamps_ns[-1] <= StationClock().now_ns()


@pytest.mark.parametrize(("result", "is_valid"), [(OUT_OF_RANGE, True), (RUNNING_OK, False)])
def test_an_untracked_pose_is_no_sample(openvr, serve, connect, read, result, is_valid):
    openvr.poses[2][2:4] = result, is_valid
    port = serve(OpenVrTrackers({"LHR-LEFT": "left"})).port
    driver = connect(kind="pose_tracker", stream="wrist_left", port=port)

    def back_after_five():
        if driver.decoder.tracking["occluded"] >= 5:
            openvr.poses[2][2:4] = RUNNING_OK, True

    read(driver, after=back_after_five)
    assert driver.decoder.tracking["occluded"] >= 5


def test_unchanged_and_disconnected_poses_are_not_sent(openvr, serve, connect, read, until):
    source = OpenVrTrackers({"LHR-LEFT": "left", "LHR-HEAD": "head"})
    openvr.poses[5][4] = False
    bridge = serve(source)
    driver = connect(kind="pose_tracker", stream="wrist_left", port=bridge.port)
    read(driver, 3)
    openvr.moves = False
    until(lambda: source.not_sent["unchanged"] >= 5, driver.read)
    summary = bridge.end()
    assert summary.not_sent["unchanged"] >= 5
    assert summary.not_sent["disconnected"] >= 8
    assert summary.sent["LHR-LEFT"] >= 3
    assert summary.sent["LHR-HEAD"] == 0


async def test_two_trackers_at_the_route_of_a_station(openvr, serve, live_poses):
    rng = np.random.default_rng(8)
    for index in (2, 5):
        openvr.poses[index][:2] = Rotation.random(random_state=rng), rng.normal(size=3)
    port = serve(OpenVrTrackers({"LHR-LEFT": "left", "LHR-HEAD": "head"})).port
    found = await live_poses(
        {"kind": "pose_tracker", "stream": "wrist_left", "port": port},
        {"kind": "pose_tracker", "stream": "head", "port": port, "serial_number": "LHR-HEAD"},
        streams=("wrist_left", "head"),
    )
    for stream, index in (("wrist_left", 2), ("head", 5)):
        R, t = openvr.poses[index][:2]
        np.testing.assert_allclose(found[stream][:3, 3], OURS_FROM_OPENVR.apply(t), atol=1e-6)
        ours = OURS_FROM_OPENVR * R * OURS_FROM_OPENVR.inv()
        np.testing.assert_allclose(found[stream][:3, :3], ours.as_matrix(), atol=1e-6)


def test_steamvr_that_ends_is_waited_for(openvr, serve, connect, read):
    openvr.is_running = False
    bridge = serve(OpenVrTrackers({"LHR-LEFT": "left"}))
    assert "start it" in bridge.until_said("cannot be reached")
    openvr.is_running = True
    driver = connect(kind="pose_tracker", stream="wrist_left", port=bridge.port)
    read(driver)
    openvr.quits = 1
    bridge.until_said("SteamVR ends")
    openvr.is_running = True
    # The station stays connected: there were signs of life.
    read(driver, 2)
    assert driver.statistics.restarts == 0
    assert openvr.num_shutdowns >= 1


def test_devices_are_listed(openvr):
    assert OpenVrTrackers({}).present() == [
        "LHR-LEFT (tracker)",
        "LHR-HEAD (headset)",
        "LHB-BASE (base station)",
    ]


def test_our_structures_are_those_of_the_real_module():
    real = pytest.importorskip("openvr", reason="openvr is not installed (extra `bridges`)")
    for ours, theirs in (
        (HmdMatrix34_t, real.HmdMatrix34_t),
        (TrackedDevicePose_t, real.TrackedDevicePose_t),
    ):
        assert ctypes.sizeof(ours) == ctypes.sizeof(theirs)
        for name, _ in ours._fields_:
            assert getattr(ours, name).offset == getattr(theirs, name).offset, name
    assert real.VRApplication_Background == FakeOpenVr.VRApplication_Background
    assert real.TrackingResult_Running_OK == RUNNING_OK
    for name in vars(FakeOpenVr):
        if name.startswith(("TrackedDeviceClass", "TrackingUniverse", "Prop_", "VREvent_Q", "k_")):
            assert getattr(real, name) == getattr(FakeOpenVr, name), name
    for name in ("pollNextEvent", "acknowledgeQuit_Exiting", "getTrackedDeviceClass"):
        assert callable(getattr(real.IVRSystem, name))
    # Without SteamVR it refuses by an error that we know.
    assert issubclass(real.error_code.InitError, real.error_code.OpenVRError)


def test_a_missing_module_is_said_with_the_remedy(monkeypatch):
    monkeypatch.setitem(sys.modules, "openvr", None)
    with pytest.raises(UnavailableError, match="install SteamVR, and `pip install openvr`"):
        OpenVrTrackers({"LHR-LEFT": "left"}).open()


def test_steamvr_that_does_not_run_is_another_try(openvr):
    openvr.is_running = False
    with pytest.raises(DeviceError, match="NoServerForBackgroundApp"):
        OpenVrTrackers({"LHR-LEFT": "left"}).open()
