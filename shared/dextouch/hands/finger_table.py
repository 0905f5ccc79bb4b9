"""Kinematic table of a finger: its hinges, its tip, and which hinges are its knuckles.

Hinges are ordered from the wrist outwards. Each has a frame in its parent's frame (the first: in
the wrist frame), rotates about an axis of its own frame, and has limits.
"""

from collections.abc import Iterable, Sequence
from typing import Final, NamedTuple

import numpy as np

from dextouch.errors import InvalidInputError, NonFiniteError, UnknownNameError
from dextouch.hands.skeleton import CHAINS

Vector3 = tuple[float, float, float]
Quaternion = tuple[float, float, float, float]

MAX_HINGES: Final = 6
# Tolerance of unit axes, small enough not to affect fingertip positions.
AXIS_TOLERANCE: Final = 1e-9
_POINT_NAMES: Final = ("knuckle", "PIP", "DIP")


class JointRow(NamedTuple):
    """One hinge: pose of its frame in the parent, axis and limits."""

    name: str
    position_m: Vector3
    q_wxyz: Quaternion
    axis: Vector3
    limits_rad: tuple[float, float]


class FingerTable(NamedTuple):
    """One finger: 1 to 6 hinges from the wrist outwards, and the tip in the last hinge's frame.

    `chain` is the finger of the tracked skeleton that this one follows (`CHAINS`). `points` are the
    indices of the hinges whose origins are the knuckle (of the thumb: the CMC joint), the PIP (MCP)
    and the DIP (IP) joint. A finger with fewer hinges repeats an index: that bone has zero length.
    """

    chain: str
    joints: tuple[JointRow, ...]
    tip_m: Vector3
    points: tuple[int, int, int]


def check_fingers(fingers: Sequence[FingerTable], *, where: str) -> None:
    """Validate finger tables.

    Args:
        fingers: of one hand.
        where: prefix of error messages.

    Raises:
        InvalidInputError: no finger, a chain or name given twice, too few or many hinges, limits
            that are not an interval, an axis that is not a unit vector, points out of order.
        NonFiniteError: NaN or infinity in a table.
        UnknownNameError: a chain that the skeleton lacks.
    """
    _check_unique((finger.chain for finger in fingers), f"{where}: finger chain")
    _check_unique((row.name for finger in fingers for row in finger.joints), f"{where}: joint")
    if not fingers:
        raise InvalidInputError(f"{where}: got no finger, expected at least one")
    for finger in fingers:
        if finger.chain not in CHAINS:
            raise UnknownNameError(f"chain of a finger of {where}", finger.chain, list(CHAINS))
        _check_finger(finger, f"{where}, finger {finger.chain!r}")


def _check_unique(names: Iterable[str], what: str) -> None:
    seen: set[str] = set()
    for name in names:
        if name in seen:
            raise InvalidInputError(
                f"{what} {name!r} appears twice; names must differ, fingers share no hinge",
                got=name,
            )
        seen.add(name)


def _check_finger(finger: FingerTable, where: str) -> None:
    count = len(finger.joints)
    if not 1 <= count <= MAX_HINGES:
        raise InvalidInputError(f"{where}: got {count} hinges, expected 1 … {MAX_HINGES}")
    knuckle, pip, dip = finger.points
    if not 0 <= knuckle <= pip <= dip < count:
        raise InvalidInputError(
            f"{where}: got hinges {finger.points} as {', '.join(_POINT_NAMES)}; expected indices "
            f"of its {count} hinges from the wrist outwards"
        )
    _check_finite(finger.tip_m, f"{where}: tip")
    for row in finger.joints:
        _check_row(row, f"{where}, joint {row.name!r}")


def _check_row(row: JointRow, where: str) -> None:
    for what, values in zip(row._fields[1:], row[1:], strict=True):
        _check_finite(values, f"{where}: {what}")
    lower, upper = row.limits_rad
    if lower >= upper:
        raise InvalidInputError(
            f"{where}: got limits {lower} … {upper} rad, expected lower < upper"
        )
    if not any(row.q_wxyz):
        raise InvalidInputError(f"{where}: got a quaternion of zeros, expected a rotation")
    length = float(np.linalg.norm(row.axis))
    if abs(length - 1) > AXIS_TOLERANCE:
        raise InvalidInputError(f"{where}: got an axis of length {length}, expected a unit vector")


def _check_finite(values: Sequence[float], what: str) -> None:
    if not np.isfinite(values).all():
        raise NonFiniteError(f"{what}: got {tuple(values)}, expected finite numbers")
