"""A pose tracker behind the bridge to an OpenVR-like SDK: the decoder of its packets."""

import math
import struct
from enum import IntEnum

from dextouch.errors import PacketError
from dextouch.streams import Sample
from services.acquisition.drivers.base import check_packet
from services.acquisition.drivers.packets import Packet, PacketDecoder
from services.acquisition.drivers.sdk_link_driver import BridgeDecoder
from services.acquisition.drivers.sdk_link_protocol import BridgeConnection, BridgeHello
from services.acquisition.drivers.sender_frame import SenderFrame
from services.acquisition.drivers.tracking import (
    PoseStream,
    pose_descriptor,
    source_of,
)

POSE_MAGIC = b"DXPM"
# device index, pose-valid flag, a byte of padding, tracking result, SDK's seconds, 3×4 matrix
POSE_PAYLOAD = struct.Struct("<HBxid12f")
MAX_SECONDS = 2**63 / 1e9


class TrackingResult(IntEnum):
    """OpenVR's tracking results; only RUNNING_OK is a measurement."""

    UNINITIALIZED = 1
    CALIBRATING_IN_PROGRESS = 100
    CALIBRATING_OUT_OF_RANGE = 101
    RUNNING_OK = 200
    RUNNING_OUT_OF_RANGE = 201
    FALLBACK_ROTATION_ONLY = 300


class BridgePoseTrackerDecoder(BridgeDecoder):
    """Poses [x y z qw qx qy qz] (m, world frame) of one device of an OpenVR-like source.

    Only the result RUNNING_OK makes a sample. The pose-valid flag never does: such sources keep it
    set while a lost tracker drifts. A running pose that is flagged invalid is dropped too, and a
    matrix that is no pose is counted as `refused`.

    Args:
        stream: `wrist_left`, `wrist_right`, `head`, or the name of another place.
        serial_number: of the tracker; the bridge's only one at this place if None.
    """

    def __init__(self, stream: str, *, serial_number: str | None = None) -> None:
        self._device = f"pose_tracker_{stream}"
        connection = BridgeConnection(
            "pose_tracker",
            device=self._device,
            source=source_of(stream),
            serial_number=serial_number,
            packets=PacketDecoder(POSE_MAGIC, min_payload=0, max_payload=POSE_PAYLOAD.size),
            payload_bytes=POSE_PAYLOAD.size,
        )
        super().__init__(pose_descriptor(stream), connection)
        self.poses = PoseStream()
        self.tracking = self.poses.events
        self._frame: SenderFrame | None = None

    def events(self) -> dict[str, int]:
        """Packets left out so far, by the reason."""
        return {**self.poses.counts(), **self.connection.order.counts()}

    def reset(self) -> None:
        """The connection was lost."""
        super().reset()
        self.poses.reset()

    def _learn(self, hello: BridgeHello) -> None:
        self._frame = SenderFrame(hello.frame, hello.scale_m())

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
            self.tracking.leave_out("stale")
            return None
        if result != TrackingResult.RUNNING_OK or not flag:
            self.poses.occlude(t_device_ns)
            return None
        try:
            pose = frame.pose(numbers)
        except PacketError:
            self.statistics.refused += 1
            return None
        return self.poses.take(
            pose, sequence=sequence, t_device_ns=t_device_ns, t_host_ns=t_host_ns
        )
