"""Packets of a pose tracker by HID or USB: the decoder of the poses of a running tracker."""

import math
import struct

from dextouch.streams import Sample, StreamDescriptor
from services.acquisition.drivers.base import Readings, check_packet
from services.acquisition.drivers.packets import DecoderStatistics, Packet, PacketDecoder
from services.acquisition.drivers.reports import ReportReassembler
from services.acquisition.drivers.tracking import (
    NORM_TOLERANCE,
    PoseStream,
    TrackingEvents,
    TrackingState,
    are_finite,
    pose_descriptor,
    source_of,
)

MAGIC = b"DXPT"
# running state, three bytes of padding, x y z (m), qw qx qy qz
PAYLOAD = struct.Struct("<B3x7f")


class PoseTrackerDecoder:
    """Poses [x y z qw qx qy qz] in the world frame, only while the tracker runs.

    Packets in another state (some trackers keep sending a drifting pose flagged as valid), and
    poses that jump, are counted, recorded in `events` and dropped: a gap, never a wrong pose.
    """

    def __init__(self, stream: str) -> None:
        self._stream = stream
        self._device = f"pose_tracker_{stream}"
        self._source = source_of(stream)
        self.reports = ReportReassembler()
        self.poses = PoseStream()
        self._packets = PacketDecoder(MAGIC, min_payload=PAYLOAD.size, max_payload=PAYLOAD.size)
        self._descriptor = pose_descriptor(stream)

    @property
    def statistics(self) -> DecoderStatistics:
        """What was seen so far; `refused` counts poses that are no poses."""
        return self._packets.statistics

    @property
    def descriptors(self) -> tuple[StreamDescriptor, ...]:
        """The pose stream."""
        return (self._descriptor,)

    @property
    def tracking(self) -> TrackingEvents:
        """Occlusions and jumps: counts and the last events."""
        return self.poses.events

    @property
    def not_running(self) -> int:
        """Packets dropped because the tracker was not running."""
        return self.tracking.packets["occluded"]

    @property
    def jumped(self) -> int:
        """Packets dropped because their pose could not have been reached."""
        return self.tracking.packets["jumped"]

    def reset(self) -> None:
        """Forget half a message and the last pose."""
        self.reports.reset()
        self._packets.reset()
        self.poses.reset()

    def decode(self, data: bytes, t_host_ns: int) -> Readings:
        """Poses (float64 [7], unit quaternion) completed by one report.

        Raises:
            DeviceError: another version, or a tracker that sits elsewhere.
        """
        message = self.reports.feed(data)
        if message is None:
            return {}
        samples = []
        for packet in self._packets.feed(message[1]):
            check_packet(packet, device=self._device, source=self._source)
            sample = self._sample(packet, t_host_ns)
            if sample is not None:
                samples.append(sample)
        return {self._stream: samples} if samples else {}

    def _sample(self, packet: Packet, t_host_ns: int) -> Sample | None:
        if not self.poses.order.admits(packet.sequence):
            return None
        state, *numbers = PAYLOAD.unpack(packet.payload)
        sequence, t_device_ns = packet.sequence, packet.t_device_ns
        if state != TrackingState.RUNNING_OK:
            self.poses.occlude(
                state=state, sequence=sequence, t_device_ns=t_device_ns, t_host_ns=t_host_ns
            )
            return None
        x, y, z, w, i, j, k = numbers
        norm = math.hypot(w, i, j, k)
        if not are_finite(numbers) or abs(norm - 1.0) > NORM_TOLERANCE:
            self.statistics.refused += 1
            return None
        return self.poses.take(
            (x, y, z, w / norm, i / norm, j / norm, k / norm),
            state=state,
            sequence=sequence,
            t_device_ns=t_device_ns,
            t_host_ns=t_host_ns,
        )
