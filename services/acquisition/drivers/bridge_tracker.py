"""Trackers behind a closed SDK: packets of a bridge process come in, samples in our frames go out.

A driver here is for one device of a bridge. What is stale, occluded or jumps is left out and noted.
"""

import math
import struct
from enum import IntEnum
from typing import Protocol

import numpy as np
from jaxtyping import Int64

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
    PoseStream,
    TrackingEvents,
    pose_descriptor,
    source_of,
)
from services.acquisition.drivers.sender_frame import SenderFrame
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


class BridgeFingerTrackerDecoder:
    """Keypoints (float32 [25, 3], m, wrist frame) of one hand behind a finger tracker's SDK.

    Args:
        side: which hand.
        serial_number: of the glove; the bridge's only one of this side if None.
    """

    def __init__(self, side: Side, *, serial_number: str | None = None) -> None:
        self._side = side
        self._device = f"finger_tracker_{side}"
        self._stream = keypoints_descriptor(side)
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
        self._order: Int64[np.ndarray, 25] | None = None
        self._ours_m = np.eye(3)
        self.unseen_nodes = 0

    @property
    def statistics(self) -> DecoderStatistics:
        """What was seen so far, of all devices of the bridge."""
        return self.connection.statistics

    @property
    def descriptors(self) -> tuple[StreamDescriptor, ...]:
        """The keypoint stream."""
        return (self._stream,)

    def reset(self) -> None:
        """The connection was lost."""
        self.connection.reset()
        self.freshness.reset()
        self.tracking.end()
        self._order = None

    def decode(self, data: bytes, t_host_ns: int) -> Readings:
        """Keypoints completed by `data`.

        Raises:
            DeviceError: no bridge for this hand, or nodes we do not know.
        """
        packets = self.connection.feed(data)
        if self._order is None:
            self._learn_nodes()
        samples = []
        for packet in packets:
            sample = self._sample(packet, t_host_ns)
            if sample is not None:
                samples.append(sample)
        return {self._stream.name: samples} if samples else {}

    def _learn_nodes(self) -> None:
        hello = self.connection.hello
        if hello is None or hello.nodes is None:
            return
        try:
            self._order = np.array(resolve_nodes(hello.nodes))
        except PacketError as error:
            raise DeviceError(
                f"{self._device}: {error.message}", device=self._device, event="wrong_nodes"
            ) from error
        self._ours_m = hello.scale_m() * hello.frame.ours_from_theirs()

    def _sample(self, packet: Packet, t_host_ns: int) -> Sample | None:
        hello, order = self.connection.hello, self._order
        if hello is None or order is None:
            return None
        if packet.source != SOURCES[self._side]:
            # The other hand of the same bridge is none of ours; one it did not announce is a fault.
            announced = [SOURCES[device.source] for device in hello.devices]
            if packet.source not in announced:
                check_packet(packet, device=self._device, source=self._side)
            return None
        if not self.freshness.admits(packet.t_device_ns, t_host_ns):
            self.tracking.leave_out("stale", state=0, sequence=packet.sequence, t_host_ns=t_host_ns)
            return None
        self.tracking.end()
        theirs, num_unseen = unpack_keypoints(packet.payload, order)
        self.unseen_nodes += num_unseen
        keypoints = (theirs.astype(np.float64) @ self._ours_m.T).astype(np.float32)
        return Sample(t_host_ns, keypoints, packet.t_device_ns, packet.sequence)


class BridgePoseTrackerDecoder:
    """Poses [x y z qw qx qy qz] (m, world frame) of one device of an OpenVR-like source.

    Only the result RUNNING_OK makes a sample. The pose-valid flag never does: such sources keep it
    set while a lost tracker drifts. A running pose that is flagged invalid is left out too.

    Args:
        stream: `wrist_left`, `wrist_right`, `head`, or the name of another place.
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
        self._descriptor = pose_descriptor(stream)
        self._frame: SenderFrame | None = None

    @property
    def statistics(self) -> DecoderStatistics:
        """What was seen so far, of all devices of the bridge; `refused`: matrices that are none."""
        return self.connection.statistics

    @property
    def descriptors(self) -> tuple[StreamDescriptor, ...]:
        """The pose stream."""
        return (self._descriptor,)

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
            self._frame = SenderFrame(hello.frame, hello.scale_m())
        for packet in packets:
            sample = self._sample(packet, t_host_ns)
            if sample is not None:
                samples.append(sample)
        return {self._stream: samples} if samples else {}

    def _sample(self, packet: Packet, t_host_ns: int) -> Sample | None:
        chosen, frame = self.connection.chosen, self._frame
        index, flag, result, seconds, *numbers = POSE_PAYLOAD.unpack(packet.payload)
        if chosen is None or frame is None or index != chosen.index:
            return None
        check_packet(packet, device=self._device, source=chosen.source)
        if not (math.isfinite(seconds) and 0 <= seconds < MAX_SECONDS):
            self.statistics.refused += 1
            return None
        sequence, t_device_ns = packet.sequence, round(seconds * 1e9)
        if not self.freshness.admits(t_device_ns, t_host_ns):
            self.tracking.leave_out("stale", state=result, sequence=sequence, t_host_ns=t_host_ns)
            return None
        if result != TrackingResult.RUNNING_OK or not flag:
            self.poses.occlude(
                state=result, sequence=sequence, t_device_ns=t_device_ns, t_host_ns=t_host_ns
            )
            return None
        try:
            pose = frame.pose(numbers)
        except PacketError:
            self.statistics.refused += 1
            return None
        return self.poses.take(
            pose, state=result, sequence=sequence, t_device_ns=t_device_ns, t_host_ns=t_host_ns
        )


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
