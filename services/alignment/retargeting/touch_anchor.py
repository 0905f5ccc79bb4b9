"""Correction of retargeted joint angles that moves fingertips in contact to the human positions.

Retargeting by bone directions gives the same posture, but on a larger hand: around an object its
fingertips miss the human contact points. The solver closes pinches; with an object in between, only
touch shows which fingertips matter. Those are moved to the human positions, each finger by its own
four joints, near the retargeted angles. Fingers without contact are unchanged.
"""

from dataclasses import dataclass
from typing import Final

import numpy as np
from jaxtyping import Float64

from dextouch.errors import InvalidInputError, ShapeError
from dextouch.hands.robot_hand import NUM_FINGERS, NUM_JOINTS, RobotHand
from services.alignment.retargeting.wrist_transfer import MatchedPoints

# A few steps converge to micrometres; unreachable positions take more.
_ITERATIONS: Final = 15
# Smaller shares would move a fingertip by micrometres only: these fingers are unchanged.
_NO_SHARE: Final = 1e-3


@dataclass(frozen=True)
class TouchAnchorOptions:
    """Influence of touch on fingertips.

    Args:
        reach_s: time constant: a contact has the weight exp(-|Δt| / reach) at other times, so that
            the correction is smooth.
        half_force_n: force (times that weight) at which a fingertip is moved half of the distance.
        stay_m2_rad2: weight of the deviation from the retargeted angles.
    """

    reach_s: float = 0.3
    half_force_n: float = 0.1
    stay_m2_rad2: float = 1e-5

    def __post_init__(self) -> None:
        for name, value in vars(self).items():
            if not 0 < value < np.inf:
                raise InvalidInputError(f"touch anchor: got {name} {value}, expected > 0")


def anchored_joints(
    hand: RobotHand,
    joints_rad: np.ndarray,
    points: MatchedPoints,
    offset_m: np.ndarray,
    shares: np.ndarray,
    options: TouchAnchorOptions | None = None,
) -> Float64[np.ndarray, "time 20"]:
    """Joint angles, inside the limits, that move fingertips in contact to the human positions.

    Args:
        hand: robot hand.
        joints_rad: [T, 20], retargeted angles inside the limits.
        points: points of both hands at these angles (`matched_points`).
        offset_m: [T, 3], offset of the robot's wrist in the human wrist frame (`touch_offsets_m`).
        shares: [T, 5], share of the distance that each fingertip is moved (`touch_shares`).
        options: default: `TouchAnchorOptions()`.

    Raises:
        ShapeError: lengths that differ.
    """
    options = options or TouchAnchorOptions()
    joints = np.array(joints_rad, dtype=np.float64)
    shapes = (joints.shape, np.shape(offset_m), np.shape(shares))
    num = len(points.seen)
    if shapes != ((num, NUM_JOINTS), (num, 3), (num, NUM_FINGERS)):
        raise ShapeError(
            f"touch anchor: got joints, offsets, shares {shapes}, expected [{num}, {NUM_JOINTS}], "
            f"[{num}, 3], [{num}, {NUM_FINGERS}]"
        )
    share = np.where(points.seen[:, :NUM_FINGERS], shares, 0.0)
    rows = np.flatnonzero((share > _NO_SHARE).any(axis=1))
    if rows.size:
        way = (points.offset_m[:, :NUM_FINGERS] - offset_m[:, None])[rows]
        moving = share[rows] > _NO_SHARE
        way = np.where(moving[..., None], way * share[rows][..., None], 0.0)
        moved = _led(hand, joints[rows], way, options.stay_m2_rad2)
        keep = np.repeat(~moving, NUM_JOINTS // NUM_FINGERS, axis=1)
        joints[rows] = np.where(keep, joints[rows], moved)
    return joints


def touch_shares(
    pad_forces_n: np.ndarray, t_s: np.ndarray, options: TouchAnchorOptions | None = None
) -> Float64[np.ndarray, "time 5"]:
    """Share of the distance to the human position that each fingertip is moved.

    It is 0 without contact and near 1 with contact.

    Args:
        pad_forces_n: [T, 6], thumb … little fingertip and palm, 0 or more.
        t_s: [T] increasing times.
        options: default: `TouchAnchorOptions()`.

    Raises:
        ShapeError: lengths that differ.
        InvalidInputError: times that do not increase, or forces that are negative or not finite.
    """
    options = options or TouchAnchorOptions()
    forces, times = np.asarray(pad_forces_n, dtype=np.float64), np.asarray(t_s, dtype=np.float64)
    if forces.ndim != 2 or forces.shape != (len(times), NUM_FINGERS + 1):
        raise ShapeError(
            f"touch anchor: got forces {forces.shape} and times {times.shape}, expected [T, "
            f"{NUM_FINGERS + 1}] and [T]"
        )
    if not ((np.diff(times) > 0).all() and (forces >= 0).all() and np.isfinite(forces).all()):
        raise InvalidInputError(
            "touch anchor: expected increasing times and finite forces ≥ 0; sort and calibrate them"
        )
    near = forces[:, :NUM_FINGERS].copy()
    keep = np.exp(-np.diff(times) / options.reach_s)
    for index, factor in enumerate(keep, start=1):
        near[index] = np.maximum(near[index], factor * near[index - 1])
    for index in range(len(keep) - 1, -1, -1):
        near[index] = np.maximum(near[index], keep[index] * near[index + 1])
    return near / (near + options.half_force_n)


def fingertip_jacobians(
    hand: RobotHand, joints_rad: np.ndarray
) -> tuple[Float64[np.ndarray, "time 5 3"], Float64[np.ndarray, "time 5 3 4"]]:
    """Fingertips (m, wrist frame) and their Jacobians for the finger's joints (m/rad)."""
    frames, tips = hand.joint_frames(joints_rad), hand.fingertips_m(joints_rad)
    axes = np.array([[row.axis for row in finger.joints] for finger in hand.fingers])
    axes_wrist = (frames[..., :3, :3] @ axes[..., None])[..., 0]
    moves = np.cross(axes_wrist, tips[:, :, None] - frames[..., :3, 3])
    return tips, np.swapaxes(moves, -1, -2)


def _led(
    hand: RobotHand, joints_rad: np.ndarray, way_m: np.ndarray, stay: float
) -> Float64[np.ndarray, "time 20"]:
    """Gauss–Newton on |tip - goal|² + stay · |q - q0|² for each finger, cut at the limits."""
    first = joints_rad
    goal = hand.fingertips_m(first) + way_m
    joints = first
    for _ in range(_ITERATIONS):
        tips, jacobian = fingertip_jacobians(hand, joints)
        turned = np.swapaxes(jacobian, -1, -2)
        square = turned @ jacobian + stay * np.eye(4)
        pull = stay * (first - joints).reshape(-1, NUM_FINGERS, 4)
        wanted = (turned @ (goal - tips)[..., None])[..., 0] + pull
        step = np.linalg.solve(square, wanted[..., None])[..., 0]
        joints = np.clip(joints + step.reshape(-1, NUM_JOINTS), hand.lower_rad, hand.upper_rad)
    return joints
