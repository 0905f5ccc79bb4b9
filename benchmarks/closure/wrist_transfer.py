"""Placement of the robot's wrist such that its hand touches where the human's did.

A robot hand is larger than the human's and its knuckles lie elsewhere. With the human's wrist pose
copied, its fingertips and palm are centimetres beside those of the human, and so is its grasp.
What matters are the places that touch, so the robot's wrist is shifted, in the axes of the wrist,
until the points that touch lie where the human's were:

    T_world_robot = T_world_human @ T_human_robot,  T_human_robot = (identity rotation, offset)

The orientation stays the human's: `docs/twin_closure.md` measures what turning it as well does.
No task and no object is known here, only both hands and, if there is a glove, its touch.
"""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float64

from dextouch.errors import InvalidInputError, NonFiniteError, ShapeError
from dextouch.hands import CHAINS, NODE_INDEX, NUM_KEYPOINTS, WRIST
from dextouch.hands.robot_hand import RobotHand

_TIPS = [NODE_INDEX[chain, "tip"] for chain in CHAINS]
_PALM = [NODE_INDEX[WRIST, WRIST], *(NODE_INDEX[chain, "proximal"] for chain in CHAINS[1:])]
NUM_PADS = 6


@dataclass(frozen=True)
class MatchedPoints:
    """The places of thumb … little fingertip and palm of both hands, each in its own wrist.

    Attributes:
        human_m: of the person; zero where not seen.
        robot_m: of the robot at the retargeted joint angles.
        seen: whether the person's nodes of that place were tracked.
    """

    human_m: Float64[np.ndarray, "time 6 3"]
    robot_m: Float64[np.ndarray, "time 6 3"]
    seen: Bool[np.ndarray, "time 6"]

    @property
    def offset_m(self) -> Float64[np.ndarray, "time 6 3"]:
        """How far the robot's wrist must be shifted for each place to meet; zero where not seen."""
        return np.where(self.seen[..., None], self.human_m - self.robot_m, 0.0)


@dataclass(frozen=True)
class WristTransferOptions:
    """How touch decides about the offset.

    Args:
        reach_s: a touch counts exp(-|Δt| / reach) at other times: the approach is made with the
            offset of the grasp that follows.
        anchor_n_s: what the constant offset counts beside touch (force × time). Far from every
            touch, and without any, the constant offset is all there is.
    """

    reach_s: float = 0.3
    anchor_n_s: float = 0.005

    def __post_init__(self) -> None:
        for name, value in (("reach_s", self.reach_s), ("anchor_n_s", self.anchor_n_s)):
            if not 0 < value < np.inf:
                raise InvalidInputError(f"wrist transfer: got {name} {value}, expected > 0")


def matched_points(
    keypoints_m: np.ndarray, joints_rad: np.ndarray, hand: RobotHand
) -> MatchedPoints:
    """Fingertips and palm of a tracked hand and of the robot hand that follows it.

    The palm is halfway between the wrist and the middle of the four finger knuckles.

    Args:
        keypoints_m: [T, 25, 3], metres, wrist axes; NaN marks a missing node.
        joints_rad: [T, 20], what retargeting made of them.
        hand: the robot's, of the same side.

    Raises:
        ShapeError: other shapes.
        NonFiniteError: joint angles that are not finite.
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
    """Thumb … little fingertip and palm of the robot in its wrist, metres, for joints [T, 20]."""
    chains = hand.chain_points_m(joints_rad)
    return np.concatenate([chains[:, :, 3], _palm_m(np.zeros(3), chains[:, 1:, 0])], axis=1)


def _palm_m(wrist_m: np.ndarray, knuckles_m: np.ndarray) -> np.ndarray:
    return (0.5 * (wrist_m + knuckles_m.mean(axis=1)))[:, None]


def constant_offset_m(points: MatchedPoints) -> Float64[np.ndarray, "3"]:
    """The one offset that matches all places of all samples best (least squares: their mean).

    Raises:
        InvalidInputError: no place was ever seen.
    """
    if not points.seen.any():
        raise InvalidInputError(
            "wrist transfer: got no sample with a fingertip or the palm, expected at least one; "
            "the tracker lost the hand all the time"
        )
    return np.asarray(points.offset_m[points.seen].mean(axis=0))


def touch_offsets_m(
    points: MatchedPoints,
    pad_forces_n: np.ndarray,
    t_s: np.ndarray,
    options: WristTransferOptions | None = None,
) -> Float64[np.ndarray, "time 3"]:
    """An offset for every sample: that of the places which touch, weighted by force and nearness.

    offset(t) = (Σ k(t, s) F_i(s) dt offset_i(s) + A c) / (Σ k(t, s) F_i(s) dt + A), over samples s
    and places i, with k = exp(-|t - s| / reach), the constant offset c and its weight A. During a
    grasp it stands nearly still, so that nothing slips; it depends on the future, so it is for
    recordings.

    Args:
        points: of T samples.
        pad_forces_n: [T, 6] forces on thumb … little fingertip and palm, 0 or more
            (`dextouch.tactile.pad_forces_n`).
        t_s: [T] rising times, relative to any moment.
        options: None takes the defaults.

    Raises:
        ShapeError: shapes that do not fit.
        NonFiniteError: forces or times that are not finite.
        InvalidInputError: times that do not rise, or a negative force.
    """
    options = options or WristTransferOptions()
    forces, times = _checked(len(points.seen), pad_forces_n, t_s)
    # Each sample stands for the time around it, so that the rate of the samples does not matter.
    lasts_s = np.gradient(times) if len(times) > 1 else np.ones(1)
    weight = np.where(points.seen, forces, 0.0) * lasts_s[:, None]
    moments = np.concatenate(
        [(weight[..., None] * points.offset_m).sum(axis=1), weight.sum(axis=1, keepdims=True)], 1
    )
    pooled = _decaying_sums(moments, times, options.reach_s)
    anchor = options.anchor_n_s
    offset = pooled[:, :3] + anchor * constant_offset_m(points)
    return np.asarray(offset / (pooled[:, 3:] + anchor))


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
        raise NonFiniteError("wrist transfer: forces or times hold NaN or infinity; mask them")
    if (np.diff(times) <= 0).any() or (forces < 0).any():
        raise InvalidInputError(
            "wrist transfer: times must rise and forces be 0 or more; sort and calibrate them"
        )
    return forces, times


def _decaying_sums(
    values: Float64[np.ndarray, "time 4"], t_s: np.ndarray, reach_s: float
) -> Float64[np.ndarray, "time 4"]:
    """Σ_s exp(-|t - s| / reach) values(s) at every t, in time proportional to the samples."""
    keep = np.exp(-np.diff(t_s) / reach_s)
    before, after = values.copy(), values.copy()
    for index, factor in enumerate(keep, start=1):
        before[index] += factor * before[index - 1]
    for index in range(len(keep) - 1, -1, -1):
        after[index] += keep[index] * after[index + 1]
    return before + after - values


def shifted_wrist(
    Ts_world_human: np.ndarray, offset_m: np.ndarray
) -> Float64[np.ndarray, "time 4 4"]:
    """T_world_robot of every sample: the human's pose, shifted in the axes of the wrist.

    Args:
        Ts_world_human: [T, 4, 4].
        offset_m: [3] or [T, 3].

    Raises:
        ShapeError: other shapes.
    """
    Ts = np.array(Ts_world_human, dtype=np.float64)
    offsets = np.asarray(offset_m, dtype=np.float64)
    if Ts.shape[1:] != (4, 4) or offsets.shape not in {(3,), (len(Ts), 3)}:
        raise ShapeError(
            f"wrist transfer: got poses {Ts.shape} and offsets {offsets.shape}, expected "
            "[T, 4, 4] and [3] or [T, 3]"
        )
    shift_world = Ts[:, :3, :3] @ np.broadcast_to(offsets, (len(Ts), 3))[..., None]
    Ts[:, :3, 3] += shift_world[..., 0]
    return Ts
