"""Tables of a robot hand in the form that the compiled solver reads."""

import numpy as np
from jaxtyping import Bool, Float64

from dextouch.geometry.rotations import rotation_from_quaternion
from dextouch.hands import solver_indices
from dextouch.hands.robot_hand import HandModel
from services.alignment.retargeting.solver.arrays import HAND, MAX_JOINTS, MAX_STARTS

NO_TURN = (1.0, 0.0, 0.0, 0.0)
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


def hand_arrays(hand: HandModel) -> np.ndarray:
    """The hand's tables as one record `HAND`, shape [1]."""
    record = np.zeros(1, dtype=HAND)
    row = record[0]
    row["num_fingers"] = len(hand.fingers)
    row["thumb"] = next((f for f, one in enumerate(hand.fingers) if one.chain == "thumb"), -1)
    fractions = np.full((MAX_STARTS, 1, MAX_JOINTS), 0.5)
    fractions[:, 0, :4] = STARTS
    for index, finger in enumerate(hand.fingers):
        row["num_joints"][index] = len(finger.joints)
        row["point_joints"][index] = finger.points
        row["tip_m"][index] = finger.tip_m
        row["radius_m"][index] = PHALANX_RADIUS_M
        row["nodes"][index] = solver_indices(finger.chain)
        for point in (1, 2):
            # A finger with fewer joints: one bone follows two of the person's.
            if finger.points[point] == finger.points[point - 1]:
                row["nodes"][index, point] = -1
        for joint, one in enumerate(finger.joints):
            row["rotation"][index, joint] = rotation_from_quaternion(np.array(one.q_wxyz))
            row["position_m"][index, joint] = one.position_m
            axis = np.array(one.axis) / np.linalg.norm(one.axis)
            row["axis"][index, joint] = axis
            row["is_turned"][index, joint] = tuple(one.q_wxyz) != NO_TURN
            along = int(np.argmax(np.abs(axis)))
            row["axis_kind"][index, joint] = along if abs(axis[along]) == 1.0 else 3
            row["axis_sign"][index, joint] = np.sign(axis[along])
            row["lower_rad"][index, joint], row["upper_rad"][index, joint] = one.limits_rad
    row["starts_rad"] = row["lower_rad"] + fractions * (row["upper_rad"] - row["lower_rad"])
    row["knuckle_m"][: len(hand.fingers)] = zero_points_m(hand)[:, 0]
    return record


def joint_places(hand: HandModel) -> Bool[np.ndarray, "fingers 6"]:
    """Indices of the hand's joints in the solver's [fingers, 6] angles."""
    counts = np.array([len(finger.joints) for finger in hand.fingers])
    return np.asarray(np.arange(MAX_JOINTS) < counts[:, None])


def zero_points_m(hand: HandModel) -> Float64[np.ndarray, "fingers 4 3"]:
    """Knuckle, PIP, DIP and tip of every finger at zero angles."""
    return hand.chain_points_m(np.zeros((1, len(hand.joint_names))))[0]
