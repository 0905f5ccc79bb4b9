"""Hand orientations and postures shared by several tasks."""

from typing import Final

import numpy as np
from jaxtyping import Float64

from dextouch.geometry import transform
from dextouch.geometry.rotations import rotation_from_vector
from dextouch.tactile.layout import Side
from services.twin.demonstrators import HandPose
from services.twin.hands import twin_hand
from services.twin.names import Domain

# R_world_wrist with fingers forward (world +y) and the palm down, for the right and left hand.
PALM_DOWN: Final = np.array([[-1.0, 0.0, 0.0], [0.0, 0.0, -1.0], [0.0, -1.0, 0.0]])
PALM_DOWN_LEFT: Final = np.array([[1.0, 0.0, 0.0], [0.0, 0.0, -1.0], [0.0, 1.0, 0.0]])
# Thumbs up, fingers forward: the right palm faces world -x, the left one +x.
THUMB_UP: Final = np.array([[0.0, -1.0, 0.0], [0.0, 0.0, -1.0], [1.0, 0.0, 0.0]])


def yawed(yaw_rad: float) -> Float64[np.ndarray, "3 3"]:
    """Rotation about the world's z axis."""
    return rotation_from_vector(np.array([0.0, 0.0, yaw_rad]))


def flat(domain: Domain) -> Float64[np.ndarray, "20"]:
    """A straight hand with the thumb raised away from the palm."""
    joints = np.zeros((5, 4))
    joints[1:, 0] = -0.12
    joints[0] = [-1.0, 0.2, 0.0, 0.0]
    hand = twin_hand("right", domain)
    return np.clip(joints.ravel(), hand.kinematics.lower_rad, hand.kinematics.upper_rad)


def relaxed(side: Side, domain: Domain) -> HandPose:
    """A half-open hand resting above its side of the table, out of the way."""
    joints = np.tile(np.array([0.25, 0.0, 0.40, 0.25]), 5)
    joints[:4] = [0.2, -0.4, 0.3, 0.3]
    x = -0.26 if side == "left" else 0.26
    R = PALM_DOWN_LEFT if side == "left" else PALM_DOWN
    hand = twin_hand(side, domain)
    clipped = np.clip(joints, hand.kinematics.lower_rad, hand.kinematics.upper_rad)
    return HandPose(transform(R, np.array([x, -0.16, 0.13])), clipped)
