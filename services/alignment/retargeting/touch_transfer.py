"""Transfer of a tracked hand to the robot so that it touches where the person did.

Retargeting gives the person's posture on a larger hand. Where touch was recorded, the robot's wrist
is shifted (`wrist_transfer`) and its touching fingertips are moved (`touch_anchor`), so that the
points in contact coincide. Without touch only a constant shift remains.
"""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float64

from dextouch.hands.robot_hand import RobotHand
from services.alignment.retargeting.touch_anchor import anchored_joints, touch_shares
from services.alignment.retargeting.wrist_transfer import (
    matched_points,
    shifted_wrist,
    touch_offsets_m,
)


@dataclass(frozen=True)
class TransferredHand:
    """Reached poses of the robot's hand; `offset_m` is the shift of the wrist in its own axes."""

    Ts_world_wrist: Float64[np.ndarray, "time 4 4"]
    joints_rad: Float64[np.ndarray, "time 20"]
    offset_m: Float64[np.ndarray, "time 3"]


def transfer_by_touch(
    hand: RobotHand,
    Ts_world_human: Float64[np.ndarray, "time 4 4"],
    joints_rad: Float64[np.ndarray, "time 20"],
    *,
    keypoints_m: Float64[np.ndarray, "time 25 3"],
    pad_forces_n: Float64[np.ndarray, "time 6"],
    t_s: Float64[np.ndarray, " time"],
) -> TransferredHand:
    """Shift the wrist and move touching fingertips to the person's positions.

    Args:
        hand: robot hand.
        Ts_world_human: tracked wrist of the person.
        joints_rad: retargeted angles.
        keypoints_m: of the person, in wrist axes; NaN marks a missing node.
        pad_forces_n: forces on thumb … little fingertip and palm; zeros without a glove.
        t_s: increasing times with any origin.

    Raises:
        ShapeError: lengths that differ.
        InvalidInputError: no fingertip and no palm was ever tracked.
    """
    points = matched_points(keypoints_m, joints_rad, hand)
    offset_m = touch_offsets_m(points, pad_forces_n, t_s)
    shares = touch_shares(pad_forces_n, t_s)
    joints = anchored_joints(hand, joints_rad, points, offset_m, shares)
    return TransferredHand(shifted_wrist(Ts_world_human, offset_m), joints, offset_m)
