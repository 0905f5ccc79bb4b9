"""Bridge to libsurvive: poses of lighthouse trackers without SteamVR.

It uses the C functions of `survive_api.h` by ctypes, as the Python module pysurvive does.
`SurvivePose` holds x y z in metres and the quaternion w x y z, as doubles; the world is
right-handed with z up; `survive_simple_object_get_latest_pose` returns seconds.
"""

import ctypes
import time
from collections.abc import Mapping, Sequence

import numpy as np

from dextouch.errors import DeviceError
from dextouch.geometry.rotations import rotation_from_quaternion
from services.acquisition.devices.pose_tracker import NORM_TOLERANCE, TrackingResult
from services.acquisition.drivers.sdk_link import BridgedDevice, BridgeHello
from services.acquisition.sdk_bridges.source import (
    OUR_AXES,
    Functions,
    Reading,
    Source,
    hello,
    load_library,
    placed_devices,
    pose_reading,
)

LIBRARY = "libsurvive.so"
INSTALL = (
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


class SurvivePose(ctypes.Structure):
    """`SurvivePose` (LinmathPose) of a build in double precision, which is the default."""

    _fields_ = (("Pos", ctypes.c_double * 3), ("Rot", ctypes.c_double * 4))


FUNCTIONS: Functions = {
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


class LibsurviveTrackers(Source):
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
        library: str = LIBRARY,
        arguments: Sequence[str] = (),
    ) -> None:
        super().__init__()
        self._devices = placed_devices(devices)
        self._path, self._arguments = library, ("dextouch", *arguments)
        self._library: ctypes.CDLL | None = None
        self._context: int | None = None
        # By libsurvive's pointer; None of objects that are not served.
        self._found: dict[int, BridgedDevice | None] = {}

    def open(self) -> BridgeHello:
        """Start libsurvive.

        Raises:
            DeviceError: it does not start.
            UnavailableError: the library is not there.
        """
        self._start()
        return hello(
            kind="pose_tracker",
            software=f"libsurvive, {self._path}",
            devices=tuple(self._devices.values()),
            frame=OUR_AXES,
        )

    def read(self) -> Sequence[Reading]:
        """Poses of updated trackers.

        Raises:
            DeviceError: libsurvive has ended.
        """
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
        self._library = library = load_library(self._path, FUNCTIONS, install=INSTALL)
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

    def _reading(self, updated: int, device: BridgedDevice) -> Reading:
        library, _ = self._opened()
        pose = SurvivePose()
        seconds = library.survive_simple_object_get_latest_pose(updated, ctypes.byref(pose))
        t_ns = round(seconds * 1e9)
        position, q_wxyz = np.array(pose.Pos), np.array(pose.Rot)
        is_pose = np.isfinite(position).all() and (
            abs(float(np.linalg.norm(q_wxyz)) - 1.0) <= NORM_TOLERANCE
        )
        if not is_pose:
            return pose_reading(
                device, t_ns, _NO_POSE, result=TrackingResult.UNINITIALIZED, is_valid=False
            )
        T = np.column_stack([rotation_from_quaternion(q_wxyz), position])
        return pose_reading(device, t_ns, T.ravel().tolist())
