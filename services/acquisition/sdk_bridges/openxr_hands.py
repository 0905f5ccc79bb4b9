"""Bridge to OpenXR hand tracking: the 26 joints of `XR_EXT_hand_tracking`.

The OpenXR loader is called by ctypes; structures and numbers are those of `openxr.h` 1.0. The
session is headless (`XR_MND_headless`): nothing is drawn.

Conventions (OpenXR specification): right-handed, +x right, +y up, −z forward, metres; quaternions
are x y z w. In the axes of the wrist joint −z points to the fingers and +y out of the back of the
hand, so +x points to the thumb of a left hand and to the little finger of a right one.
"""

import ctypes
import time
from collections.abc import Sequence
from ctypes import POINTER, byref, c_char, c_char_p, c_float, c_int, c_int64, c_uint32, c_uint64
from typing import Any, Final

import numpy as np

from dextouch.errors import DeviceError
from dextouch.hands import NODES
from dextouch.tactile.layout import SIDES, Side
from services.acquisition.clock import station_offset_ns
from services.acquisition.devices.finger_tracker import NOMINAL_RATE_HZ
from services.acquisition.drivers.sdk_link import BridgeHello
from services.acquisition.sdk_bridges import bridge

LIBRARY = "libopenxr_loader.so.1"
INSTALL = "install it (Debian: apt install libopenxr-loader1), or name it with --library"
EXTENSIONS = (b"XR_EXT_hand_tracking", b"XR_MND_headless", b"XR_KHR_convert_timespec_time")
NUM_JOINTS, WRIST_JOINT = 26, 1
# The palm comes first and is no keypoint; the other joints are in the order of ours.
KEYPOINT_JOINTS = slice(1, NUM_JOINTS)
POSITION_VALID, ORIENTATION_VALID = 0x2, 0x1
POSITION_TRACKED, ORIENTATION_TRACKED = 0x8, 0x4
# Signs from the wrist joint's axes to ours, whose +x points to the thumb and whose +y points out of
# the palm of a right hand and out of the back of a left one: half a turn about z, or none.
OUR_SIGNS: Final[dict[Side, tuple[float, float, float]]] = {
    "left": (1.0, 1.0, 1.0),
    "right": (-1.0, -1.0, 1.0),
}
HANDS: Final[dict[Side, int]] = {"left": 1, "right": 2}
TYPE_INSTANCE, TYPE_SYSTEM, TYPE_SESSION, TYPE_BEGIN = 3, 4, 8, 10
TYPE_EVENT, TYPE_INSTANCE_LOSS, TYPE_STATE_CHANGED, TYPE_SPACE = 16, 17, 18, 37
TYPE_TRACKER, TYPE_LOCATE, TYPE_LOCATIONS = 1000051001, 1000051002, 1000051003
HEAD_MOUNTED_DISPLAY, PRIMARY_STEREO, LOCAL_SPACE = 1, 2, 2
STATE_READY, STATE_STOPPING, STATE_LOSS_PENDING, STATE_EXITING = 2, 6, 7, 8
EVENT_UNAVAILABLE = 4
API_VERSION_1_0 = 1 << 48
Handle = c_uint64


def _typed(name: str, **fields: object) -> type[ctypes.Structure]:
    """A structure that begins with its type, as all that the functions take."""
    return bridge.structure(name, type=c_int, next=ctypes.c_void_p, **fields)


ApplicationInfo = bridge.structure(
    "XrApplicationInfo",
    applicationName=c_char * 128,
    applicationVersion=c_uint32,
    engineName=c_char * 128,
    engineVersion=c_uint32,
    apiVersion=c_uint64,
)
InstanceCreateInfo = _typed(
    "XrInstanceCreateInfo",
    createFlags=c_uint64,
    applicationInfo=ApplicationInfo,
    enabledApiLayerCount=c_uint32,
    enabledApiLayerNames=POINTER(c_char_p),
    enabledExtensionCount=c_uint32,
    enabledExtensionNames=POINTER(c_char_p),
)
SystemGetInfo = _typed("XrSystemGetInfo", formFactor=c_int)
# Without a graphics binding, as headless sessions are.
SessionCreateInfo = _typed("XrSessionCreateInfo", createFlags=c_uint64, systemId=c_uint64)
SessionBeginInfo = _typed("XrSessionBeginInfo", primaryViewConfigurationType=c_int)
# Quaternion x y z w, then position.
Posef = bridge.structure("XrPosef", orientation=c_float * 4, position=c_float * 3)
ReferenceSpaceCreateInfo = _typed(
    "XrReferenceSpaceCreateInfo", referenceSpaceType=c_int, poseInReferenceSpace=Posef
)
# It holds an event of any kind.
EventDataBuffer = _typed("XrEventDataBuffer", varying=ctypes.c_uint8 * 4000)
SessionStateChanged = _typed(
    "XrEventDataSessionStateChanged", session=Handle, state=c_int, time=c_int64
)
HandTrackerCreateInfo = _typed("XrHandTrackerCreateInfoEXT", hand=c_int, handJointSet=c_int)
HandJointsLocateInfo = _typed("XrHandJointsLocateInfoEXT", baseSpace=Handle, time=c_int64)
HandJointLocation = bridge.structure(
    "XrHandJointLocationEXT", locationFlags=c_uint64, pose=Posef, radius=c_float
)
HandJointLocations = _typed(
    "XrHandJointLocationsEXT",
    isActive=c_uint32,
    jointCount=c_uint32,
    jointLocations=POINTER(HandJointLocation),
)
Timespec = bridge.structure("timespec", tv_sec=ctypes.c_long, tv_nsec=ctypes.c_long)
FUNCTIONS: bridge.Functions = {
    "xrCreateInstance": (c_int, (POINTER(InstanceCreateInfo), POINTER(Handle))),
    "xrDestroyInstance": (c_int, (Handle,)),
    "xrGetSystem": (c_int, (Handle, POINTER(SystemGetInfo), POINTER(c_uint64))),
    "xrCreateSession": (c_int, (Handle, POINTER(SessionCreateInfo), POINTER(Handle))),
    "xrBeginSession": (c_int, (Handle, POINTER(SessionBeginInfo))),
    "xrCreateReferenceSpace": (c_int, (Handle, POINTER(ReferenceSpaceCreateInfo), POINTER(Handle))),
    "xrPollEvent": (c_int, (Handle, POINTER(EventDataBuffer))),
    "xrGetInstanceProcAddr": (c_int, (Handle, c_char_p, POINTER(ctypes.c_void_p))),
}
# Functions of the extensions, which the loader gives by name.
EXTENSION_FUNCTIONS: dict[str, tuple[Any, ...]] = {
    "xrCreateHandTrackerEXT": (c_int, Handle, POINTER(HandTrackerCreateInfo), POINTER(Handle)),
    "xrLocateHandJointsEXT": (
        c_int,
        Handle,
        POINTER(HandJointsLocateInfo),
        POINTER(HandJointLocations),
    ),
    "xrConvertTimespecTimeToTimeKHR": (c_int, Handle, POINTER(Timespec), POINTER(c_int64)),
}


class OpenXrHands(bridge.Source):
    """Tracked hands of an OpenXR runtime with headless sessions, such as Monado.

    Every joint whose position is not both valid and tracked is sent as not seen, and all of them
    where the hand is not active or its wrist is not tracked: a runtime may extrapolate or infer
    joints that nobody sees. `library` is name or path of the OpenXR loader.
    """

    clock = (
        "the runtime's for the moment of the request, asked for as CLOCK_MONOTONIC "
        "(XR_KHR_convert_timespec_time) and converted to this host's raw monotonic clock (error "
        "below 10 µs); the runtime extrapolates to that moment"
    )

    def __init__(self, sides: Sequence[Side] = SIDES, *, library: str = LIBRARY) -> None:
        super().__init__()
        self._devices = {
            side: bridge.hand_device(i, side, "openxr") for i, side in enumerate(sides)
        }
        self._path = library
        self._pace = bridge.Pace(NOMINAL_RATE_HZ, self._clock)
        self._library: ctypes.CDLL | None = None
        self._instance, self._session, self._space = Handle(), Handle(), Handle()
        self._trackers: dict[Side, Handle] = {}
        self._extensions: dict[str, Any] = {}
        self._last: dict[Side, bytes] = {}

    def open(self) -> BridgeHello:
        """Create a headless session with a hand tracker for each side."""
        self._library = bridge.load_library(self._path, FUNCTIONS, install=INSTALL)
        names = (c_char_p * len(EXTENSIONS))(*EXTENSIONS)
        about = InstanceCreateInfo(TYPE_INSTANCE)
        about.applicationInfo = ApplicationInfo(b"dextouch", 1, b"", 0, API_VERSION_1_0)
        about.enabledExtensionCount, about.enabledExtensionNames = len(names), names
        self._call("xrCreateInstance", byref(about), byref(self._instance))
        for name, types in EXTENSION_FUNCTIONS.items():
            address = ctypes.c_void_p()
            self._call("xrGetInstanceProcAddr", self._instance, name.encode(), byref(address))
            if not address.value:
                raise DeviceError(f"OpenXR: the runtime has no {name}; use another runtime")
            self._extensions[name] = ctypes.CFUNCTYPE(*types)(address.value)
        system = c_uint64()
        request = SystemGetInfo(TYPE_SYSTEM, None, HEAD_MOUNTED_DISPLAY)
        self._call("xrGetSystem", self._instance, byref(request), byref(system))
        session = SessionCreateInfo(TYPE_SESSION, None, 0, system)
        self._call("xrCreateSession", self._instance, byref(session), byref(self._session))
        pose = Posef((0, 0, 0, 1), (0, 0, 0))
        space = ReferenceSpaceCreateInfo(TYPE_SPACE, None, LOCAL_SPACE, pose)
        self._call("xrCreateReferenceSpace", self._session, byref(space), byref(self._space))
        for side in self._devices:
            hand, self._trackers[side] = (
                HandTrackerCreateInfo(TYPE_TRACKER, None, HANDS[side]),
                Handle(),
            )
            self._call(
                "xrCreateHandTrackerEXT", self._session, byref(hand), byref(self._trackers[side])
            )
        return bridge.hello(
            kind="finger_tracker",
            software="OpenXR, XR_EXT_hand_tracking",
            devices=tuple(self._devices.values()),
            frame=bridge.OUR_AXES,
            nodes=NODES,
        )

    def read(self) -> Sequence[bridge.Reading]:
        """The hands of now, 120 times a second."""
        self._pace.wait()
        self._follow_session()
        t_monotonic_ns = self._clock.read_ns(time.CLOCK_MONOTONIC)
        seconds, nanoseconds = divmod(t_monotonic_ns, 10**9)
        xr_time = c_int64()
        self._call(
            "xrConvertTimespecTimeToTimeKHR",
            self._instance,
            byref(Timespec(seconds, nanoseconds)),
            byref(xr_time),
        )
        t_ns = t_monotonic_ns + station_offset_ns(self._clock)
        readings = (self._reading(side, xr_time, t_ns) for side in self._devices)
        return [reading for reading in readings if reading is not None]

    def close(self) -> None:
        """End the session; all handles go with the instance."""
        if self._library is not None and self._instance.value:
            self._library.xrDestroyInstance(self._instance)
        self._instance, self._session, self._space = Handle(), Handle(), Handle()
        self._trackers.clear()
        self._last.clear()

    def _call(self, name: str, *arguments: object) -> int:
        if self._library is None:
            raise DeviceError("OpenXR: not started; open it first")
        function = self._extensions.get(name) or getattr(self._library, name)
        result = int(function(*arguments))
        if result < 0:
            raise DeviceError(
                f"OpenXR: {name} gave XrResult {result}; is a runtime active "
                f"(XR_RUNTIME_JSON), does it have {', '.join(e.decode() for e in EXTENSIONS)}, and "
                "is the headset or hand camera connected?"
            )
        return result

    def _follow_session(self) -> None:
        """Begin a session that is ready; DeviceError of one that the runtime ends."""
        event = EventDataBuffer(TYPE_EVENT)
        while self._call("xrPollEvent", self._instance, byref(event)) != EVENT_UNAVAILABLE:
            if event.type == TYPE_INSTANCE_LOSS:
                raise DeviceError("OpenXR: the runtime ends; start it again")
            if event.type == TYPE_STATE_CHANGED:
                state = SessionStateChanged.from_buffer(event).state
                if state == STATE_READY:
                    begin = SessionBeginInfo(TYPE_BEGIN, None, PRIMARY_STEREO)
                    self._call("xrBeginSession", self._session, byref(begin))
                elif state in {STATE_STOPPING, STATE_LOSS_PENDING, STATE_EXITING}:
                    raise DeviceError(f"OpenXR: the runtime ends the session (state {state})")
            event = EventDataBuffer(TYPE_EVENT)

    def _reading(self, side: Side, xr_time: c_int64, t_ns: int) -> bridge.Reading | None:
        joints = (HandJointLocation * NUM_JOINTS)()
        request = HandJointsLocateInfo(TYPE_LOCATE, None, self._space, xr_time)
        found = HandJointLocations(TYPE_LOCATIONS, None, 0, NUM_JOINTS, joints)
        self._call("xrLocateHandJointsEXT", self._trackers[side], byref(request), byref(found))
        measured = bytes(joints)
        if found.isActive and measured == self._last.get(side):
            self.not_sent["unchanged"] += 1
            return None
        self._last[side] = measured
        flags = np.array([joint.locationFlags for joint in joints], dtype=np.uint64)
        required = np.uint64(POSITION_VALID | POSITION_TRACKED)
        is_seen = (flags & required) == required
        turned = ORIENTATION_VALID | ORIENTATION_TRACKED
        wrist = joints[WRIST_JOINT]
        has_wrist = is_seen[WRIST_JOINT] and wrist.locationFlags & turned == turned
        if not (found.isActive and has_wrist):
            nowhere = np.full((len(NODES), 3), np.nan)
            return bridge.hand_reading(
                self._devices[side], t_ns, nowhere, np.zeros(len(NODES), bool)
            )
        points = np.array([list(joint.pose.position) for joint in joints])
        x, y, z, w = wrist.pose.orientation
        relative = bridge.wrist_axes(points, points[WRIST_JOINT], np.array([w, x, y, z]))
        ours = relative[KEYPOINT_JOINTS] * OUR_SIGNS[side]
        return bridge.hand_reading(self._devices[side], t_ns, ours, is_seen[KEYPOINT_JOINTS])
