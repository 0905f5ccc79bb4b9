"""Bridge to MANUS gloves: finger keypoints of the MANUS Core SDK in integrated mode.

The library (`libManusSDK_Integrated.so`) is called by ctypes. Names, structures and enumerations
are those of the public headers `ManusSDK.h` and `ManusSDKTypes.h` of MANUS Core 2.4 and 3.x
(https://docs.manus-meta.com).
"""

import ctypes
import threading
from collections import deque
from collections.abc import Sequence
from ctypes import POINTER, c_bool, c_char, c_float, c_int, c_uint32, c_uint64
from dataclasses import dataclass
from typing import Final

import numpy as np

from dextouch.errors import DeviceError, InvalidInputError
from dextouch.hands import NODES, NUM_KEYPOINTS, node_order
from dextouch.tactile.layout import SIDES, Side
from services.acquisition.drivers.sdk_link import BridgeHello
from services.acquisition.sdk_bridges import bridge

LIBRARY = "libManusSDK_Integrated.so"
INSTALL = (
    "download the MANUS Core SDK (https://docs.manus-meta.com) and name its library with --library"
)
WRIST = NODES.index(("wrist", "wrist"))
# MAX_NUMBER_OF_NODES_PER_ESTIMATION_SKELETON and MAX_NUMBER_OF_GLOVES of the header.
MAX_NODES, MAX_SKELETONS = 40, 32
# SDKReturnCode_Success; AxisView_XFromViewer, AxisPolarity_PositiveZ, Side_Right: our axes in
# metres, whatever a Unity or Unreal session of the same computer uses.
SUCCESS = 0
X_FROM_VIEWER, POSITIVE_Z, RIGHT_HANDED, METRES = 3, 6, 2, 1.0
# HandMotion_None: the SDK leaves the hand in place; trackers give the pose of the wrist.
NO_HAND_MOTION = 0
SIDE_INVALID = 0
GLOVE_SIDES: Final[dict[int, Side]] = {1: "left", 2: "right"}
CHAINS = {5: "thumb", 6: "index", 7: "middle", 8: "ring", 9: "pinky", 13: "hand"}
JOINTS = ("invalid", "metacarpal", "proximal", "intermediate", "distal", "tip")
# Chosen: a quarter of a second of two hands at 120 Hz; older ones are lost first.
QUEUE_READINGS = 64
READ_S = 0.02
# Chosen: a glove that was plugged in again has another id, and takes over from the silent one.
REPLACED_NS = 1_000_000_000


Vec3 = bridge.structure("ManusVec3", x=c_float, y=c_float, z=c_float)
Quaternion = bridge.structure("ManusQuaternion", w=c_float, x=c_float, y=c_float, z=c_float)
# With its `ManusTransform`.
SkeletonNode = bridge.structure(
    "SkeletonNode", id=c_uint32, position=Vec3, rotation=Quaternion, scale=Vec3
)
NodeInfo = bridge.structure(
    "NodeInfo",
    nodeId=c_uint32,
    parentId=c_uint32,
    chainType=c_int,
    side=c_int,
    fingerJointType=c_int,
)
RawSkeletonInfo = bridge.structure(
    "RawSkeletonInfo", gloveId=c_uint32, nodesCount=c_uint32, publishTime=c_uint64
)
SkeletonStreamInfo = bridge.structure(
    "SkeletonStreamInfo", publishTime=c_uint64, skeletonsCount=c_uint32
)
CoordinateSystemVUH = bridge.structure(
    "CoordinateSystemVUH", view=c_int, up=c_int, handedness=c_int, unitScale=c_float
)
# The size of the version differs between releases. It is filled by the SDK and passed back to it,
# by value on the stack, so that the largest form serves for all.
ManusHost = bridge.structure(
    "ManusHost", hostName=c_char * 256, ipAddress=c_char * 40, version=c_uint32 * 15
)
RawSkeletonCallback = ctypes.CFUNCTYPE(None, POINTER(SkeletonStreamInfo))
FUNCTIONS: bridge.Functions = {
    "CoreSdk_InitializeIntegrated": (c_int, ()),
    "CoreSdk_ShutDown": (c_int, ()),
    "CoreSdk_InitializeCoordinateSystemWithVUH": (c_int, (CoordinateSystemVUH, c_bool)),
    "CoreSdk_RegisterCallbackForRawSkeletonStream": (c_int, (RawSkeletonCallback,)),
    "CoreSdk_SetRawSkeletonHandMotion": (c_int, (c_int,)),
    "ManusHost_Init": (None, (POINTER(ManusHost),)),
    "CoreSdk_ConnectToHost": (c_int, (ManusHost,)),
    "CoreSdk_GetIsConnectedToCore": (c_int, (POINTER(c_bool),)),
    "CoreSdk_GetRawSkeletonInfo": (c_int, (c_uint32, POINTER(RawSkeletonInfo))),
    "CoreSdk_GetRawSkeletonData": (c_int, (c_uint32, POINTER(SkeletonNode), c_uint32)),
    "CoreSdk_GetRawSkeletonNodeInfoArray": (c_int, (c_uint32, POINTER(NodeInfo), c_uint32)),
}


@dataclass(frozen=True)
class _Skeleton:
    """One skeleton, copied in the SDK's callback."""

    t_ns: int
    glove_id: int
    publish_time: int
    nodes: ctypes.Array[ctypes.Structure]


def _node_name(node: ctypes.Structure) -> tuple[str, str]:
    """Chain and joint of a node. The thumb has one joint less, under either of two names."""
    chain, joint = CHAINS[node.chainType], JOINTS[node.fingerJointType]
    return chain, "distal" if (chain, joint) == ("thumb", "intermediate") else joint


class ManusGloves(bridge.Source):
    """Hands of MANUS gloves on this host.

    The SDK's callback copies the nodes and returns; all else happens in the thread of the bridge.
    Keypoints are relative to the wrist node and in its axes, which are not ours: calibrate them
    with `dextouch station calibrate wrist`. Of several gloves of one side, the first one that
    streams is served.
    """

    clock = (
        "this host's raw monotonic clock in the SDK's callback; the SDK's publishTime (UTC, ms) "
        "only distinguishes new data from repeated data"
    )

    def __init__(self, sides: Sequence[Side] = SIDES, *, library: str = LIBRARY) -> None:
        super().__init__()
        self._devices = {side: bridge.hand_device(i, side, "manus") for i, side in enumerate(sides)}
        self._path = library
        self._library: ctypes.CDLL | None = None
        self._skeletons: deque[_Skeleton] = deque(maxlen=QUEUE_READINGS)
        self._has_some = threading.Event()
        # Kept, since the SDK holds only its address.
        self._callback = RawSkeletonCallback(self._copy)
        self._gloves: dict[int, tuple[Side, list[int]]] = {}
        # Glove that is served as this side, and when it streamed last.
        self._owners: dict[Side, tuple[int, int]] = {}
        self._published: dict[int, int] = {}

    def open(self) -> BridgeHello:
        """Start the SDK and connect to its integrated core."""
        self._library = library = bridge.load_library(self._path, FUNCTIONS, install=INSTALL)
        self._call("CoreSdk_InitializeIntegrated")
        self._call("CoreSdk_RegisterCallbackForRawSkeletonStream", self._callback)
        axes = CoordinateSystemVUH(X_FROM_VIEWER, POSITIVE_Z, RIGHT_HANDED, METRES)
        # True: nodes relative to the hand's root, not each to its parent.
        self._call("CoreSdk_InitializeCoordinateSystemWithVUH", axes, True)  # noqa: FBT003 - C
        host = ManusHost()
        library.ManusHost_Init(ctypes.byref(host))
        self._call("CoreSdk_ConnectToHost", host)
        self._call("CoreSdk_SetRawSkeletonHandMotion", NO_HAND_MOTION)
        return bridge.hello(
            kind="finger_tracker",
            software=f"MANUS Core SDK, {self._path}",
            devices=tuple(self._devices.values()),
            frame=bridge.OUR_AXES,
            nodes=NODES,
        )

    def read(self) -> Sequence[bridge.Reading]:
        """Hands that the SDK has published since the last call."""
        if not self._has_some.wait(READ_S):
            connected = c_bool()
            self._call("CoreSdk_GetIsConnectedToCore", ctypes.byref(connected))
            if not connected.value:
                raise DeviceError("MANUS: the SDK has lost its core; is the dongle plugged in?")
        self._has_some.clear()
        readings = []
        while self._skeletons:
            reading = self._reading(self._skeletons.popleft())
            if reading is not None:
                readings.append(reading)
        return readings

    def close(self) -> None:
        """Shut the SDK down."""
        if self._library is not None:
            self._library.CoreSdk_ShutDown()
        self._library = None
        self._skeletons.clear()
        self._gloves.clear()

    def _call(self, name: str, *arguments: object) -> None:
        if self._library is None:
            raise DeviceError("MANUS: not started; open it first")
        code = getattr(self._library, name)(*arguments)
        if code != SUCCESS:
            raise DeviceError(
                f"MANUS: {name} gave SDKReturnCode {code}, expected {SUCCESS}; are the dongle, its "
                "licence and the permission to open it (udev rules of MANUS) there?"
            )

    def _copy(self, stream: "ctypes._Pointer[ctypes.Structure]") -> None:
        """The SDK's callback, in a thread of the SDK."""
        t_ns, library = self._clock.now_ns(), self._library
        if library is None:
            return
        for index in range(min(stream.contents.skeletonsCount, MAX_SKELETONS)):
            info = RawSkeletonInfo()
            if library.CoreSdk_GetRawSkeletonInfo(index, ctypes.byref(info)) != SUCCESS:
                continue
            count = info.nodesCount
            if not 0 < count <= MAX_NODES:
                continue
            nodes = (SkeletonNode * count)()
            if library.CoreSdk_GetRawSkeletonData(index, nodes, count) == SUCCESS:
                if len(self._skeletons) == QUEUE_READINGS:
                    self.not_sent["queue full"] += 1
                self._skeletons.append(_Skeleton(t_ns, info.gloveId, info.publishTime, nodes))
        self._has_some.set()

    def _reading(self, skeleton: _Skeleton) -> bridge.Reading | None:
        if self._published.get(skeleton.glove_id) == skeleton.publish_time:
            self.not_sent["unchanged"] += 1
            return None
        self._published[skeleton.glove_id] = skeleton.publish_time
        side, places = self._glove(skeleton)
        owner, owner_ns = self._owners.get(side, (skeleton.glove_id, 0))
        is_other = owner != skeleton.glove_id and skeleton.t_ns - owner_ns < REPLACED_NS
        if side not in self._devices or is_other:
            self.not_sent["another glove"] += 1
            return None
        self._owners[side] = (skeleton.glove_id, skeleton.t_ns)
        points, wrist, q_wxyz = np.full((NUM_KEYPOINTS, 3), np.nan), np.zeros(3), np.zeros(4)
        for node, place in zip(skeleton.nodes, places, strict=True):
            points[place] = node.position.x, node.position.y, node.position.z
            if place == WRIST:
                wrist = points[place].copy()
                q = node.rotation
                q_wxyz = np.array([q.w, q.x, q.y, q.z])
        if not np.isfinite(q_wxyz).all() or abs(float(np.linalg.norm(q_wxyz)) - 1.0) > 1e-3:
            self.not_sent["no wrist"] += 1
            return None
        relative = bridge.wrist_axes(points, wrist, q_wxyz)
        return bridge.hand_reading(
            self._devices[side], skeleton.t_ns, relative, np.isfinite(relative).all(axis=1)
        )

    def _glove(self, skeleton: _Skeleton) -> tuple[Side, list[int]]:
        """Side of a glove, and the keypoint of each of its nodes."""
        glove_id, count = skeleton.glove_id, len(skeleton.nodes)
        known = self._gloves.get(glove_id)
        if known is not None and len(known[1]) == count:
            return known
        infos = (NodeInfo * count)()
        self._call("CoreSdk_GetRawSkeletonNodeInfoArray", glove_id, infos, count)
        by_id = {info.nodeId: info for info in infos}
        try:
            places = node_order([_node_name(by_id[node.id]) for node in skeleton.nodes]).places
            (number,) = {info.side for info in infos} - {SIDE_INVALID}
            side = GLOVE_SIDES[number]
        except (KeyError, IndexError, ValueError, InvalidInputError) as error:
            raise DeviceError(
                f"MANUS: glove {glove_id} describes no hand of {NUM_KEYPOINTS} nodes "
                f"({type(error).__name__}: {error}); is it another release of the SDK?"
            ) from error
        self._gloves[glove_id] = (side, list(places))
        return self._gloves[glove_id]
