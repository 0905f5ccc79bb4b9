"""Driver of a pose tracker by HID, USB or its SDK's bridge: poses of a running tracker.

Of any pose source, only the running state counts, and a pose that the body cannot have reached
since the last good one is a jump. Both leave a gap and are counted, never another pose.
"""

import math
import struct
from collections.abc import Sequence
from enum import IntEnum
from operator import mul
from typing import Literal

import numpy as np
from pydantic import field_validator

from dextouch.errors import PacketError
from dextouch.streams import ClockCapabilities, Sample, StreamDescriptor
from dextouch.tactile.layout import SIDES
from services.acquisition.clock import StationClock
from services.acquisition.devices.kinds import (
    DeviceKind,
    StreamName,
    TrackerSettings,
    tracker_transport,
)
from services.acquisition.drivers import sdk_link
from services.acquisition.drivers.base import Driver, ReportDecoder, check_packet
from services.acquisition.drivers.packets import SOURCES, Packet, PacketDecoder

NOMINAL_RATE_HZ = 100.0
NORM_TOLERANCE = 1e-3
MAX_SPEED_M_PER_S = 5.0
# 2000 °/s, the full scale of the gyroscopes in such trackers.
MAX_TURN_RATE_RAD_PER_S = math.radians(2000.0)
# Packets cannot be closer than half a period, whatever a stepped device clock says.
MIN_STEP_NS = round(0.5e9 / NOMINAL_RATE_HZ)

Rows = Sequence[Sequence[float]]
MAGIC = b"DXPT"
# running state, three bytes of padding, x y z (m), qw qx qy qz
PAYLOAD = struct.Struct("<B3x7f")
POSE_MAGIC = b"DXPM"
# device index, pose-valid flag, a byte of padding, tracking result, SDK's seconds, 3×4 matrix
POSE_PAYLOAD = struct.Struct("<HBxid12f")
MAX_SECONDS = 2**63 / 1e9
OTHER_ROLES = ("tactile_", "keypoints_", "camera_", "joints_", "action", "object_poses")


class TrackingState(IntEnum):
    """What the tracker says about its own pose; only RUNNING_OK is a measurement."""

    UNINITIALIZED = 0
    CALIBRATING = 1
    OUT_OF_RANGE = 2
    FALLBACK_ROTATION_ONLY = 3
    RUNNING_OK = 200


class PoseGate:
    """Refuses a pose that cannot be reached from the last good one since that was taken.

    Reachable means: at 5 m/s and 2000 °/s at most. The time in between is the device's, at least
    half a period for every packet, so that a step of its clock cannot shut the gate for good. A
    position of exactly (0, 0, 0) is what trackers send for "none"; it is never reached from another
    one. A quaternion and its negative are the same rotation. `dropped` counts packets that become
    no sample, by the reason.
    """

    def __init__(self, dropped: dict[str, int]) -> None:
        self._dropped = dropped
        self.reset()

    def reset(self) -> None:
        """Forget the last good pose: the link was lost, the tracker may be elsewhere."""
        self._last: Sequence[float] | None = None
        self._elapsed_ns = 0
        self._t_device_ns: int | None = None

    def occlude(self, t_device_ns: int) -> None:
        """The tracker is not running: whatever pose it sends is none."""
        self._pass_time(t_device_ns)
        self._dropped["occluded"] += 1

    def take(
        self, pose: Sequence[float], *, sequence: int, t_device_ns: int, t_host_ns: int
    ) -> Sample | None:
        """The sample of a pose x y z (m) qw qx qy qz (unit) in the world; None where it jumps."""
        self._pass_time(t_device_ns)
        if self._last is not None and not self._is_reachable(self._last, pose):
            self._dropped["jumped"] += 1
            return None
        self._last, self._elapsed_ns = pose, 0
        return Sample(t_host_ns, np.array(pose), t_device_ns, sequence)

    def _pass_time(self, t_device_ns: int) -> None:
        if self._t_device_ns is not None:
            self._elapsed_ns += max(t_device_ns - self._t_device_ns, MIN_STEP_NS)
        self._t_device_ns = t_device_ns

    def _is_reachable(self, last: Sequence[float], pose: Sequence[float]) -> bool:
        if not any(pose[:3]) and any(last[:3]):
            return False
        elapsed_s = self._elapsed_ns / 1e9
        if math.dist(pose[:3], last[:3]) > MAX_SPEED_M_PER_S * elapsed_s:
            return False
        cosine = abs(math.fsum(map(mul, pose[3:], last[3:])))
        return 2.0 * math.acos(min(1.0, cosine)) <= MAX_TURN_RATE_RAD_PER_S * elapsed_s


def pose_descriptor(stream: str) -> StreamDescriptor:
    """The stream of a tracker on a wrist, the head or anything else, by its name."""
    return StreamDescriptor(
        name=stream,
        kind="pose",
        shape=(7,),
        dtype="float64",
        unit="pose_m_wxyz",
        nominal_rate_hz=NOMINAL_RATE_HZ,
        frame="world",
        side=next((side for side in SIDES if stream.rpartition("_")[2] == side), None),
        device=f"pose_tracker_{stream}",
        capabilities=ClockCapabilities(crc=True, sequence=True, device_time=True),
    )


def are_finite(numbers: Sequence[float]) -> bool:
    """Whether each of some float32s is a number: only then is their sum, which cannot overflow."""
    return math.isfinite(sum(numbers))


def source_of(stream: str) -> str:
    """Where the tracker of a stream sits, as packets call it: left, right, head, else none."""
    source = stream.removeprefix("wrist_")
    return source if source in SOURCES else "none"


class SenderFrame:
    """Turns poses of one sender into ours.

    With p_ours = M p_theirs for the world and for the body, R_ours = M R Mᵀ and t_ours = s M t.
    This holds for a left-handed sender too: both mirrors cancel in the rotation, whose axis is
    det(M) M times the sender's and whose angle is the same. M only renames axes and turns some
    round, so numbers are picked and signed. `scale_m` is s, metres of the sender's unit.
    """

    def __init__(self, convention: sdk_link.FrameConvention, scale_m: float) -> None:
        M = convention.ours_from_theirs()
        # Which of the sender's axes is our x, y, z, and what it is multiplied by.
        self._places = np.abs(M).argmax(axis=1).tolist()
        self._lengths_m = (scale_m * M.sum(axis=1)).tolist()
        self._turns = np.rint(np.linalg.det(M) * M.sum(axis=1)).tolist()

    def pose(self, numbers: Sequence[float]) -> tuple[float, ...]:
        """Pose x y z (m) qw qx qy qz of the twelve numbers of [R | t], row by row.

        Raises:
            PacketError: not finite, or R is no rotation (by more than 1e-3).
        """
        if not are_finite(numbers):
            raise PacketError("pose matrix: NaN or infinity")
        R, t = (numbers[0:3], numbers[4:7], numbers[8:11]), numbers[3::4]
        check_rotation(R)
        w, *axis = quaternion_of_one(R)
        # Plus zero, so that there is no −0, on which signs would hang.
        return (
            *(m * t[place] + 0.0 for place, m in zip(self._places, self._lengths_m, strict=True)),
            w,
            *(
                sign * axis[place] + 0.0
                for place, sign in zip(self._places, self._turns, strict=True)
            ),
        )


def quaternion_of_one(R: Rows) -> tuple[float, float, float, float]:
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


def check_rotation(R: Rows) -> None:
    """Refuse rows that are no rotation.

    Raises:
        PacketError: off by more than 1e-3, or mirrored.
    """
    (a, b, c), (d, e, f), (g, h, i) = R
    error = max(
        abs(a * a + b * b + c * c - 1),
        abs(d * d + e * e + f * f - 1),
        abs(g * g + h * h + i * i - 1),
        abs(a * d + b * e + c * f),
        abs(d * g + e * h + f * i),
        abs(g * a + h * b + i * c),
    )
    determinant = a * (e * i - f * h) - b * (d * i - f * g) + c * (d * h - e * g)
    if error > NORM_TOLERANCE or determinant < 0:
        raise PacketError(f"pose matrix: no rotation (R Rᵀ is off by {error:.1e})")


class PoseTrackerDecoder(ReportDecoder):
    """Poses [x y z qw qx qy qz] in the world frame, only while the tracker runs.

    Packets in another state (some trackers keep sending a drifting pose flagged as valid), and
    poses that jump, are counted in `tracking` and dropped: a gap, never a wrong pose.
    What is no pose is counted as `refused`.
    """

    def __init__(self, stream: str) -> None:
        packets = PacketDecoder(MAGIC, min_payload=PAYLOAD.size, max_payload=PAYLOAD.size)
        super().__init__(pose_descriptor(stream), packets)
        self.tracking = dict.fromkeys(sdk_link.DROPPED, 0)
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


class BridgePoseTrackerDecoder(sdk_link.BridgeDecoder):
    """Poses [x y z qw qx qy qz] (m, world frame) of one device of an OpenVR-like source.

    Only the result RUNNING_OK makes a sample. The pose-valid flag never does: such sources keep it
    set while a lost tracker drifts. A running pose that is flagged invalid is dropped too, and a
    matrix that is no pose is counted as `refused`. Without a serial number it is the bridge's only
    device at this place.
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

    def _learn(self, hello: sdk_link.BridgeHello, chosen: sdk_link.BridgedDevice) -> None:
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
        return sdk_link.BridgeDriver(name, transport=transport, decoder=bridged, clock=clock)
    decoder = PoseTrackerDecoder(settings.stream)
    return Driver(name, transport=transport, decoder=decoder, clock=clock)


KIND = DeviceKind(name="pose_tracker", settings=PoseTrackerSettings, build=build)
