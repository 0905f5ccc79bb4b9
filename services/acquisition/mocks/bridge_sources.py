"""Streams of an episode come in; what an SDK process says of them over a bridge goes out."""

from collections.abc import Sequence
from typing import Protocol, runtime_checkable

import numpy as np
from jaxtyping import Float64, Int64

from dextouch.geometry.rotations import rotation_from_quaternion
from dextouch.hands.skeleton import NODES, NUM_KEYPOINTS
from dextouch.tactile.layout import Side
from services.acquisition.drivers.bridge_protocol import (
    PROTOCOL,
    PROTOCOL_VERSION,
    BridgedDevice,
    BridgeHello,
    FrameConvention,
)
from services.acquisition.drivers.bridge_tracker import POSE_MAGIC, POSE_PAYLOAD, TrackingResult
from services.acquisition.drivers.finger_tracker import ALL_SEEN, VALIDITY
from services.acquisition.drivers.finger_tracker import MAGIC as FINGER_MAGIC
from services.acquisition.drivers.packets import SOURCES, VERSION, Packet, encode_packet
from services.acquisition.drivers.pose_tracker import TrackingState, source_of
from services.acquisition.mocks.faults import DeviceFaults
from services.acquisition.mocks.finger_tracker import seen_nodes
from services.acquisition.mocks.ledger import Fate
from services.acquisition.mocks.pose_tracker import TrackedPoses, TrackingFault
from services.acquisition.mocks.replay import ReplayStream

# A left-handed sender in centimetres, and OpenVR's own frame: y up, looking along −z.
LEFT_HANDED = FrameConvention(handedness="left", axes=("+x", "+y", "-z"))
Y_UP = FrameConvention(handedness="right", axes=("+x", "+z", "-y"))
SOFTWARE = "dextouch mock bridge 1"
POSE_INDEX = 3
RESULTS = {
    TrackingState.UNINITIALIZED: TrackingResult.UNINITIALIZED,
    TrackingState.CALIBRATING: TrackingResult.CALIBRATING_IN_PROGRESS,
    TrackingState.OUT_OF_RANGE: TrackingResult.CALIBRATING_OUT_OF_RANGE,
    TrackingState.FALLBACK_ROTATION_ONLY: TrackingResult.FALLBACK_ROTATION_ONLY,
    TrackingState.RUNNING_OK: TrackingResult.RUNNING_OK,
}


@runtime_checkable
class BridgeSource(Protocol):
    """What one bridge process says."""

    magic: bytes

    @property
    def t_ns(self) -> Int64[np.ndarray, " n"]:
        """When each sample is taken."""
        ...

    def hello(self) -> bytes:
        """The first line of a connection."""
        ...

    def units(self, index: int, sequence: int, t_device_ns: int) -> list[bytes]:
        """The packet of sample `index`."""
        ...


def sign_of_life(magic: bytes, sequence: int, t_device_ns: int) -> bytes:
    """A packet without a payload."""
    packet = Packet(VERSION, SOURCES["none"], sequence, t_device_ns, b"")
    return encode_packet(magic, packet)


def hello_line(hello: BridgeHello) -> bytes:
    """A hello as it is sent."""
    return hello.model_dump_json(exclude_none=True).encode() + b"\n"


class BridgeFingerTrackerSource:
    """A finger tracker's SDK: left-handed, in centimetres, nodes in its own order.

    Args:
        stream: [n, 25, 3] in m, wrist frame.
        side: which hand.
        rng: of the order of the nodes and of the noise.
        frame: the SDK's coordinates.
        faults: position noise, and when the thumb is not seen.
    """

    magic = FINGER_MAGIC

    def __init__(
        self,
        stream: ReplayStream,
        *,
        side: Side,
        rng: np.random.Generator,
        frame: FrameConvention = LEFT_HANDED,
        faults: DeviceFaults | None = None,
    ) -> None:
        faults = faults or DeviceFaults()
        self._stream = stream
        self._side = side
        self._order = rng.permutation(NUM_KEYPOINTS)
        theirs_from_ours = frame.ours_from_theirs().T
        self._seen = seen_nodes(stream.t_ns, self._order, faults)
        noise_m = faults.position_noise_m * rng.standard_normal(stream.values.shape)
        points_cm = 100.0 * (stream.values + noise_m)[:, self._order] @ theirs_from_ours.T
        self._points = points_cm.astype("<f4")
        self._hello = BridgeHello(
            protocol=PROTOCOL,
            version=PROTOCOL_VERSION,
            kind="finger_tracker",
            software=SOFTWARE,
            devices=(BridgedDevice(index=0, serial_number=f"MF-{side}", source=side),),
            frame=frame,
            length_unit="cm",
            nodes=tuple(NODES[node] for node in self._order),
        )

    @property
    def t_ns(self) -> Int64[np.ndarray, " n"]:
        """When each sample is taken."""
        return self._stream.t_ns

    def hello(self) -> bytes:
        """Who is there, and the order of the nodes."""
        return hello_line(self._hello)

    def fate(self, index: int) -> Fate:
        """Whether all nodes are seen."""
        return Fate.SENT if self._seen[index] == ALL_SEEN else Fate.MARKED

    def units(self, index: int, sequence: int, t_device_ns: int) -> list[bytes]:
        """One packet."""
        payload = VALIDITY.pack(int(self._seen[index])) + self._points[index].tobytes()
        packet = Packet(VERSION, SOURCES[self._side], sequence, t_device_ns, payload)
        return [encode_packet(FINGER_MAGIC, packet)]


class BridgePoseSource:
    """An OpenVR-like source of one tracker: y up, matrices, and a flag that stays set when lost.

    Args:
        stream: float64 [n, 7], x y z (m) qw qx qy qz in the world frame.
        faults: position and rotation noise, per axis; occlusions and jumps.
        rng: of the noise.
        tracking: occlusions and jumps.
        frame: the source's coordinates.
    """

    magic = POSE_MAGIC

    def __init__(
        self,
        stream: ReplayStream,
        *,
        faults: DeviceFaults,
        rng: np.random.Generator,
        tracking: Sequence[TrackingFault] = (),
        frame: FrameConvention = Y_UP,
    ) -> None:
        source = source_of(stream.descriptor.name)
        self._source = SOURCES[source]
        self.tracked = TrackedPoses(stream, faults=faults, rng=rng, tracking=tracking)
        self._matrices = _matrices(self.tracked.poses, frame.ours_from_theirs().T)
        device = {"index": POSE_INDEX, "serial_number": f"LHR-{source}", "source": source}
        self._hello = BridgeHello(
            protocol=PROTOCOL,
            version=PROTOCOL_VERSION,
            kind="pose_tracker",
            software=SOFTWARE,
            devices=(BridgedDevice.model_validate(device),),
            frame=frame,
            length_unit="m",
        )

    @property
    def t_ns(self) -> Int64[np.ndarray, " n"]:
        """When each sample is taken."""
        return self.tracked.t_ns

    def hello(self) -> bytes:
        """Who is there."""
        return hello_line(self._hello)

    def fate(self, index: int) -> Fate:
        """Whether this pose is occluded or jumps."""
        return self.tracked.fate(index)

    def units(self, index: int, sequence: int, t_device_ns: int) -> list[bytes]:
        """One packet; its pose is flagged valid whatever the result says."""
        result = RESULTS[TrackingState(int(self.tracked.states[index]))]
        numbers = self._matrices[index].ravel()
        payload = POSE_PAYLOAD.pack(POSE_INDEX, 1, result, t_device_ns / 1e9, *numbers)
        packet = Packet(VERSION, self._source, sequence, t_device_ns, payload)
        return [encode_packet(POSE_MAGIC, packet)]


def _matrices(
    poses: np.ndarray, theirs_from_ours: Float64[np.ndarray, "3 3"]
) -> Float64[np.ndarray, "n 3 4"]:
    R = theirs_from_ours @ rotation_from_quaternion(poses[:, 3:]) @ theirs_from_ours.T
    t = poses[:, :3] @ theirs_from_ours.T
    return np.concatenate([R, t[:, :, None]], axis=2)
