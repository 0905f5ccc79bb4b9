"""Poses of trackers: which ones are used, and their conversion from the frame of an SDK.

Of any pose source, only the running state counts, and a pose that the body cannot have
reached since the last good one is a jump. Both leave a gap and are counted, never another pose.
"""

import math
from collections.abc import Sequence
from enum import IntEnum
from operator import mul

import numpy as np

from dextouch.errors import PacketError
from dextouch.streams import ClockCapabilities, Sample, StreamDescriptor
from dextouch.tactile.layout import SIDES
from services.acquisition.drivers.packets import SOURCES
from services.acquisition.drivers.sdk_link import FrameConvention

NOMINAL_RATE_HZ = 100.0
NORM_TOLERANCE = 1e-3
MAX_SPEED_M_PER_S = 5.0
# 2000 °/s, the full scale of the gyroscopes in such trackers.
MAX_TURN_RATE_RAD_PER_S = math.radians(2000.0)
# Packets cannot be closer than half a period, whatever a stepped device clock says.
MIN_STEP_NS = round(0.5e9 / NOMINAL_RATE_HZ)

Rows = Sequence[Sequence[float]]


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
    position of exactly (0, 0, 0) is what trackers send for "none"; it is never reached from
    another one. A quaternion and its negative are the same rotation.

    Args:
        dropped: where packets that become no sample are counted, by the reason.
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
        """The sample of a running tracker's pose; None where it jumps.

        Args:
            pose: x y z (m) qw qx qy qz (unit) in the world frame.
            sequence: of the packet.
            t_device_ns: when the pose was taken.
            t_host_ns: when it arrived.
        """
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
    last = stream.rpartition("_")[2]
    side = last if last in SIDES else None
    return StreamDescriptor.model_validate(
        {
            "name": stream,
            "kind": "pose",
            "shape": (7,),
            "dtype": "float64",
            "unit": "pose_m_wxyz",
            "nominal_rate_hz": NOMINAL_RATE_HZ,
            "frame": "world",
            "side": side,
            "device": f"pose_tracker_{stream}",
            "capabilities": ClockCapabilities(crc=True, sequence=True, device_time=True),
        }
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
    round, so numbers are picked and signed.

    Args:
        convention: says M.
        scale_m: s, metres of the sender's unit.
    """

    def __init__(self, convention: FrameConvention, scale_m: float) -> None:
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
