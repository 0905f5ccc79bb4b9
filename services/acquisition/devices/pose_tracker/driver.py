"""Driver of a pose tracker by HID, USB or its SDK's bridge: poses of a running tracker."""

import math
import struct
from enum import IntEnum
from typing import Literal

from pydantic import field_validator

from dextouch.errors import PacketError
from dextouch.streams import Sample
from services.acquisition.clock import StationClock
from services.acquisition.devices.kind import (
    DeviceKind,
    StreamName,
    TrackerSettings,
    tracker_transport,
)
from services.acquisition.devices.pose_tracker.poses import (
    NORM_TOLERANCE,
    PoseGate,
    SenderFrame,
    TrackingState,
    are_finite,
    pose_descriptor,
    source_of,
)
from services.acquisition.drivers.base import Driver, check_packet
from services.acquisition.drivers.packets import Packet, PacketDecoder
from services.acquisition.drivers.reports import ReportDecoder
from services.acquisition.drivers.sdk_link import (
    DROPPED,
    BridgedDevice,
    BridgeDecoder,
    BridgeDriver,
    BridgeHello,
)

MAGIC = b"DXPT"
# running state, three bytes of padding, x y z (m), qw qx qy qz
PAYLOAD = struct.Struct("<B3x7f")
POSE_MAGIC = b"DXPM"
# device index, pose-valid flag, a byte of padding, tracking result, SDK's seconds, 3×4 matrix
POSE_PAYLOAD = struct.Struct("<HBxid12f")
MAX_SECONDS = 2**63 / 1e9
OTHER_ROLES = ("tactile_", "keypoints_", "camera_", "joints_", "action", "object_poses")


class PoseTrackerDecoder(ReportDecoder):
    """Poses [x y z qw qx qy qz] in the world frame, only while the tracker runs.

    Packets in another state (some trackers keep sending a drifting pose flagged as valid), and
    poses that jump, are counted in `tracking` and dropped: a gap, never a wrong pose.
    What is no pose is counted as `refused`.
    """

    def __init__(self, stream: str) -> None:
        packets = PacketDecoder(MAGIC, min_payload=PAYLOAD.size, max_payload=PAYLOAD.size)
        super().__init__(pose_descriptor(stream), packets)
        self.tracking = dict.fromkeys(DROPPED, 0)
        self._gate = PoseGate(self.tracking)
        self._device = f"pose_tracker_{stream}"
        self._source = source_of(stream)

    def events(self) -> dict[str, int]:
        """Packets left out so far, by the reason."""
        return dict(self.tracking)

    def reset(self) -> None:
        """Forget half a message and the last pose."""
        super().reset()
        self._gate.reset()

    def _sample(self, packet: Packet, t_host_ns: int) -> Sample | None:
        check_packet(packet, device=self._device, source=self._source)
        state, *numbers = PAYLOAD.unpack(packet.payload)
        sequence, t_device_ns = packet.sequence, packet.t_device_ns
        if state != TrackingState.RUNNING_OK:
            self._gate.occlude(t_device_ns)
            return None
        x, y, z, w, i, j, k = numbers
        norm = math.hypot(w, i, j, k)
        if not are_finite(numbers) or abs(norm - 1.0) > NORM_TOLERANCE:
            self.statistics.refused += 1
            return None
        return self._gate.take(
            (x, y, z, w / norm, i / norm, j / norm, k / norm),
            sequence=sequence,
            t_device_ns=t_device_ns,
            t_host_ns=t_host_ns,
        )


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
        super().__init__(
            "pose_tracker",
            pose_descriptor(stream),
            source=source_of(stream),
            serial_number=serial_number,
            magic=POSE_MAGIC,
            payload_bytes=POSE_PAYLOAD.size,
        )
        self._gate = PoseGate(self.tracking)
        # Index and frame of the wanted device, told by the hello.
        self._index: int | None = None
        self._frame: SenderFrame | None = None

    def reset(self) -> None:
        """The connection was lost."""
        super().reset()
        self._gate.reset()

    def _learn(self, hello: BridgeHello, chosen: BridgedDevice) -> None:
        self._index, self._frame = chosen.index, SenderFrame(hello.frame, hello.scale_m())

    def _new_sample(self, packet: Packet, t_host_ns: int) -> Sample | None:
        frame = self._frame
        index, flag, result, seconds, *numbers = POSE_PAYLOAD.unpack(packet.payload)
        if frame is None or index != self._index:
            return None
        check_packet(packet, device=self._device, source=self._source)
        if not (math.isfinite(seconds) and 0 <= seconds < MAX_SECONDS):
            self.statistics.refused += 1
            return None
        sequence, t_device_ns = packet.sequence, round(seconds * 1e9)
        if not self.is_fresh(t_device_ns, t_host_ns):
            return None
        if result != TrackingResult.RUNNING_OK or not flag:
            self._gate.occlude(t_device_ns)
            return None
        try:
            pose = frame.pose(numbers)
        except PacketError:
            self.statistics.refused += 1
            return None
        return self._gate.take(
            pose, sequence=sequence, t_device_ns=t_device_ns, t_host_ns=t_host_ns
        )


class PoseTrackerSettings(TrackerSettings):
    """A pose tracker on a wrist, on the head, or anywhere else (`elbow_left`, `object_cup`).

    The first three (`wrist_left`, `wrist_right`, `head`) are what episodes need; their trackers say
    where they sit, all others say nothing (`none`).
    """

    kind: Literal["pose_tracker"] = "pose_tracker"
    stream: StreamName

    @field_validator("stream")
    @classmethod
    def _is_no_other_role(cls, stream: str) -> str:
        if stream.startswith(OTHER_ROLES):
            raise ValueError(
                f"got {stream!r}, expected the name of a place or a thing; names that begin with "
                f"{', '.join(OTHER_ROLES)} are those of other kinds of streams"
            )
        return stream


def build(settings: PoseTrackerSettings, clock: StationClock) -> Driver:
    """The driver of one tracker, by its link."""
    name = f"pose_tracker_{settings.stream}"
    transport = tracker_transport(settings)
    if settings.link == "bridge":
        bridged = BridgePoseTrackerDecoder(settings.stream, serial_number=settings.serial_number)
        return BridgeDriver(name, transport=transport, decoder=bridged, clock=clock)
    decoder = PoseTrackerDecoder(settings.stream)
    return Driver(name, transport=transport, decoder=decoder, clock=clock)


KIND = DeviceKind(name="pose_tracker", settings=PoseTrackerSettings, build=build)
