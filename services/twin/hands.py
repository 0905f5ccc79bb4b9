"""Robot and human hands of the twin: kinematics, collision shape and tactile skin.

Both are five fingers × four hinges in the wrist frame of `dextouch.hands.robot_hand`. The human
hand is the mean one of `dextouch.hands`; its limits are our estimates from common anatomy, and its
thumb's base frame is oriented like the robot's.
"""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from functools import lru_cache
from typing import Final, NamedTuple

import numpy as np
from jaxtyping import Float64

from dextouch.errors import UnknownNameError
from dextouch.hands import (
    CHAINS,
    MEAN_FINGERS,
    MEAN_THUMB_BASE_M,
    MEAN_THUMB_BONES_M,
    METACARPAL_NODES,
    NUM_KEYPOINTS,
    FingerTable,
    JointRow,
    Quaternion,
    Vector3,
    mean_hand_m,
    solver_indices,
)
from dextouch.hands.robot_hand import HandModel, RobotHand
from dextouch.tactile.layout import PALM_PITCH_M, PALM_SHAPE, Side
from services.twin.names import DOMAINS, Domain

# Offset of the sensing skin from the rigid shape, chosen for the most accurate pressure pattern.
SKIN_OFFSET_M: Final = 0.0015
PALM_THICKNESS_M: Final = 0.024
# Fingertip taxels: angle around the finger (radial to ulnar) and positions along the meridian, as
# angles on the cap (distal) or distances along the straight part (proximal).
TIP_COLUMN_ANGLES_RAD: Final = np.deg2rad([60.0, 20.0, -20.0, -60.0])
TIP_CAP_ANGLES_RAD: Final = np.deg2rad([52.0, 20.0])
TIP_SHAFT_M: Final = (0.002, 0.007)
# Limits of a finger and the thumb; turns of the thumb's hinges as on the robot.
_FINGER_LIMITS_RAD: Final = ((-0.5, 1.57), (-0.35, 0.35), (0.0, 1.92), (0.0, 1.40))
_THUMB_LIMITS_RAD: Final = ((-1.0, 1.2), (-1.4, 0.6), (-0.5, 1.3), (-0.5, 1.5))
_THUMB_BASE_TURN: Final = (0.6294, -0.0606, -0.7201, 0.2856)
_THUMB_SADDLE_TURN: Final = (0.9347, 0.0919, 0.3425, -0.0234)
_THUMB_ROLL: Final = (0.9591, -0.0122, 0.0419, 0.2796)
_NO_TURN: Final = (1.0, 0.0, 0.0, 0.0)
_ORIGIN: Final = (0.0, 0.0, 0.0)
# Of flexion, abduction and two more flexions.
_AXES: Final = ((1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (1.0, 0.0, 0.0), (1.0, 0.0, 0.0))
# As on the robot: the abduction hinge is the knuckle, the two flexions after it PIP and DIP.
_POINTS: Final = (1, 2, 3)


class HandShape(NamedTuple):
    """Collision shape: radii [5][3] of proximal, middle and distal capsules, and the palm.

    `palm_x_m`, `palm_z_m` are its centre, `palm_face_m` its sensing face, from the wrist origin.
    """

    radii_m: tuple[tuple[float, float, float], ...]
    palm_x_m: float
    palm_z_m: float
    palm_face_m: float


_ROBOT_SHAPE: Final = HandShape(
    ((0.0095, 0.0090, 0.0085), *[(0.0085, 0.0080, 0.0080)] * 4), -0.007, -0.043, 0.008
)
_HUMAN_SHAPE: Final = HandShape(
    ((0.0105, 0.0095, 0.0085), *[(0.0090, 0.0080, 0.0075)] * 3, (0.0080, 0.0070, 0.0070)),
    -0.004,
    -0.046,
    0.009,
)


class HumanHand(HandModel):
    """A human hand with the robot's kinematic tree and joint order, but human bones and limits.

    `fingers` are a person's finger tables, thumb first; by default those of average size. Raises
    UnknownNameError for any other side.
    """

    def __init__(self, side: str, fingers: Sequence[FingerTable] | None = None) -> None:
        found = human_fingers(side) if fingers is None else fingers
        super().__init__(side, found, name=f"human {side} hand")

    def keypoints_m(self, joints_rad: np.ndarray) -> Float64[np.ndarray, "time 25 3"]:
        """The 25 tracked nodes in wrist coordinates, metres, for joint angles [T, 20]."""
        chains = self.chain_points_m(joints_rad)
        points = np.zeros((len(chains), NUM_KEYPOINTS, 3))
        points[:, METACARPAL_NODES] = mean_hand_m(self.side)[METACARPAL_NODES, :]
        for finger_index, chain in enumerate(CHAINS):
            points[:, solver_indices(chain)] = chains[:, finger_index]
        return points


@dataclass(frozen=True)
class TwinHand:
    """One simulated hand: kinematics and shape."""

    side: Side
    domain: Domain
    kinematics: HandModel
    shape: HandShape

    @property
    def palm_sign(self) -> float:
        """+1 where the palm faces +y of the wrist frame (right), -1 where it faces -y."""
        return 1.0 if self.side == "right" else -1.0

    @property
    def palm_centre_m(self) -> Float64[np.ndarray, "3"]:
        """Middle of the palm's face in wrist coordinates."""
        face = self.palm_sign * self.shape.palm_face_m
        return np.array([self.shape.palm_x_m, face, self.shape.palm_z_m])

    def distal_m(self, finger_index: int) -> tuple[float, float]:
        """Length of the distal capsule's straight part and its radius."""
        radius = self.shape.radii_m[finger_index][2]
        length = float(np.linalg.norm(self.kinematics.fingers[finger_index].tip_m))
        return length - radius, radius

    def palm_skin_m(self) -> Float64[np.ndarray, "15 16 3"]:
        """Taxel centres of the palm on its skin, wrist coordinates, anatomical order."""
        rows, columns = PALM_SHAPE
        points = np.zeros((rows, columns, 3))
        across = (np.arange(columns) - 0.5 * (columns - 1)) * PALM_PITCH_M[1]
        along = (np.arange(rows) - 0.5 * (rows - 1)) * PALM_PITCH_M[0]
        points[..., 0] = self.shape.palm_x_m - across[None, :]
        points[..., 1] = self.palm_sign * (self.shape.palm_face_m + SKIN_OFFSET_M)
        points[..., 2] = self.shape.palm_z_m + along[:, None]
        return points

    def tip_skin_m(self, finger_index: int) -> Float64[np.ndarray, "4 4 3"]:
        """Taxel centres of a fingertip, wrapped on its capsule, in the distal joint's frame."""
        straight, radius = self.distal_m(finger_index)
        skin = radius + SKIN_OFFSET_M
        cap = np.array([-np.sin(TIP_CAP_ANGLES_RAD) * skin - straight, np.cos(TIP_CAP_ANGLES_RAD)])
        shaft = np.array([np.array(TIP_SHAFT_M) - straight, np.ones(2)])
        along, reach = np.concatenate([cap, shaft], axis=1)
        around = TIP_COLUMN_ANGLES_RAD
        points = np.zeros((4, 4, 3))
        points[..., 0] = skin * reach[:, None] * np.sin(around)
        points[..., 1] = self.palm_sign * skin * reach[:, None] * np.cos(around)
        points[..., 2] = along[:, None]
        return points


@lru_cache(maxsize=4)
def twin_hand(side: Side, domain: Domain) -> TwinHand:
    """The hand of one side and domain; raises UnknownNameError for unknown side or domain."""
    if domain not in DOMAINS:
        raise UnknownNameError("domain", domain, list(DOMAINS))
    kinematics: HandModel = RobotHand(side) if domain == "robot" else HumanHand(side)
    return TwinHand(side, domain, kinematics, _ROBOT_SHAPE if domain == "robot" else _HUMAN_SHAPE)


def human_fingers(side: str) -> tuple[FingerTable, ...]:
    """Finger tables, thumb … little, of a "left" or "right" human hand."""
    right = (_thumb(), *map(_finger, MEAN_FINGERS))
    return right if side == "right" else tuple(map(_mirrored, right))


def _table(
    chain: str,
    joints: Iterable[str],
    places: Iterable[Vector3],
    turns: Iterable[Quaternion],
    limits_rad: Iterable[tuple[float, float]],
    distal_m: float,
) -> FingerTable:
    rows = zip(joints, zip(places, turns, _AXES, limits_rad, strict=True), strict=True)
    return FingerTable(
        chain,
        tuple(JointRow(f"r_{joint}", *about) for joint, about in rows),
        (0.0, 0.0, -distal_m),
        _POINTS,
    )


def _finger(name: str) -> FingerTable:
    base, lean, (length, proximal, middle, distal) = MEAN_FINGERS[name]
    knuckle = base + length * np.array([np.sin(lean), 0.0, -np.cos(lean)])
    # The finger spreads half as much as its metacarpal, by a rotation about y.
    fan = (float(np.cos(lean / 4)), 0.0, float(-np.sin(lean / 4)), 0.0)
    firmware = "pinky" if name == "little" else f"{name}_finger"
    joints = (f"{firmware}_{joint}" for joint in ("mcp_flex", "mcp_abd", "pip", "dip"))
    place: Vector3 = (float(knuckle[0]), float(knuckle[1]), float(knuckle[2]))
    places = (place, _ORIGIN, (0.0, 0.0, -proximal), (0.0, 0.0, -middle))
    turns = (fan, _NO_TURN, _NO_TURN, _NO_TURN)
    return _table(name, joints, places, turns, _FINGER_LIMITS_RAD, distal)


def _thumb() -> FingerTable:
    metacarpal, proximal, distal = MEAN_THUMB_BONES_M
    joints = (f"thumb_{joint}" for joint in ("cmc_flex", "cmc_abd", "mcp", "ip"))
    places = (MEAN_THUMB_BASE_M, _ORIGIN, (0.0, 0.0, -metacarpal), (0.0, 0.0, -proximal))
    turns = (_THUMB_BASE_TURN, _THUMB_SADDLE_TURN, _THUMB_ROLL, _NO_TURN)
    return _table("thumb", joints, places, turns, _THUMB_LIMITS_RAD, distal)


def _mirrored(finger: FingerTable) -> FingerTable:
    """A finger of the left hand: y positions and rotations about x and z change sign."""
    rows = []
    for row in finger.joints:
        (x, y, z), (qw, qx, qy, qz), (a, b, c) = row.position_m, row.q_wxyz, row.axis
        name, q = f"l_{row.name.removeprefix('r_')}", (qw, -qx, qy, -qz)
        rows.append(JointRow(name, (x, -y, z), q, (-a, b, -c), row.limits_rad))
    x, y, z = finger.tip_m
    return FingerTable(finger.chain, tuple(rows), (x, -y, z), finger.points)
