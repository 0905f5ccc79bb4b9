"""Bridges to lighthouse trackers: poses from OpenVR (SteamVR), or from libsurvive without SteamVR.

OpenVR's conventions are those of `openvr.h`: `HmdMatrix34_t` is row-major, right-handed with +x
right, +y up and −z forward, in metres; `eTrackingResult` and `bPoseIsValid` are sent as they are,
and a station uses results of 200 (Running_OK) alone.

libsurvive is used by the C functions of `survive_api.h` by ctypes, as the Python module pysurvive
does. `SurvivePose` holds x y z in metres and the quaternion w x y z, as doubles; the world is
right-handed with z up; `survive_simple_object_get_latest_pose` returns seconds.
"""

import ctypes
import time
from collections.abc import Mapping, Sequence
from types import ModuleType
from typing import Any, Literal

import numpy as np

from dextouch.errors import DeviceError
from dextouch.geometry.rotations import rotation_from_quaternion
from services.acquisition.devices.pose_tracker import (
    NOMINAL_RATE_HZ,
    NORM_TOLERANCE,
    TrackingResult,
)
from services.acquisition.drivers.sdk_link import BridgedDevice, BridgeHello
from services.acquisition.sdk_bridges import bridge

Origin = Literal["standing", "raw"]
OPENVR_INSTALL = "install SteamVR, and `pip install openvr`"
# Devices that are switched on later are looked for so often; asking for all names takes a while.
SCAN_PERIOD_S = 1.0
LIBSURVIVE = "libsurvive.so"
LIBSURVIVE_INSTALL = (
    "build it (https://github.com/cntools/libsurvive), and name the library with --library, such "
    "as /usr/local/lib/libsurvive.so"
)
# Updates of one object are not queued: the newest replaces one that was not fetched. Lighthouse
# sweeps and IMU updates come every 4 ms or more rarely.
POLL_S = 0.001
# Chosen: read returns so often, so that the bridge can end.
READ_S = 0.02
# Chosen: libsurvive learns of devices as it reads their configuration, within a second or two.
LIST_S = 3.0
_NO_POSE = (1.0, 0.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 0.0, 1.0, 0.0)
# `SurvivePose` (LinmathPose) of a build in double precision, which is the default.
SurvivePose = bridge.structure("SurvivePose", Pos=ctypes.c_double * 3, Rot=ctypes.c_double * 4)
FUNCTIONS: bridge.Functions = {
    "survive_simple_init": (
        ctypes.c_void_p,
        (ctypes.c_int, ctypes.POINTER(ctypes.c_char_p)),
    ),
    "survive_simple_start_thread": (None, (ctypes.c_void_p,)),
    "survive_simple_close": (None, (ctypes.c_void_p,)),
    "survive_simple_is_running": (ctypes.c_bool, (ctypes.c_void_p,)),
    "survive_simple_get_first_object": (ctypes.c_void_p, (ctypes.c_void_p,)),
    "survive_simple_get_next_object": (ctypes.c_void_p, (ctypes.c_void_p, ctypes.c_void_p)),
    "survive_simple_get_next_updated": (ctypes.c_void_p, (ctypes.c_void_p,)),
    "survive_simple_object_get_latest_pose": (
        ctypes.c_double,
        (ctypes.c_void_p, ctypes.POINTER(SurvivePose)),
    ),
    "survive_simple_object_name": (ctypes.c_char_p, (ctypes.c_void_p,)),
    "survive_simple_serial_number": (ctypes.c_char_p, (ctypes.c_void_p,)),
}


class OpenVrTrackers(bridge.Source):
    """Trackers of a running SteamVR.

    OpenVR has no stamps of measurements: it extrapolates every pose to the moment of the request
    (`GetDeviceToAbsoluteTrackingPose` with 0 s). A reading is stamped with the middle of the call.
    One with the same numbers as the one before is not sent: nothing new was measured.

    Args:
        devices: by the serial number where the device sits.
        origin: `standing`, the play area of the room setup, or `raw`, the driver's own.
    """

    clock = (
        "OpenVR has none; a pose is extrapolated to the request, and stamped on this host's raw "
        "monotonic clock with the middle of the call"
    )

    def __init__(self, devices: Mapping[str, str], *, origin: Origin = "standing") -> None:
        super().__init__()
        self._devices = bridge.placed_devices(devices)
        self._origin = origin
        self._pace = bridge.Pace(NOMINAL_RATE_HZ, self._clock)
        self._longest_call_ns = 0
        self._sdk: ModuleType | None = None
        self._system: Any = None
        self._poses: Any = None
        # By OpenVR's index, which changes from start to start.
        self._found: dict[int, BridgedDevice] = {}
        self._last: dict[str, bytes] = {}
        self._scanned_s = 0.0

    def open(self) -> BridgeHello:
        """Connect to SteamVR, which must run already."""
        sdk = self._connect()
        self._scan()
        return bridge.hello(
            kind="pose_tracker",
            software=f"OpenVR, Python module {getattr(sdk, '__version__', 'openvr')}",
            devices=tuple(self._devices.values()),
            frame=bridge.Y_UP_AXES,
        )

    def read(self) -> Sequence[bridge.Reading]:
        """The poses of now, 100 times a second."""
        sdk, system = self._opened()
        self._pace.wait()
        event = sdk.VREvent_t()
        while system.pollNextEvent(event):
            if event.eventType == sdk.VREvent_Quit:
                system.acknowledgeQuit_Exiting()
                raise DeviceError("OpenVR: SteamVR ends; start it again")
        if time.monotonic() - self._scanned_s > SCAN_PERIOD_S:
            self._scan()
        is_raw = self._origin == "raw"
        origin = sdk.TrackingUniverseRawAndUncalibrated if is_raw else sdk.TrackingUniverseStanding
        before_ns = self._clock.now_ns()
        system.getDeviceToAbsoluteTrackingPose(origin, 0.0, self._poses)
        after_ns = self._clock.now_ns()
        self._longest_call_ns = max(self._longest_call_ns, after_ns - before_ns)
        t_ns = (before_ns + after_ns) // 2
        readings = (self._reading(index, device, t_ns) for index, device in self._found.items())
        return [reading for reading in readings if reading is not None]

    def close(self) -> None:
        """Disconnect."""
        if self._sdk is not None and self._system is not None:
            self._sdk.shutdown()
        self._system = None
        self._last.clear()

    def present(self) -> list[str]:
        """Serial number and class of every device that SteamVR knows."""
        sdk = self._connect()
        names = {
            sdk.TrackedDeviceClass_HMD: "headset",
            sdk.TrackedDeviceClass_Controller: "controller",
            sdk.TrackedDeviceClass_GenericTracker: "tracker",
            sdk.TrackedDeviceClass_TrackingReference: "base station",
        }
        try:
            return [
                f"{self._serial_number(index)} ({names.get(kind, 'other')})"
                for index, kind in self._classes().items()
            ]
        finally:
            self.close()

    def report(self) -> list[str]:
        """How long OpenVR took."""
        return [f"longest call of OpenVR: {self._longest_call_ns / 1e6:.2f} ms"]

    def _connect(self) -> ModuleType:
        self._sdk = sdk = bridge.import_sdk("openvr", install=OPENVR_INSTALL)
        try:
            # As a background application, which does not start SteamVR.
            self._system = sdk.init(sdk.VRApplication_Background)
        except sdk.error_code.OpenVRError as error:
            raise DeviceError(
                f"OpenVR: SteamVR cannot be reached ({type(error).__name__} {error}); start it"
            ) from error
        self._poses = (sdk.TrackedDevicePose_t * sdk.k_unMaxTrackedDeviceCount)()
        return sdk

    def _opened(self) -> tuple[ModuleType, Any]:
        if self._sdk is None or self._system is None:
            raise DeviceError("OpenVR: not connected; open it first")
        return self._sdk, self._system

    def _serial_number(self, index: int) -> str:
        sdk, system = self._opened()
        try:
            return str(system.getStringTrackedDeviceProperty(index, sdk.Prop_SerialNumber_String))
        except sdk.error_code.OpenVRError:  # it has just been switched off
            return ""

    def _classes(self) -> dict[int, int]:
        """Class of every device by its index."""
        sdk, system = self._opened()
        classes = {
            index: system.getTrackedDeviceClass(index)
            for index in range(sdk.k_unMaxTrackedDeviceCount)
        }
        return {i: kind for i, kind in classes.items() if kind != sdk.TrackedDeviceClass_Invalid}

    def _scan(self) -> None:
        self._scanned_s = time.monotonic()
        serials = {index: self._serial_number(index) for index in self._classes()}
        self._found = {
            index: self._devices[serial]
            for index, serial in serials.items()
            if serial in self._devices
        }

    def _reading(self, index: int, device: BridgedDevice, t_ns: int) -> bridge.Reading | None:
        pose = self._poses[index]
        if not pose.bDeviceIsConnected:
            self.not_sent["disconnected"] += 1
            return None
        numbers = [float(number) for row in pose.mDeviceToAbsoluteTracking.m for number in row]
        result, is_valid = int(pose.eTrackingResult), bool(pose.bPoseIsValid)
        measured = bytes(pose)
        if self._last.get(device.serial_number) == measured:
            self.not_sent["unchanged"] += 1
            return None
        self._last[device.serial_number] = measured
        return bridge.pose_reading(device, t_ns, numbers, result=result, is_valid=is_valid)


class LibsurviveTrackers(bridge.Source):
    """Trackers of libsurvive, which this process runs.

    libsurvive gives a pose only after an update, and none while a tracker is not seen. A pose whose
    quaternion is not of unit length (before the first solution it is zero) is sent as not tracked.

    Args:
        devices: by the serial number (`LHR-…`) or libsurvive's name (`T20`, `WM0`, `HMD`) where the
            device sits.
        library: name or path of the shared library.
        arguments: for libsurvive, such as `--lighthouse-gen=2` or `--simulator`.
    """

    clock = (
        "each tracker's own 48 MHz counter, which libsurvive shifts by a running mean to its time "
        "of reception, in µs"
    )
    has_station_time = False

    def __init__(
        self,
        devices: Mapping[str, str],
        *,
        library: str = LIBSURVIVE,
        arguments: Sequence[str] = (),
    ) -> None:
        super().__init__()
        self._devices = bridge.placed_devices(devices)
        self._path, self._arguments = library, ("dextouch", *arguments)
        self._library: ctypes.CDLL | None = None
        self._context: int | None = None
        # By libsurvive's pointer; None of objects that are not served.
        self._found: dict[int, BridgedDevice | None] = {}

    def open(self) -> BridgeHello:
        """Start libsurvive."""
        self._start()
        return bridge.hello(
            kind="pose_tracker",
            software=f"libsurvive, {self._path}",
            devices=tuple(self._devices.values()),
            frame=bridge.OUR_AXES,
        )

    def read(self) -> Sequence[bridge.Reading]:
        """Poses of updated trackers."""
        library, context = self._opened()
        readings = []
        end_s = time.monotonic() + READ_S
        while time.monotonic() < end_s:
            updated = library.survive_simple_get_next_updated(context)
            if updated:
                device = self._device(updated)
                if device is not None:
                    readings.append(self._reading(updated, device))
                continue
            if readings:
                break
            if not library.survive_simple_is_running(context):
                raise DeviceError("libsurvive: has ended; see what it printed")
            time.sleep(POLL_S)
        return readings

    def close(self) -> None:
        """End libsurvive."""
        if self._library is not None and self._context:
            self._library.survive_simple_close(self._context)
        self._context = None
        self._found.clear()

    def present(self) -> list[str]:
        """Serial number and name of every object that libsurvive finds in its first seconds."""
        self._start()
        library, context = self._opened()
        try:
            time.sleep(LIST_S)
            names = []
            found = library.survive_simple_get_first_object(context)
            while found:
                serial, name = self._names(found)
                names.append(f"{serial or '(no serial number)'} ({name})")
                found = library.survive_simple_get_next_object(context, found)
            return names
        finally:
            self.close()

    def _start(self) -> None:
        self._library = library = bridge.load_library(
            self._path, FUNCTIONS, install=LIBSURVIVE_INSTALL
        )
        words = [word.encode() for word in self._arguments]
        argv = (ctypes.c_char_p * (len(words) + 1))(*words)
        self._context = library.survive_simple_init(len(words), argv)
        if not self._context:
            raise DeviceError(
                "libsurvive: does not start; is another program (SteamVR) using the dongles, and "
                "may this user open them (udev rules of libsurvive)?"
            )
        library.survive_simple_start_thread(self._context)

    def _opened(self) -> tuple[ctypes.CDLL, int]:
        if self._library is None or not self._context:
            raise DeviceError("libsurvive: not started; open it first")
        return self._library, self._context

    def _names(self, found: int) -> tuple[str, str]:
        library, _ = self._opened()
        serial = library.survive_simple_serial_number(found) or b""
        name = library.survive_simple_object_name(found) or b""
        return serial.decode(errors="replace"), name.decode(errors="replace")

    def _device(self, updated: int) -> BridgedDevice | None:
        if updated not in self._found:
            serial, name = self._names(updated)
            self._found[updated] = self._devices.get(serial) or self._devices.get(name)
        return self._found[updated]

    def _reading(self, updated: int, device: BridgedDevice) -> bridge.Reading:
        library, _ = self._opened()
        pose = SurvivePose()
        seconds = library.survive_simple_object_get_latest_pose(updated, ctypes.byref(pose))
        t_ns = round(seconds * 1e9)
        position, q_wxyz = np.array(pose.Pos), np.array(pose.Rot)
        is_pose = np.isfinite(position).all() and (
            abs(float(np.linalg.norm(q_wxyz)) - 1.0) <= NORM_TOLERANCE
        )
        if not is_pose:
            return bridge.pose_reading(
                device, t_ns, _NO_POSE, result=TrackingResult.UNINITIALIZED, is_valid=False
            )
        T = np.column_stack([rotation_from_quaternion(q_wxyz), position])
        return bridge.pose_reading(device, t_ns, T.ravel().tolist())
