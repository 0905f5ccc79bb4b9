"""Bridge to OpenVR (SteamVR): poses of Vive trackers, controllers and headsets.

Conventions are those of `openvr.h`: `HmdMatrix34_t` is row-major, right-handed with +x right, +y up
and −z forward, in metres; `eTrackingResult` and `bPoseIsValid` are sent as they are, and a station
uses results of 200 (Running_OK) alone.
"""

import time
from collections.abc import Mapping, Sequence
from types import ModuleType
from typing import Any, Literal

from dextouch.errors import DeviceError
from services.acquisition.clock import StationClock
from services.acquisition.devices.pose_tracker import NOMINAL_RATE_HZ
from services.acquisition.drivers.sdk_link import BridgedDevice, BridgeHello
from services.acquisition.sdk_bridges.source import (
    Y_UP_AXES,
    Pace,
    Reading,
    Source,
    hello,
    import_sdk,
    placed_devices,
    pose_reading,
)

Origin = Literal["standing", "raw"]
INSTALL = "install SteamVR, and `pip install openvr`"
# Devices that are switched on later are looked for so often; asking for all names takes a while.
SCAN_PERIOD_S = 1.0


class OpenVrTrackers(Source):
    """Trackers of a running SteamVR.

    OpenVR has no stamps of measurements: it extrapolates every pose to the moment of the request
    (`GetDeviceToAbsoluteTrackingPose` with 0 s). A reading is stamped with the middle of the call.
    One with the same numbers as the one before is not sent: nothing new was measured.

    Args:
        devices: by the serial number where the device sits.
        origin: `standing`, the play area of the room setup, or `raw`, the driver's own.
        clock: of this host.
    """

    clock = (
        "OpenVR has none; a pose is extrapolated to the request, and stamped on this host's raw "
        "monotonic clock with the middle of the call"
    )

    def __init__(
        self,
        devices: Mapping[str, str],
        *,
        origin: Origin = "standing",
        clock: StationClock | None = None,
    ) -> None:
        super().__init__()
        self._devices = placed_devices(devices)
        self._origin = origin
        self._clock = clock or StationClock()
        self._pace = Pace(NOMINAL_RATE_HZ, self._clock)
        self._longest_call_ns = 0
        self._sdk: ModuleType | None = None
        self._system: Any = None
        self._poses: Any = None
        # By OpenVR's index, which changes from start to start.
        self._found: dict[int, BridgedDevice] = {}
        self._last: dict[str, bytes] = {}
        self._scanned_s = 0.0

    def open(self) -> BridgeHello:
        """Connect to SteamVR, which must run already.

        Raises:
            DeviceError: SteamVR does not run.
            UnavailableError: the Python module is not installed.
        """
        sdk = self._connect()
        self._scan()
        return hello(
            kind="pose_tracker",
            software=f"OpenVR, Python module {getattr(sdk, '__version__', 'openvr')}",
            devices=tuple(self._devices.values()),
            frame=Y_UP_AXES,
        )

    def read(self) -> Sequence[Reading]:
        """The poses of now, 100 times a second.

        Raises:
            DeviceError: SteamVR ends.
        """
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
        self._sdk = sdk = import_sdk("openvr", install=INSTALL)
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

    def _reading(self, index: int, device: BridgedDevice, t_ns: int) -> Reading | None:
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
        return pose_reading(device, t_ns, numbers, result=result, is_valid=is_valid)
