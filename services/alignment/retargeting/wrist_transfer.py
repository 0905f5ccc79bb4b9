"""Transfer of a tracked hand to the robot so that it touches where the person did.

With a copied wrist pose the larger robot hand would touch centimetres away. The wrist is therefore
shifted, in wrist axes, until the points in contact match; then each finger in contact is moved to
the human position by its own joints. Without touch only a constant shift remains.
"""

from dataclasses import dataclass
from typing import Final

import numpy as np
from jaxtyping import Bool, Float64

from dextouch.errors import InvalidInputError, NonFiniteError, ShapeError
from dextouch.hands import CHAINS, NODE_INDEX, NUM_KEYPOINTS, WRIST
from dextouch.hands.robot_hand import NUM_FINGERS, NUM_JOINTS, RobotHand

_TIPS = [NODE_INDEX[chain, "tip"] for chain in CHAINS]
_PALM = [NODE_INDEX[WRIST, WRIST], *(NODE_INDEX[chain, "proximal"] for chain in CHAINS[1:])]
NUM_PADS = 6
# Time constant: a contact has the weight exp(-|Δt| / reach) at other times, so that an approach has
# the offset of the grasp that follows, and fingertips move smoothly.
REACH_S: Final = 0.3
# Weight of the constant offset relative to touch (force × time). Far from any contact, and without
# contact, only the constant offset counts.
ANCHOR_N_S: Final = 0.005
# Force (times its weight) at which a fingertip is moved half of the distance.
HALF_FORCE_N: Final = 0.1
# Weight of the deviation from the retargeted angles.
STAY_M2_RAD2: Final = 1e-5
# A few steps converge to micrometres; unreachable positions take more.
_ITERATIONS: Final = 15
# Smaller shares would move a fingertip by micrometres only: these fingers are unchanged.
_NO_SHARE: Final = 1e-3


@dataclass(frozen=True)
class MatchedPoints:
    """Positions of thumb … little fingertip and palm of both hands, each in its own wrist frame.

    The robot's are at the retargeted joint angles; a person's that is not `seen` is zero.
    """

    human_m: Float64[np.ndarray, "time 6 3"]
    robot_m: Float64[np.ndarray, "time 6 3"]
    seen: Bool[np.ndarray, "time 6"]

    @property
    def offset_m(self) -> Float64[np.ndarray, "time 6 3"]:
        """Wrist offset that makes each point match; zero where not tracked."""
        return np.where(self.seen[..., None], self.human_m - self.robot_m, 0.0)


def matched_points(
    keypoints_m: np.ndarray, joints_rad: np.ndarray, hand: RobotHand
) -> MatchedPoints:
    """Fingertips and palm of a tracked hand and of the robot hand that follows it.

    Keypoints are [T, 25, 3] in wrist axes (m; NaN where missing), joints [T, 20]; the palm is
    halfway from the wrist to the middle of the finger knuckles. Raises ShapeError, NonFiniteError.
    """
    keypoints = np.asarray(keypoints_m, dtype=np.float64)
    if keypoints.shape != (len(joints_rad), NUM_KEYPOINTS, 3):
        raise ShapeError(
            f"wrist transfer: got keypoints {keypoints.shape} and joints {np.shape(joints_rad)}, "
            "expected [T, 25, 3] and [T, 20]"
        )
    known = np.asarray(np.isfinite(keypoints).all(axis=-1))
    seen = np.concatenate([known[:, _TIPS], known[:, _PALM].all(axis=1, keepdims=True)], axis=1)
    human = np.concatenate(
        [keypoints[:, _TIPS], _palm_m(keypoints[:, _PALM[0]], keypoints[:, _PALM[1:]])], axis=1
    )
    return MatchedPoints(
        np.where(seen[..., None], human, 0.0), robot_places_m(joints_rad, hand), seen
    )


def robot_places_m(joints_rad: np.ndarray, hand: RobotHand) -> Float64[np.ndarray, "time 6 3"]:
    """Thumb … little fingertip and palm (m) of the robot in its wrist frame, for joints [T, 20]."""
    chains = hand.chain_points_m(joints_rad)
    return np.concatenate([chains[:, :, 3], _palm_m(np.zeros(3), chains[:, 1:, 0])], axis=1)


def _palm_m(wrist_m: np.ndarray, knuckles_m: np.ndarray) -> np.ndarray:
    return (0.5 * (wrist_m + knuckles_m.mean(axis=1)))[:, None]


def constant_offset_m(points: MatchedPoints) -> Float64[np.ndarray, "3"]:
    """Constant offset that matches all points best, their mean; refuses none."""
    if not points.seen.any():
        raise InvalidInputError(
            "wrist transfer: got no sample with a tracked fingertip or palm, expected at least one"
        )
    return np.asarray(points.offset_m[points.seen].mean(axis=0))


def touch_offsets_m(
    points: MatchedPoints, pad_forces_n: np.ndarray, t_s: np.ndarray
) -> Float64[np.ndarray, "time 3"]:
    """Offset for every sample: mean over points in contact, weighted by force and time difference.

    offset(t) = (Σ k(t, s) F_i(s) dt offset_i(s) + A c) / (Σ k(t, s) F_i(s) dt + A), over samples s
    and points i, with k = exp(-|t - s| / reach), the constant offset c and its weight A: nearly
    constant during a grasp, so that nothing slips. Forces [T, 6] are on thumb … little fingertip
    and palm, 0 or more; times [T] increase. Raises ShapeError: shapes that do not fit;
    NonFiniteError; InvalidInputError: times that do not increase, or a negative force.
    """
    forces, times = _checked(len(points.seen), pad_forces_n, t_s)
    # Samples are weighted by their duration, so that the result does not depend on the rate.
    lasts_s = np.gradient(times) if len(times) > 1 else np.ones(1)
    weight = np.where(points.seen, forces, 0.0) * lasts_s[:, None]
    moments = np.concatenate(
        [(weight[..., None] * points.offset_m).sum(axis=1), weight.sum(axis=1, keepdims=True)], 1
    )
    before, after = _decaying(moments, times, np.add)
    pooled = before + after - moments
    offset = pooled[:, :3] + ANCHOR_N_S * constant_offset_m(points)
    return np.asarray(offset / (pooled[:, 3:] + ANCHOR_N_S))


def _checked(
    num_samples: int, pad_forces_n: np.ndarray, t_s: np.ndarray
) -> tuple[Float64[np.ndarray, "time 6"], Float64[np.ndarray, " time"]]:
    forces, times = np.asarray(pad_forces_n, dtype=np.float64), np.asarray(t_s, dtype=np.float64)
    if forces.shape != (num_samples, NUM_PADS) or times.shape != (num_samples,):
        raise ShapeError(
            f"wrist transfer: got forces {forces.shape} and times {times.shape}, expected "
            f"[{num_samples}, {NUM_PADS}] and [{num_samples}]"
        )
    if not (np.isfinite(forces).all() and np.isfinite(times).all()):
        raise NonFiniteError("wrist transfer: forces or times contain NaN or infinity; mask them")
    if (np.diff(times) <= 0).any() or (forces < 0).any():
        raise InvalidInputError(
            "wrist transfer: expected increasing times and forces ≥ 0; sort and calibrate them"
        )
    return forces, times


def _decaying(
    values: Float64[np.ndarray, "time n"], t_s: np.ndarray, combine: np.ufunc
) -> tuple[Float64[np.ndarray, "time n"], Float64[np.ndarray, "time n"]]:
    """Values combined with exp(-|t - s| / reach) of those before, and of those after; O(n)."""
    keep = np.exp(-np.diff(t_s) / REACH_S)
    before, after = values.copy(), values.copy()
    for index, factor in enumerate(keep, start=1):
        before[index] = combine(before[index], factor * before[index - 1])
    for index in range(len(keep) - 1, -1, -1):
        after[index] = combine(after[index], keep[index] * after[index + 1])
    return before, after


def shifted_wrist(
    Ts_world_human: np.ndarray, offset_m: np.ndarray
) -> Float64[np.ndarray, "time 4 4"]:
    """Poses [T, 4, 4] of the human wrist, shifted by offsets [3] or [T, 3] in its own axes."""
    Ts = np.array(Ts_world_human, dtype=np.float64)
    shift_world = Ts[:, :3, :3] @ np.broadcast_to(offset_m, (len(Ts), 3))[..., None]
    Ts[:, :3, 3] += shift_world[..., 0]
    return Ts


def anchored_joints(
    hand: RobotHand,
    joints_rad: np.ndarray,
    points: MatchedPoints,
    offset_m: np.ndarray,
    shares: np.ndarray,
) -> Float64[np.ndarray, "time 20"]:
    """Joint angles, inside the limits, that move fingertips in contact to the human positions.

    Retargeted angles are [T, 20], `offset_m` [T, 3] that of the robot's wrist (`touch_offsets_m`),
    `shares` [T, 5] of the distance that each tip is moved.
    """
    joints = np.array(joints_rad, dtype=np.float64)
    share = np.where(points.seen[:, :NUM_FINGERS], shares, 0.0)
    rows = np.flatnonzero((share > _NO_SHARE).any(axis=1))
    if rows.size:
        way = (points.offset_m[:, :NUM_FINGERS] - offset_m[:, None])[rows]
        moving = share[rows] > _NO_SHARE
        way = np.where(moving[..., None], way * share[rows][..., None], 0.0)
        moved = _led(hand, joints[rows], way)
        keep = np.repeat(~moving, NUM_JOINTS // NUM_FINGERS, axis=1)
        joints[rows] = np.where(keep, joints[rows], moved)
    return joints


def touch_shares(pad_forces_n: np.ndarray, t_s: np.ndarray) -> Float64[np.ndarray, "time 5"]:
    """Share of the distance that each fingertip is moved: 0 without contact, near 1 with it.

    Arguments and errors as `touch_offsets_m`.
    """
    forces, times = _checked(len(t_s), pad_forces_n, t_s)
    near = np.maximum(*_decaying(forces[:, :NUM_FINGERS], times, np.maximum))
    return near / (near + HALF_FORCE_N)


def fingertip_jacobians(
    hand: RobotHand, joints_rad: np.ndarray
) -> tuple[Float64[np.ndarray, "time 5 3"], Float64[np.ndarray, "time 5 3 4"]]:
    """Fingertips (m, wrist frame) and their Jacobians for the finger's joints (m/rad)."""
    frames, tips = hand.joint_frames(joints_rad), hand.fingertips_m(joints_rad)
    axes = np.array([[row.axis for row in finger.joints] for finger in hand.fingers])
    axes_wrist = (frames[..., :3, :3] @ axes[..., None])[..., 0]
    moves = np.cross(axes_wrist, tips[:, :, None] - frames[..., :3, 3])
    return tips, np.swapaxes(moves, -1, -2)


def _led(hand: RobotHand, first: np.ndarray, way_m: np.ndarray) -> Float64[np.ndarray, "time 20"]:
    """Gauss–Newton on |tip - goal|² + stay · |q - q0|² for each finger, cut at the limits."""
    goal, stay = hand.fingertips_m(first) + way_m, STAY_M2_RAD2
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


def transfer_by_touch(
    hand: RobotHand,
    Ts_world_human: Float64[np.ndarray, "time 4 4"],
    joints_rad: Float64[np.ndarray, "time 20"],
    *,
    keypoints_m: Float64[np.ndarray, "time 25 3"],
    pad_forces_n: Float64[np.ndarray, "time 6"],
    t_s: Float64[np.ndarray, " time"],
) -> tuple[
    Float64[np.ndarray, "time 4 4"], Float64[np.ndarray, "time 20"], Float64[np.ndarray, "time 3"]
]:
    """Shift the wrist and move touching fingertips to the person's positions.

    Keypoints are in wrist axes (NaN where missing), forces on thumb … little fingertip and palm
    (zeros without a glove), times increase. Returns T_world_robot of the wrist, joint angles of the
    robot, and the shift (m) in wrist axes. Raises ShapeError: lengths that differ;
    InvalidInputError: no fingertip and no palm was ever tracked.
    """
    points = matched_points(keypoints_m, joints_rad, hand)
    offset_m = touch_offsets_m(points, pad_forces_n, t_s)
    shares = touch_shares(pad_forces_n, t_s)
    joints = anchored_joints(hand, joints_rad, points, offset_m, shares)
    return shifted_wrist(Ts_world_human, offset_m), joints, offset_m
