"""A robot hand in, the arrays out that the compiled solver reads."""

import numpy as np

from dextouch.geometry.rotations import rotation_from_quaternion
from dextouch.hands.robot_hand import RobotHand
from dextouch.hands.skeleton import CHAINS, solver_indices
from services.alignment.retargeting.solver.arrays import MAX_JOINTS, HandArrays

# Phalanges of the robot's fingers as capsules.
PHALANX_RADIUS_M = 0.0085
# Where cold searches begin, as fractions from lower to upper limit, knuckle to tip. The first two
# find nearly all postures; the others are for the rest.
STARTS = (
    (0.45, 0.50, 0.40, 0.45),
    (0.75, 0.50, 0.75, 0.70),
    (0.30, 0.25, 0.60, 0.50),
    (0.60, 0.80, 0.45, 0.55),
    (0.20, 0.60, 0.20, 0.20),
    (0.85, 0.30, 0.30, 0.85),
    (0.15, 0.85, 0.85, 0.15),
    (0.90, 0.75, 0.10, 0.50),
)


def hand_arrays(hand: RobotHand) -> HandArrays:
    """The hand's tables, padded to six joints a finger."""
    num = len(hand.fingers)
    rotation = np.zeros((num, MAX_JOINTS, 3, 3))
    position_m, axis = np.zeros((num, MAX_JOINTS, 3)), np.zeros((num, MAX_JOINTS, 3))
    lower_rad, upper_rad = np.zeros((num, MAX_JOINTS)), np.zeros((num, MAX_JOINTS))
    for index, finger in enumerate(hand.fingers):
        for joint, row in enumerate(finger.joints):
            rotation[index, joint] = rotation_from_quaternion(np.array(row.q_wxyz))
            position_m[index, joint] = row.position_m
            axis[index, joint] = np.array(row.axis) / np.linalg.norm(row.axis)
            lower_rad[index, joint], upper_rad[index, joint] = row.limits_rad
    fractions = np.full((len(STARTS), MAX_JOINTS), 0.5)
    fractions[:, :4] = STARTS
    return HandArrays(
        num_joints=np.array([len(finger.joints) for finger in hand.fingers], dtype=np.int64),
        rotation=rotation,
        position_m=position_m,
        axis=axis,
        point_joints=np.array([[1, 2, 3]] * num, dtype=np.int64),
        tip_m=np.array([finger.tip_m for finger in hand.fingers], dtype=np.float64),
        lower_rad=lower_rad,
        upper_rad=upper_rad,
        knuckle_m=hand.chain_points_m(np.zeros((1, 20)))[0, :, 0].copy(),
        starts_rad=lower_rad + fractions[:, None] * (upper_rad - lower_rad),
        radius_m=np.full((num, 3), PHALANX_RADIUS_M),
        nodes=np.array([solver_indices(chain) for chain in CHAINS], dtype=np.int64),
        thumb=CHAINS.index("thumb"),
    )
