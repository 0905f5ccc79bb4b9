"""Packets of a pose tracker by HID or USB: the decoder of the poses of a running tracker."""

import math
import struct

from dextouch.streams import Sample
from services.acquisition.drivers.base import Readings, StreamDecoder, check_packet
from services.acquisition.drivers.packets import Packet, PacketDecoder
from services.acquisition.drivers.reports import ReportReassembler
from services.acquisition.drivers.tracking import (
    NORM_TOLERANCE,
    PoseStream,
    TrackingState,
    are_finite,
    pose_descriptor,
    source_of,
)

MAGIC = b"DXPT"
# running state, three bytes of padding, x y z (m), qw qx qy qz
PAYLOAD = struct.Struct("<B3x7f")


class PoseTrackerDecoder(StreamDecoder[Packet]):
    """Poses [x y z qw qx qy qz] in the world frame, only while the tracker runs.

    Packets in another state (some trackers keep sending a drifting pose flagged as valid), and
    poses that jump, are counted in `tracking` and dropped: a gap, never a wrong pose.
    What is no pose is counted as `refused`.
    """

    def __init__(self, stream: str) -> None:
        packets = PacketDecoder(MAGIC, min_payload=PAYLOAD.size, max_payload=PAYLOAD.size)
        super().__init__(pose_descriptor(stream), packets)
        self.reports = ReportReassembler()
        self.poses = PoseStream()
        self.tracking = self.poses.events
        self._device = f"pose_tracker_{stream}"
        self._source = source_of(stream)

    def events(self) -> dict[str, int]:
        """Packets left out so far, by the reason."""
        return self.poses.counts()

    def reset(self) -> None:
        """Forget half a message and the last pose."""
        super().reset()
        self.reports.reset()
        self.poses.reset()

    def decode(self, data: bytes, t_host_ns: int) -> Readings:
        """Poses (float64 [7], unit quaternion) completed by one report.

        Raises:
            DeviceError: another version, or a tracker that sits elsewhere.
        """
        message = self.reports.feed(data)
        return {} if message is None else super().decode(message[1], t_host_ns)

    def _sample(self, packet: Packet, t_host_ns: int) -> Sample | None:
        check_packet(packet, device=self._device, source=self._source)
        if not self.poses.order.admits(packet.sequence):
            return None
        state, *numbers = PAYLOAD.unpack(packet.payload)
        sequence, t_device_ns = packet.sequence, packet.t_device_ns
        if state != TrackingState.RUNNING_OK:
            self.poses.occlude(t_device_ns)
            return None
        x, y, z, w, i, j, k = numbers
        norm = math.hypot(w, i, j, k)
        if not are_finite(numbers) or abs(norm - 1.0) > NORM_TOLERANCE:
            self.statistics.refused += 1
            return None
        return self.poses.take(
            (x, y, z, w / norm, i / norm, j / norm, k / norm),
            sequence=sequence,
            t_device_ns=t_device_ns,
            t_host_ns=t_host_ns,
        )
