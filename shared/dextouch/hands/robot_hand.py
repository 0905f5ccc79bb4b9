"""Kinematic models of robot hands: joint names, limits and forward kinematics in the wrist frame.

Hinges of a finger are ordered from the wrist outwards, each in its parent's frame (the first: the
wrist's), about an axis of its own frame. All hands share one wrist frame: fingers along -z, the
thumb side +x, the right palm faces +y, the left -y.
"""

import json
from collections import Counter
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from functools import cache, cached_property
from importlib.resources import files
from typing import Any, Final, Literal, NamedTuple

import numpy as np
from jaxtyping import Bool, Float64, Int64

from dextouch.errors import InvalidInputError, NonFiniteError, ShapeError, UnknownNameError
from dextouch.geometry import transform
from dextouch.geometry.rotations import rotation_from_quaternion
from dextouch.hands.skeleton import CHAINS

NUM_JOINTS: Final = 20  # of the Wuji Hand 2: four a finger
NUM_FINGERS: Final = 5
SIDES: Final[tuple[Literal["left", "right"], ...]] = ("left", "right")
Vector3 = tuple[float, float, float]
Quaternion = tuple[float, float, float, float]

MAX_HINGES: Final = 6  # chosen: two more than our own fingers have
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


@dataclass(frozen=True)
class _Chains:
    """Hinges of one hand's fingers, or several hands', padded to the longest finger."""

    is_joint: Bool[np.ndarray, "*hands fingers hinges"]
    offsets: Float64[np.ndarray, "*hands fingers hinges 4 4"]
    axes: Float64[np.ndarray, "*hands fingers hinges 3"]
    tips_m: Float64[np.ndarray, "*hands fingers 3"]
    points: Int64[np.ndarray, "fingers 3"]

    @classmethod
    def of(cls, fingers: Sequence[FingerTable]) -> "_Chains":
        counts = np.array([len(finger.joints) for finger in fingers])
        is_joint = np.arange(counts.max()) < counts[:, np.newaxis]
        rows = [row for finger in fingers for row in finger.joints]
        R = rotation_from_quaternion(np.array([row.q_wxyz for row in rows]))
        offsets = np.tile(np.eye(4), (len(counts), counts.max(), 1, 1))
        offsets[is_joint] = transform(R, np.array([row.position_m for row in rows]))
        axes = np.zeros((len(counts), counts.max(), 3))
        axes[is_joint] = [row.axis for row in rows]
        tips_m = np.array([finger.tip_m for finger in fingers])
        return cls(is_joint, offsets, axes, tips_m, np.array([each.points for each in fingers]))

    @cached_property
    def _cross(self) -> Float64[np.ndarray, "*hands fingers hinges 3 3"]:
        return np.cross(np.eye(3), self.axes[..., None, :])

    @cached_property
    def _cross_squared(self) -> Float64[np.ndarray, "*hands fingers hinges 3 3"]:
        return self._cross @ self._cross

    def frames(
        self, angles_rad: Float64[np.ndarray, "time *hands fingers hinges"]
    ) -> Float64[np.ndarray, "time *hands fingers hinges 4 4"]:
        """T_wrist_joint of every hinge after its rotation; padding repeats the last frame."""
        angles = angles_rad[..., None, None]
        # Rodrigues' formula; axes are unit vectors, of padding zero.
        R = np.eye(3) + np.sin(angles) * self._cross + (1 - np.cos(angles)) * self._cross_squared
        turns = transform(R, np.zeros(3))
        frames = np.empty(turns.shape)
        T_wrist_parent = np.broadcast_to(np.eye(4), frames[..., 0, :, :].shape)
        for hinge in range(self.axes.shape[-2]):
            T_parent_hinge = self.offsets[..., hinge, :, :]
            T_wrist_parent = T_wrist_parent @ T_parent_hinge @ turns[..., hinge, :, :]
            frames[..., hinge, :, :] = T_wrist_parent
        return frames

    def points_m(
        self, frames: Float64[np.ndarray, "time *hands fingers hinges 4 4"]
    ) -> Float64[np.ndarray, "time *hands fingers 4 3"]:
        # Padded with the last frame, so that index -1 is valid for all fingers.
        last = frames[..., -1, :, :]
        tips_m = (last[..., :3, :3] @ self.tips_m[..., None])[..., 0] + last[..., :3, 3]
        fingers = np.arange(len(self.points))[:, None]
        origins_m = frames[..., :3, 3][..., fingers, self.points, :]
        return np.concatenate([origins_m, tips_m[..., None, :]], axis=-2)


class HandModel:
    """A hand of 1 to 5 fingers with 1 to 6 hinges each, whose name is for messages.

    Attributes:
        fingers: the tables, which do not change: others are another hand.
        joint_names: in the order of the joint vector: finger by finger, from the wrist out.
        lower_rad, upper_rad: joint limits [joints].
        finger_of_joint: index of each joint's finger [joints].

    Raises:
        UnknownNameError: a side other than "left" and "right", or an unknown chain.
        InvalidInputError: no finger, a chain or name given twice, too few or many hinges, limits
            that are not an interval, an axis that is not a unit vector, points out of order; the
            message names the joint.
        NonFiniteError: NaN or infinity in a table.
    """

    def __init__(self, side: str, fingers: Sequence[FingerTable], *, name: str) -> None:
        if side not in SIDES:
            raise UnknownNameError("side", side, list(SIDES))
        _check_fingers(fingers, name)
        self.side = side
        self.name = name
        self.fingers = tuple(fingers)
        rows = [row for finger in fingers for row in finger.joints]
        self.joint_names = tuple(row.name for row in rows)
        self.lower_rad, self.upper_rad = np.array([row.limits_rad for row in rows]).T.copy()
        self._chains = _Chains.of(fingers)
        self.finger_of_joint = np.nonzero(self._chains.is_joint)[0]

    def joint_frames(
        self, joints_rad: np.ndarray
    ) -> Float64[np.ndarray, "time fingers hinges 4 4"]:
        """T_wrist_joint of every hinge after its rotation; [T, 5, 4, 4, 4] for the Wuji hand.

        A finger with fewer hinges than another repeats its last frame. Angles [T, J] are in the
        order of `joint_names`.

        Raises:
            ShapeError: not [T, J].
            NonFiniteError: NaN or infinity.
        """
        q = np.asarray(joints_rad, dtype=np.float64)
        count = len(self.joint_names)
        if q.ndim != 2 or q.shape[1] != count:
            raise ShapeError(f"joint angles: got shape {q.shape}, expected [T, {count}]")
        if not np.isfinite(q).all():
            raise NonFiniteError(f"joint angles of the {self.side} hand hold NaN or infinity")
        is_joint = self._chains.is_joint
        angles_rad = np.zeros((len(q), *is_joint.shape))
        angles_rad[:, is_joint] = q
        return self._chains.frames(angles_rad)

    def chain_points_m(self, joints_rad: np.ndarray) -> Float64[np.ndarray, "time fingers 4 3"]:
        """Knuckle, PIP, DIP and tip of every finger in wrist coordinates, metres.

        The knuckle is the base of the first phalanx: for the Wuji hand the origin of the abduction
        frame (thumb: of the second CMC frame).
        """
        return self._chains.points_m(self.joint_frames(joints_rad))

    def fingertips_m(self, joints_rad: np.ndarray) -> Float64[np.ndarray, "time fingers 3"]:
        """Fingertips in wrist coordinates, metres, for joint angles [T, J]."""
        return self.chain_points_m(joints_rad)[:, :, 3]


class RobotHand(HandModel):
    """Wuji Hand 2 (Beta 2): five fingers × four hinges, thumb … little, from the wrist outwards.

    The four hinges of a finger are S1 flexion, S2 abduction, S3 and S4 flexion. The tables of both
    hands, which are not exact mirrors, are in `wuji_hand_2.json`: the exact values of the
    manufacturer's MJCF (MIT, (c) 2025 Wuji Technology; `aiowuji` 0.1.0 on PyPI), fingertips its
    sites `*_tip`. Raises UnknownNameError for a side other than "left" and "right".
    """

    def __init__(self, side: str) -> None:
        super().__init__(side, _wuji_hand_2().get(side, ()), name=f"Wuji Hand 2 {side}")


def chain_points_of_both_m(joints_rad: np.ndarray) -> Float64[np.ndarray, "time 2 5 4 3"]:
    """`RobotHand.chain_points_m` of finite angles [T, 2, 20] of both hands, left before right."""
    chains = _both_hands()
    angles_rad = np.asarray(joints_rad, dtype=np.float64).reshape(-1, *chains.axes.shape[:-1])
    return chains.points_m(chains.frames(angles_rad))


@cache
def _both_hands() -> _Chains:
    hands = [_Chains.of(_wuji_hand_2()[side]) for side in SIDES]
    names = ("is_joint", "offsets", "axes", "tips_m")
    is_joint, offsets, axes, tips_m = (
        np.stack([getattr(hand, name) for hand in hands]) for name in names
    )
    return _Chains(is_joint, offsets, axes, tips_m, hands[0].points)


@cache
def _wuji_hand_2() -> dict[str, tuple[FingerTable, ...]]:
    def row(values: dict[str, Any]) -> Any:  # noqa: ANN401 - a table, a row or the whole file
        values = {key: tuple(v) if isinstance(v, list) else v for key, v in values.items()}
        if "joints" in values:
            return FingerTable(**values)
        return JointRow(**values) if "axis" in values else values

    text = files("dextouch.hands").joinpath("wuji_hand_2.json").read_text(encoding="utf-8")
    tables: dict[str, tuple[FingerTable, ...]] = json.loads(text, object_hook=row)
    return tables


def _check_fingers(fingers: Sequence[FingerTable], where: str) -> None:
    _check_unique((finger.chain for finger in fingers), f"{where}: finger chain")
    _check_unique((row.name for finger in fingers for row in finger.joints), f"{where}: joint")
    if not fingers:
        raise InvalidInputError(f"{where}: got no finger, expected at least one")
    for finger in fingers:
        if finger.chain not in CHAINS:
            raise UnknownNameError(f"chain of a finger of {where}", finger.chain, list(CHAINS))
        _check_finger(finger, f"{where}, finger {finger.chain!r}")


def _check_unique(names: Iterable[str], what: str) -> None:
    for name, count in Counter(names).items():
        if count > 1:
            raise InvalidInputError(
                f"{what} {name!r} appears twice; names must differ, fingers share no hinge",
                got=name,
            )


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
