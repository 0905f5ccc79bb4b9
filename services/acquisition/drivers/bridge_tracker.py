"""Trackers behind a closed SDK: packets of a bridge process come in, samples in our frames go out.

A driver here is for one device of a bridge. What is stale, occluded or jumps is left out and noted.
"""

import math
import struct
from dataclasses import replace
from enum import IntEnum
from typing import Protocol

import numpy as np
from jaxtyping import Float64

from dextouch.errors import DeviceError, PacketError, StaleDataError
from dextouch.streams.descriptors import StreamDescriptor
from dextouch.streams.samples import Sample
from dextouch.tactile.layout import Side
from services.acquisition.clock import StationClock
from services.acquisition.drivers.base import Decoder, Driver, Readings, check_packet
from services.acquisition.drivers.bridge_protocol import BridgeConnection, FreshnessGate
from services.acquisition.drivers.finger_tracker import MAGIC as FINGER_MAGIC
from services.acquisition.drivers.finger_tracker import PAYLOAD_BYTES as FINGER_BYTES
from services.acquisition.drivers.finger_tracker import (
    keypoints_descriptor,
    resolve_nodes,
    unpack_keypoints,
)
from services.acquisition.drivers.packets import SOURCES, DecoderStatistics, Packet, PacketDecoder
from services.acquisition.drivers.pose_tracker import (
    NORM_TOLERANCE,
    PoseStream,
    TrackingEvents,
    pose_descriptor,
    source_of,
)
from services.acquisition.transports.base import Transport

POSE_MAGIC = b"DXPM"
# device index, pose-valid flag, a byte of padding, tracking result, SDK's seconds, 3×4 matrix
POSE_PAYLOAD = struct.Struct("<HBxid12f")
MAX_SECONDS = 2**63 / 1e9
HELLO_READS = 20
SILENCE_NS = 200_000_000


class TrackingResult(IntEnum):
    """OpenVR's tracking results; only RUNNING_OK is a measurement."""

    UNINITIALIZED = 1
    CALIBRATING_IN_PROGRESS = 100
    CALIBRATING_OUT_OF_RANGE = 101
    RUNNING_OK = 200
    RUNNING_OUT_OF_RANGE = 201
    FALLBACK_ROTATION_ONLY = 300


def pose_in_our_frame(
    matrix: Float64[np.ndarray, "3 4"],
    ours_from_theirs: Float64[np.ndarray, "3 3"],
    scale_m: float,
) -> Float64[np.ndarray, " 7"]:
    """Pose x y z (m) qw qx qy qz of a sender's 3×4 matrix [R | t].

    With p_ours = M p_theirs for the world and for the body, R_ours = M R Mᵀ and t_ours = s M t.
    This holds for a left-handed sender too: both mirrors cancel in the rotation.

    Args:
        matrix: [R | t], sender's frame and unit of length.
        ours_from_theirs: M, orthogonal, det +1 or −1.
        scale_m: s, metres of the sender's unit.

    Raises:
        PacketError: not finite, or R is no rotation (by more than 1e-3).
    """
    R = matrix[:, :3]
    if not np.all(np.isfinite(matrix)):
        raise PacketError("pose matrix: NaN or infinity")
    _check_rotation(R.tolist())
    R_ours = ours_from_theirs @ R @ ours_from_theirs.T
    t_ours_m = scale_m * (ours_from_theirs @ matrix[:, 3])
    return np.array([*t_ours_m.tolist(), *quaternion_of_one(R_ours.tolist())])


def quaternion_of_one(R: list[list[float]]) -> tuple[float, float, float, float]:
    """Unit quaternion (w, x, y, z), w ≥ 0, of one rotation matrix given as rows.

    Shepperd's method, as in `dextouch.geometry.rotations.quaternion_from_rotation`, for a single
    matrix: numpy's cost for nine numbers would be most of a packet's.
    """
    (a, b, c), (d, e, f), (g, h, i) = R
    # 4·(w², x², y², z²); the largest one is the safe divisor.
    squares = (1 + a + e + i, 1 + a - e - i, 1 - a + e - i, 1 - a - e + i)
    best = squares.index(max(squares))
    rows = (
        (squares[0], h - f, c - g, d - b),
        (h - f, squares[1], b + d, c + g),
        (c - g, b + d, squares[2], f + h),
        (d - b, c + g, f + h, squares[3]),
    )
    w, x, y, z = rows[best]
    scale = math.copysign(1.0, w) / math.hypot(w, x, y, z)
    return w * scale, x * scale, y * scale, z * scale


def _check_rotation(R: list[list[float]]) -> None:
    x, y, z = R
    pairs = ((x, x), (y, y), (z, z), (x, y), (y, z), (z, x))
    error = max(abs(u[0] * v[0] + u[1] * v[1] + u[2] * v[2] - (u is v)) for u, v in pairs)
    determinant = (
        x[0] * (y[1] * z[2] - y[2] * z[1])
        - x[1] * (y[0] * z[2] - y[2] * z[0])
        + x[2] * (y[0] * z[1] - y[1] * z[0])
    )
    if error > NORM_TOLERANCE or determinant < 0:
        raise PacketError(f"pose matrix: no rotation (R Rᵀ is off by {error:.1e})")


class BridgeFingerTrackerDecoder:
    """Keypoints (float32 [25, 3], m, wrist frame) of one hand behind a finger tracker's SDK.

    Args:
        side: which hand.
        serial_number: of the glove; the bridge's only one of this side if None.
    """

    def __init__(self, side: Side, *, serial_number: str | None = None) -> None:
        self._side = side
        self._device = f"finger_tracker_{side}"
        self.connection = BridgeConnection(
            "finger_tracker",
            device=self._device,
            source=side,
            serial_number=serial_number,
            packets=PacketDecoder(FINGER_MAGIC, min_payload=0, max_payload=FINGER_BYTES),
            payload_bytes=FINGER_BYTES,
        )
        self.freshness = FreshnessGate()
        self.tracking = TrackingEvents()
        self._order: list[int] = []
        self._ours_m = np.eye(3)
        self.unseen_nodes = 0

    @property
    def statistics(self) -> DecoderStatistics:
        """What was seen so far, of all devices of the bridge."""
        return self.connection.statistics

    @property
    def descriptors(self) -> tuple[StreamDescriptor, ...]:
        """The keypoint stream."""
        return (keypoints_descriptor(self._side),)

    def reset(self) -> None:
        """The connection was lost."""
        self.connection.reset()
        self.freshness.reset()
        self.tracking.end()
        self._order = []

    def decode(self, data: bytes, t_host_ns: int) -> Readings:
        """Keypoints completed by `data`.

        Raises:
            DeviceError: no bridge for this hand, or nodes we do not know.
        """
        packets = self.connection.feed(data)
        if not self._order:
            self._learn_nodes()
        samples = []
        for packet in packets:
            sample = self._sample(packet, t_host_ns)
            if sample is not None:
                samples.append(sample)
        return {f"keypoints_{self._side}": samples} if samples else {}

    def _learn_nodes(self) -> None:
        hello = self.connection.hello
        if hello is None or hello.nodes is None:
            return
        try:
            self._order = resolve_nodes(hello.nodes)
        except PacketError as error:
            raise DeviceError(
                f"{self._device}: {error.message}", device=self._device, event="wrong_nodes"
            ) from error
        self._ours_m = hello.scale_m() * hello.frame.ours_from_theirs()

    def _sample(self, packet: Packet, t_host_ns: int) -> Sample | None:
        hello = self.connection.hello
        if packet.source != SOURCES[self._side]:
            # The other hand of the same bridge is none of ours; one it did not announce is a fault.
            announced = [SOURCES[device.source] for device in hello.devices] if hello else []
            if packet.source not in announced:
                check_packet(packet, device=self._device, source=self._side)
            return None
        if not self.freshness.admits(packet.t_device_ns, t_host_ns):
            self.tracking.leave_out("stale", state=0, sequence=packet.sequence, t_host_ns=t_host_ns)
            return None
        self.tracking.end()
        theirs, num_unseen = unpack_keypoints(packet.payload, self._order)
        self.unseen_nodes += num_unseen
        keypoints = (theirs.astype(np.float64) @ self._ours_m.T).astype(np.float32)
        return Sample(t_host_ns, keypoints, packet.t_device_ns, packet.sequence)


class BridgePoseTrackerDecoder:
    """Poses [x y z qw qx qy qz] (m, world frame) of one device of an OpenVR-like source.

    Only the result RUNNING_OK makes a sample. The pose-valid flag never does: such sources keep it
    set while a lost tracker drifts. A running pose that is flagged invalid is left out too.

    Args:
        stream: `wrist_left`, `wrist_right` or `head`.
        serial_number: of the tracker; the bridge's only one at this place if None.
    """

    def __init__(self, stream: str, *, serial_number: str | None = None) -> None:
        self._stream = stream
        self._device = f"pose_tracker_{stream}"
        self.connection = BridgeConnection(
            "pose_tracker",
            device=self._device,
            source=source_of(stream),
            serial_number=serial_number,
            packets=PacketDecoder(POSE_MAGIC, min_payload=0, max_payload=POSE_PAYLOAD.size),
            payload_bytes=POSE_PAYLOAD.size,
        )
        self.freshness = FreshnessGate()
        self.poses = PoseStream()
        self._ours_from_theirs = np.eye(3)
        self._scale_m = 1.0

    @property
    def statistics(self) -> DecoderStatistics:
        """What was seen so far, of all devices of the bridge; `refused`: matrices that are none."""
        return self.connection.statistics

    @property
    def descriptors(self) -> tuple[StreamDescriptor, ...]:
        """The pose stream."""
        return (pose_descriptor(self._stream),)

    @property
    def tracking(self) -> TrackingEvents:
        """What was left out: counts and the last events."""
        return self.poses.events

    def reset(self) -> None:
        """The connection was lost."""
        self.connection.reset()
        self.freshness.reset()
        self.poses.reset()

    def decode(self, data: bytes, t_host_ns: int) -> Readings:
        """Poses completed by `data`.

        Raises:
            DeviceError: no bridge with this tracker.
        """
        samples = []
        known = self.connection.hello
        packets = self.connection.feed(data)
        hello = self.connection.hello
        if hello is not known and hello is not None:
            self._ours_from_theirs = hello.frame.ours_from_theirs()
            self._scale_m = hello.scale_m()
        for packet in packets:
            sample = self._sample(packet, t_host_ns)
            if sample is not None:
                samples.append(sample)
        return {self._stream: samples} if samples else {}

    def _sample(self, packet: Packet, t_host_ns: int) -> Sample | None:
        chosen = self.connection.chosen
        index, flag, result, seconds, *numbers = POSE_PAYLOAD.unpack(packet.payload)
        if chosen is None or index != chosen.index:
            return None
        check_packet(packet, device=self._device, source=chosen.source)
        if not (math.isfinite(seconds) and 0 <= seconds < MAX_SECONDS):
            self.statistics.refused += 1
            return None
        packet = replace(packet, t_device_ns=round(seconds * 1e9))
        if not self.freshness.admits(packet.t_device_ns, t_host_ns):
            self.tracking.leave_out(
                "stale", state=result, sequence=packet.sequence, t_host_ns=t_host_ns
            )
            return None
        if result != TrackingResult.RUNNING_OK or not flag:
            self.poses.occlude(packet, state=result, t_host_ns=t_host_ns)
            return None
        try:
            pose = pose_in_our_frame(
                np.array(numbers).reshape(3, 4), self._ours_from_theirs, self._scale_m
            )
        except PacketError:
            self.statistics.refused += 1
            return None
        return self.poses.take(pose, packet, state=result, t_host_ns=t_host_ns)


class _BridgeDecoder(Decoder, Protocol):
    @property
    def connection(self) -> BridgeConnection: ...


class BridgeDriver(Driver):
    """A device behind a bridge: waits for the hello, and takes silence for loss.

    A bridge shows at least every 50 ms that it lives. One that is silent for 200 ms has stopped or
    is cut off, which a socket alone would not tell for minutes.
    """

    def __init__(
        self, name: str, *, transport: Transport, decoder: _BridgeDecoder, clock: StationClock
    ) -> None:
        super().__init__(name, transport=transport, decoder=decoder, clock=clock)
        self._connection = decoder.connection
        self._t_heard_ns = 0
        self._first: Readings = {}

    def open(self) -> None:
        """Connect and learn who is there.

        Raises:
            DeviceError: nobody answers, no hello within 2 s, or not the wanted device.
        """
        super().open()
        self._t_heard_ns = self._clock.now_ns()
        for _ in range(HELLO_READS):
            self._first = super().read()
            if self._connection.hello is not None:
                self._t_heard_ns = self._clock.now_ns()
                return
        raise DeviceError(
            f"{self.name}: {self.info} sends no hello; is this the address of a bridge?",
            device=self.name,
            event="wrong_hello",
        )

    def read(self) -> Readings:
        """New samples; empty when nothing came.

        Raises:
            StaleDataError: the bridge has been silent for 200 ms.
            DeviceError: the bridge is gone or speaks another protocol.
        """
        if self._first:
            first, self._first = self._first, {}
            return first
        data = self.transport.read()
        t_host_ns = self._clock.now_ns()
        if data:
            self._t_heard_ns = t_host_ns
            return self.decoder.decode(data, t_host_ns)
        silence_ns = t_host_ns - self._t_heard_ns
        if silence_ns > SILENCE_NS:
            raise StaleDataError(
                f"{self.name}: {self.info} has been silent for {silence_ns / 1e6:.0f} ms, expected "
                "a sign of life every 50 ms; does the SDK process still run?",
                device=self.name,
                event="silent_bridge",
            )
        return {}
