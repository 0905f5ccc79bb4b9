"""Robot and human hands of the twin: kinematics, collision shape and tactile skin.

Both are five fingers × four hinges in the wrist frame of `dextouch.hands.robot_hand` (fingers
along -z, thumb side +x, right palm towards +y, left palm towards -y).
"""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache
from typing import Final, NamedTuple

import numpy as np
from jaxtyping import Float64

from dextouch.errors import UnknownNameError
from dextouch.hands import CHAINS, NODE_INDEX, NUM_KEYPOINTS, solver_indices
from dextouch.hands.robot_hand import FingerTable, HandModel, RobotHand
from dextouch.tactile.layout import PALM_PITCH_M, PALM_SHAPE, Side
from services.twin.human_hand import METACARPAL_BASES_M, human_fingers
from services.twin.names import DOMAINS, Domain

# Offset of the sensing skin from the rigid shape, chosen for the most accurate pressure pattern.
SKIN_OFFSET_M: Final = 0.0015
PALM_THICKNESS_M: Final = 0.024
# Fingertip taxels: angle around the finger (radial to ulnar) and positions along the meridian, as
# angles on the cap (distal) or distances along the straight part (proximal).
TIP_COLUMN_ANGLES_RAD: Final = np.deg2rad([60.0, 20.0, -20.0, -60.0])
TIP_CAP_ANGLES_RAD: Final = np.deg2rad([52.0, 20.0])
TIP_SHAFT_M: Final = (0.002, 0.007)


class HandShape(NamedTuple):
    """Collision shape: radii [5][3] of proximal, middle and distal capsules, centre of the palm.

    `palm_z_m` and `palm_x_m` are the palm's centre in the wrist frame; `palm_face_m` is the
    distance of its sensing face from the wrist origin.
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

    Args:
        side: "left" or "right".
        fingers: finger tables of a person, thumb first; default: average size.

    Raises:
        UnknownNameError: any other side.
    """

    def __init__(self, side: str, fingers: Sequence[FingerTable] | None = None) -> None:
        found = human_fingers(side) if fingers is None else fingers
        super().__init__(side, found, name=f"human {side} hand")

    def keypoints_m(self, joints_rad: np.ndarray) -> Float64[np.ndarray, "time 25 3"]:
        """The 25 tracked nodes in wrist coordinates, metres, for joint angles [T, 20]."""
        chains = self.chain_points_m(joints_rad)
        points = np.zeros((len(chains), NUM_KEYPOINTS, 3))
        mirror = np.array([1.0, 1.0 if self.side == "right" else -1.0, 1.0])
        for finger_index, chain in enumerate(CHAINS):
            points[:, solver_indices(chain)] = chains[:, finger_index]
        for chain, base_m in METACARPAL_BASES_M.items():
            points[:, NODE_INDEX[chain, "metacarpal"]] = base_m * mirror
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
    """The hand of one side and domain.

    Raises:
        UnknownNameError: unknown side or domain.
    """
    if domain not in DOMAINS:
        raise UnknownNameError("domain", domain, list(DOMAINS))
    kinematics: HandModel = RobotHand(side) if domain == "robot" else HumanHand(side)
    return TwinHand(side, domain, kinematics, _ROBOT_SHAPE if domain == "robot" else _HUMAN_SHAPE)
