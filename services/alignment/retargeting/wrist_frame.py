"""Wrist frame in a tracker's own axes, and conversion of a recording's keypoints to wrist axes.

Wrist, metacarpals and knuckles are laid over the mean hand's by a similarity transform (Umeyama
1991), one for the whole recording, so that it absorbs no motion of the fingers.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Final

import numpy as np
from jaxtyping import Bool, Float64

from dextouch.errors import InvalidInputError, NonFiniteError, ShapeError
from dextouch.geometry import apply, invert, rigid_error, transform
from dextouch.geometry.rotations import rotation_angle, vector_from_rotation
from dextouch.hands import FINGER_CHAINS, PALM_NODES, WRIST_NODE, chain_indices, mean_hand_m
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
