"""Wrists: their frames in a tracker's axes, keypoints in wrist axes, and transfer to the robot.

Wrist, metacarpals and knuckles are laid over the mean hand's by a similarity transform (Umeyama
1991), one for the whole recording, so that it absorbs no motion of the fingers.

With a copied wrist pose the larger robot hand would touch centimetres away. Its wrist is therefore
shifted, in wrist axes, until the points in contact match; then each finger in contact is moved to
the human position by its own joints. Without touch only a constant shift remains.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Final

import numpy as np
from jaxtyping import Bool, Float64

from dextouch.errors import InvalidInputError, NonFiniteError, ShapeError
from dextouch.geometry import apply, invert, rigid_error, transform
from dextouch.geometry.rotations import rotation_angle, vector_from_rotation
from dextouch.hands import (
    CHAINS,
    FINGER_CHAINS,
    NODE_INDEX,
    NUM_KEYPOINTS,
    PALM_NODES,
    WRIST,
    WRIST_NODE,
    chain_indices,
    mean_hand_m,
)
from dextouch.hands.robot_hand import NUM_FINGERS, NUM_JOINTS, RobotHand
from dextouch.schemas import Matrix, matrix_rows
from dextouch.tactile.layout import Side
from services.alignment.retargeting.hand_checks import (
    MIN_PALM_NODES,
    check_hand_shape,
    check_handedness,
    seen_nodes,
    seen_samples,
)

# Part of the samples in which a node must be seen to count.
MIN_SEEN_PART: Final = 0.1
# Samples of a node that lie so many times farther off than the middle one do not count.
FAR_OFF: Final = 5.0
# Second spread of the nodes in parts of the first: less is a line (whole palms have 0.5).
MIN_SECOND_SPREAD: Final = 0.05
# What noise and the palm's give may turn single samples away from the common frame, RMS.
MAX_TURN_RAD: Final = float(np.deg2rad(12.0))
# A hand is flat while no finger bends by more than this, noise included.
MAX_FLAT_BEND_RAD: Final = float(np.deg2rad(30.0))
# Of four; trackers lose nodes.
MIN_KNOWN_FINGERS: Final = 2
MIN_FLAT_SAMPLES: Final = 30
MAX_SIGMA_RAD: Final = float(np.deg2rad(12.0))
# What people's palms differ from the mean one's, and what a grip adds, stays below this.
MAX_OFF_RAD: Final = float(np.deg2rad(20.0))
# How far R Rᵀ of a stored transform may be from the identity.
RIGID_TOLERANCE: Final = 1e-6
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
class WristFrame:
    """Pose of the wrist frame in the axes of keypoints, with its covariance.

    Attributes:
        T_tracker_wrist: its origin is the wrist node (or where the palm says it is), its axes ours.
        covariance: [3, 3] of the rotation (rad²) about the wrist's own axes, by noise and shape.
        size: of the hand, 1 is the mean adult's.
        misfit_m: RMS distance of the palm's nodes from the mean hand's of that size.
        turn_rad: how far single samples turn from this frame, RMS.
        num_samples: that it was found from.
    """

    T_tracker_wrist: Float64[np.ndarray, "4 4"]
    covariance: Float64[np.ndarray, "3 3"]
    size: float
    misfit_m: float
    turn_rad: float
    num_samples: int

    @property
    def sigma_rad(self) -> float:
        """One sigma of the rotation, length of the three axes' sigmas."""
        return float(np.sqrt(np.trace(self.covariance)))


def wrist_frame(keypoints_m: np.ndarray, side: Side, *, where: str = "keypoints") -> WristFrame:
    """Estimate the wrist frame from the palm, in any posture of the fingers.

    Keypoints are [T ≥ 1, 25, 3] in axes that are fixed to the wrist, metres, order of
    `dextouch.hands.NODES`, NaN where not seen; `where` is for the message. Raises ShapeError: other
    shapes; InvalidInputError: wrong unit, order of nodes or hand, too few nodes of the palm or
    nodes along a line, or axes that are not fixed to the wrist (`details` holds `fault`).
    """
    samples = seen_samples(keypoints_m, where=where)
    # Nodes along a line have no handedness; that is said before anything that follows from it.
    palm, is_used = _palm(samples, where)
    check_hand_shape(samples, where=where)
    check_handedness(samples, side, where=where)
    mean = mean_hand_m(side)[list(PALM_NODES)]
    R, sizes, offsets = _laid_over(mean, palm[None], is_used[None])
    R_tracker_wrist, size = R[0], float(sizes[0])
    left_over = palm[is_used] - (size * mean[is_used] @ R_tracker_wrist.T + offsets[0])
    misfit_m = float(np.sqrt(np.square(left_over).sum(axis=1).mean()))
    turn_rad = _turn_of_samples(samples, mean, is_used, R_tracker_wrist)
    if turn_rad > MAX_TURN_RAD:
        raise InvalidInputError(
            f"{where}: the palm turns by {np.rad2deg(turn_rad):.0f} degrees RMS during "
            f"{len(samples)} samples, expected at most {np.rad2deg(MAX_TURN_RAD):.0f}: these axes "
            "are not fixed to the wrist; send keypoints relative to the wrist, the wrist's own "
            "pose as the stream wrist_left or wrist_right",
            fault="moving_axes",
        )
    # Residuals are all that rotation, offset and size, seven numbers, leave.
    variance = np.square(left_over).sum() / (left_over.size - 7)
    centred = size * mean[is_used]
    centred = centred - centred.mean(axis=0)
    inertia = np.square(centred).sum() * np.eye(3) - centred.T @ centred
    covariance = np.asarray(variance * np.linalg.inv(inertia))
    has_wrist = is_used[PALM_NODES.index(WRIST_NODE)]
    origin = palm[PALM_NODES.index(WRIST_NODE)] if has_wrist else offsets[0]
    frame = WristFrame(
        T_tracker_wrist=transform(R_tracker_wrist, origin),
        covariance=covariance,
        size=size,
        misfit_m=misfit_m,
        turn_rad=turn_rad,
        num_samples=len(samples),
    )
    if frame.sigma_rad > MAX_SIGMA_RAD:
        raise InvalidInputError(
            f"{where}: the uncertainty of the wrist's axes is {np.rad2deg(frame.sigma_rad):.1f} "
            f"degrees (one sigma), expected at most {np.rad2deg(MAX_SIGMA_RAD):.0f}; the palm's "
            f"nodes deviate by {misfit_m * 1e3:.1f} mm RMS",
            fault="uncertain",
        )
    return frame


def calibrate_wrist(
    keypoints_m: np.ndarray, side: Side, *, where: str = "flat-hand take"
) -> WristFrame:
    """Estimate the wrist frame from a take of the flat hand; one second is enough.

    In a grip, ring and little metacarpals give way. Raises InvalidInputError: as `wrist_frame`, or
    fewer than 30 samples with straight fingers; ShapeError: not [T ≥ 1, 25, 3].
    """
    # Asked for its refusals only.
    seen_samples(keypoints_m, where=where)
    samples = seen_nodes(keypoints_m)
    bends_rad = _bends_rad(samples)
    is_known = np.isfinite(bends_rad)
    is_straight = (bends_rad <= MAX_FLAT_BEND_RAD) | ~is_known
    is_flat = is_straight.all(axis=1) & (is_known.sum(axis=1) >= MIN_KNOWN_FINGERS)
    num_flat = int(np.count_nonzero(is_flat))
    if num_flat < MIN_FLAT_SAMPLES:
        bent = np.median(np.where(is_known, bends_rad, np.pi), axis=0)
        worst = FINGER_CHAINS[int(np.argmax(bent))]
        raise InvalidInputError(
            f"{where}: got {num_flat} samples with straight fingers, expected at least "
            f"{MIN_FLAT_SAMPLES}; the {worst} finger is bent most, or not seen: lay the hand flat "
            "for a second, fingers straight",
            fault="not_flat",
            found=worst,
        )
    return wrist_frame(samples[is_flat], side, where=where)


def calibrated_transform(
    calibration: Mapping[str, Matrix], name: str
) -> Float64[np.ndarray, "4 4"] | None:
    """A rigid transform of a recording's calibration; None if it has none of this name.

    Raises ShapeError: not 4 by 4; NonFiniteError: NaN or infinity; InvalidInputError: not rigid.
    """
    if name not in calibration:
        return None
    what, T = f"calibration {name!r}", np.asarray(calibration[name], dtype=np.float64)
    if T.shape != (4, 4):
        raise ShapeError(f"{what}: got shape {T.shape}, expected (4, 4)")
    if not np.isfinite(T).all():
        raise NonFiniteError(f"{what}: holds NaN or infinity; calibrate again")
    off = rigid_error(T)
    if off > RIGID_TOLERANCE:
        raise InvalidInputError(
            f"{what}: no rigid transform (RᵀR or the last row is off by {off:.1e}, expected at "
            f"most {RIGID_TOLERANCE:.0e}; det {np.linalg.det(T[:3, :3]):+.2f}); calibrate again"
        )
    return T


def calibration_name(side: Side) -> str:
    """Name of the matrix: the wrist frame in the axes of the stream `keypoints_SIDE`."""
    return f"T_keypoints_{side}_wrist_{side}"


def calibration_record(frame: WristFrame, side: Side) -> dict[str, Matrix]:
    """Matrices of a calibrated wrist frame in recordings: 4 × 4, and sigma in rad."""
    name = calibration_name(side)
    return {
        name: matrix_rows(frame.T_tracker_wrist),
        f"{name}_sigma_rad": matrix_rows(np.array([[frame.sigma_rad]])),
    }


def to_wrist_axes(
    keypoints_m: np.ndarray, T_keypoints_wrist: np.ndarray
) -> Float64[np.ndarray, "time 25 3"]:
    """Convert keypoints [T, 25, 3] from a tracker's axes to wrist axes; NaN if not seen."""
    return apply(invert(T_keypoints_wrist), seen_nodes(keypoints_m))


def hand_axes_check(
    keypoints_m: np.ndarray, side: Side, calibration: Mapping[str, Matrix]
) -> Float64[np.ndarray, "time 25 3"]:
    """Keypoints of one hand of a recording in wrist axes, checked; not finite where not seen.

    They are as of `wrist_frame`, or turned as `T_keypoints_SIDE_wrist_SIDE` of the calibration
    says. Raises InvalidInputError: as `wrist_frame`, keypoints in other axes (`details` holds
    `fault`), or a calibration that is no rigid transform; ShapeError: not [T ≥ 1, 25, 3], or not 4
    by 4.
    """
    where = f"keypoints_{side}"
    T_keypoints_wrist = calibrated_transform(calibration, calibration_name(side))
    keypoints = np.asarray(keypoints_m, dtype=np.float64)
    frame = wrist_frame(keypoints, side, where=where)
    if T_keypoints_wrist is not None:
        keypoints = to_wrist_axes(keypoints, T_keypoints_wrist)
        frame = wrist_frame(keypoints, side, where=where)
    R_wrist_palm = frame.T_tracker_wrist[:3, :3]
    off_rad = float(rotation_angle(R_wrist_palm))
    if off_rad > MAX_OFF_RAD:
        axis = np.round(vector_from_rotation(R_wrist_palm) / off_rad, 2).tolist()
        fingers = np.round(-R_wrist_palm[:, 2], 2).tolist()
        advice = (
            f"record the flat hand and run dextouch station calibrate wrist --side {side}, which "
            f"makes the calibration {calibration_name(side)!r}"
            if T_keypoints_wrist is None
            else f"the calibration {calibration_name(side)!r} does not fit this recording: lay the "
            "hand flat and calibrate again, the glove may have slipped"
        )
        raise InvalidInputError(
            f"{where}: got keypoints that are turned by {np.rad2deg(off_rad):.0f} degrees about "
            f"{axis} from the wrist's axes (the palm points along {fingers}, expected [0, 0, -1] "
            f"within {np.rad2deg(MAX_OFF_RAD):.0f} degrees); {advice}",
            fault="axes",
            off_deg=float(np.rad2deg(off_rad)),
        )
    return keypoints


def _palm(
    samples: np.ndarray, where: str
) -> tuple[Float64[np.ndarray, "9 3"], Bool[np.ndarray, " 9"]]:
    """Mean positions of the palm's nodes without outliers, and which nodes are used."""
    seen = samples[:, list(PALM_NODES)]
    num_seen = np.isfinite(seen[..., 0]).sum(axis=0)
    is_used = num_seen >= max(1.0, MIN_SEEN_PART * len(samples))
    if np.count_nonzero(is_used) < MIN_PALM_NODES:
        raise InvalidInputError(
            f"{where}: got {np.count_nonzero(is_used)} of the {len(PALM_NODES)} nodes of wrist, "
            f"metacarpals and knuckles, expected at least {MIN_PALM_NODES}",
            fault="unseen",
        )
    palm = np.full((len(PALM_NODES), 3), np.nan)
    middle = np.nanmedian(seen[:, is_used], axis=0)
    distances = np.linalg.norm(seen[:, is_used] - middle, axis=-1)
    # A mean turns with the axes, and medians of coordinates do not.
    is_near = distances <= FAR_OFF * np.nanmedian(distances, axis=0)
    near = np.where(is_near[..., None], seen[:, is_used], 0.0)
    palm[is_used] = near.sum(axis=0) / is_near.sum(axis=0)[:, None]
    centred = palm[is_used] - palm[is_used].mean(axis=0)
    spread = np.linalg.svd(centred, compute_uv=False)
    if spread[1] <= MIN_SECOND_SPREAD * spread[0]:
        raise InvalidInputError(
            f"{where}: the {np.count_nonzero(is_used)} nodes of the palm that are seen lie along a "
            "line, which shows no turn about it; wrist and knuckles of several fingers are needed",
            fault="collinear",
        )
    return palm, is_used


def _laid_over(
    mean: np.ndarray, palms: np.ndarray, is_used: np.ndarray
) -> tuple[Float64[np.ndarray, "n 3 3"], Float64[np.ndarray, " n"], Float64[np.ndarray, "n 3"]]:
    """Rotations, sizes and offsets with palm ≈ size · R · mean + offset (Umeyama 1991)."""
    weights = is_used / is_used.sum(axis=1, keepdims=True)
    places = np.where(is_used[..., None], palms, 0.0)
    middle_mean, middle = weights @ mean, np.einsum("nk,nkx->nx", weights, places)
    centred_mean = mean - middle_mean[:, None]
    centred = np.where(is_used[..., None], places - middle[:, None], 0.0)
    H = np.einsum("nk,nkx,nky->nxy", weights, centred, centred_mean)
    U, stretch, Vt = np.linalg.svd(H)
    signs = np.ones((len(palms), 3))
    signs[:, 2] = np.sign(np.linalg.det(U @ Vt))
    R = (U * signs[:, None]) @ Vt
    size = (stretch * signs).sum(axis=1) / np.einsum(
        "nk,nkx,nkx->n", weights, centred_mean, centred_mean
    )
    return R, size, middle - size[:, None] * np.einsum("nxy,ny->nx", R, middle_mean)


def _turn_of_samples(
    samples: np.ndarray, mean: np.ndarray, is_used: np.ndarray, R: np.ndarray
) -> float:
    """RMS angle between single samples' frames and the common one; 0 where none shows its own."""
    palms = samples[:, list(PALM_NODES)]
    seen = np.isfinite(palms[..., 0]) & is_used
    # A sample with fewer nodes than the common frame says more of what is missing than of turns.
    whole = seen.sum(axis=1) == np.count_nonzero(is_used)
    if not whole.any():
        whole = seen.sum(axis=1) == seen.sum(axis=1).max()
    Rs, _, _ = _laid_over(mean, palms[whole], seen[whole])
    return float(np.sqrt(np.square(rotation_angle(R.T @ Rs)).mean()))


def _bends_rad(samples: np.ndarray) -> Float64[np.ndarray, "time 4"]:
    """Angle of each finger between its first bone and the rest of it; NaN where not seen."""
    fingers = samples[:, [chain_indices(chain) for chain in FINGER_CHAINS]]
    first = fingers[:, :, 2] - fingers[:, :, 1]
    # As far as the tip, since noise turns short bones far.
    rest = fingers[:, :, 4] - fingers[:, :, 2]
    sine = np.linalg.norm(np.cross(first, rest), axis=-1)
    return np.asarray(np.arctan2(sine, (first * rest).sum(axis=-1)))


@dataclass(frozen=True)
class MatchedPoints:
    """Fingertips and palm of both hands in their wrist frames; a person's not `seen` are zero."""

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
    """Constant offset that matches all points best; raises InvalidInputError for none."""
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
    """Joint angles [T, 20], inside the limits, that move fingertips in contact to the person's.

    They are moved by `shares` [T, 5] of the distance; the robot's wrist by `offset_m` [T, 3].
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
    """Share of the distance that each tip is moved; arguments as `touch_offsets_m`."""
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
