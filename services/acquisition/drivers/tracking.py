"""Gate of all trackers: which poses are used, and how many were dropped and why.

Of any pose source, only the running state counts, and a pose that the body cannot have
reached since the last good one is a jump. Both leave a gap and are counted, never another pose.
"""

import math
from collections.abc import Sequence
from enum import IntEnum
from operator import mul
from typing import Literal

import numpy as np

from dextouch.streams import ClockCapabilities, Sample, StreamDescriptor
from dextouch.tactile.layout import SIDES
from services.acquisition.drivers.packets import SOURCES
from services.acquisition.drivers.reports import OrderFilter

NOMINAL_RATE_HZ = 100.0
NORM_TOLERANCE = 1e-3
MAX_SPEED_M_PER_S = 5.0
# 2000 °/s, the full scale of the gyroscopes in such trackers.
MAX_TURN_RATE_RAD_PER_S = math.radians(2000.0)
# Packets cannot be closer than half a period, whatever a stepped device clock says.
MIN_STEP_NS = round(0.5e9 / NOMINAL_RATE_HZ)

EventKind = Literal["occluded", "jumped", "stale"]


class TrackingState(IntEnum):
    """What the tracker says about its own pose; only RUNNING_OK is a measurement."""

    UNINITIALIZED = 0
    CALIBRATING = 1
    OUT_OF_RANGE = 2
    FALLBACK_ROTATION_ONLY = 3
    RUNNING_OK = 200


class TrackingEvents:
    """How many packets of one tracker were dropped for each reason."""

    def __init__(self) -> None:
        self.packets: dict[str, int] = {"occluded": 0, "jumped": 0, "stale": 0}

    def leave_out(self, kind: EventKind) -> None:
        """Count a dropped packet."""
        self.packets[kind] += 1


class PoseGate:
    """Refuses a pose that cannot be reached from the last good one since that was taken.

    Reachable means: at 5 m/s and 2000 °/s at most. The time in between is the device's, at least
    half a period for every packet, so that a step of its clock cannot shut the gate for good. A
    position of exactly (0, 0, 0) is what trackers send for "none"; it is never reached from
    another one. A quaternion and its negative are the same rotation.
    """

    def __init__(self) -> None:
        self._last: tuple[float, ...] | None = None
        self._elapsed_ns = 0
        self._t_device_ns: int | None = None

    def reset(self) -> None:
        """Forget the last good pose: the link was lost, the tracker may be elsewhere."""
        self._last = None
        self._elapsed_ns = 0
        self._t_device_ns = None

    def pass_time(self, t_device_ns: int) -> None:
        """A packet came, whatever becomes of it."""
        if self._t_device_ns is not None:
            self._elapsed_ns += max(t_device_ns - self._t_device_ns, MIN_STEP_NS)
        self._t_device_ns = t_device_ns

    def admits(self, pose: Sequence[float]) -> bool:
        """Whether x y z (m) qw qx qy qz (unit) can be reached; if so it is the new last one."""
        candidate = tuple(pose)
        if self._last is not None and not self._is_reachable(self._last, candidate):
            return False
        self._last, self._elapsed_ns = candidate, 0
        return True

    def _is_reachable(self, last: tuple[float, ...], pose: tuple[float, ...]) -> bool:
        if not any(pose[:3]) and any(last[:3]):
            return False
        elapsed_s = self._elapsed_ns / 1e9
        if math.dist(pose[:3], last[:3]) > MAX_SPEED_M_PER_S * elapsed_s:
            return False
        cosine = abs(math.fsum(map(mul, pose[3:], last[3:])))
        return 2.0 * math.acos(min(1.0, cosine)) <= MAX_TURN_RATE_RAD_PER_S * elapsed_s


class PoseStream:
    """Gate, order and counts of one tracker's poses, which all pose sources share."""

    def __init__(self) -> None:
        self.order = OrderFilter()
        self.gate = PoseGate()
        self.events = TrackingEvents()

    def reset(self) -> None:
        """The link was lost."""
        self.order.reset()
        self.gate.reset()

    def counts(self) -> dict[str, int]:
        """Packets left out so far, by the reason."""
        return {**self.events.packets, **self.order.counts()}

    def occlude(self, t_device_ns: int) -> None:
        """The tracker is not running: whatever pose it sends is none."""
        self.gate.pass_time(t_device_ns)
        self.events.leave_out("occluded")

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
        self.gate.pass_time(t_device_ns)
        if not self.gate.admits(pose):
            self.events.leave_out("jumped")
            return None
        return Sample(t_host_ns, np.array(pose), t_device_ns, sequence)


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
