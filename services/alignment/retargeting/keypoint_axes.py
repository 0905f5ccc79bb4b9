"""Conversion of a recording's keypoints to wrist axes, as its calibration says.

To be called once for each hand of a recording, before retargeting. Keypoints in other axes are
never turned by guess: only a calibration rotates them, and the result is checked.
"""

from collections.abc import Mapping
from typing import Final

import numpy as np
from jaxtyping import Float64

from dextouch.errors import InvalidInputError, NonFiniteError, ShapeError
from dextouch.geometry import apply, invert
from dextouch.geometry.rotations import rotation_angle, vector_from_rotation
from dextouch.schemas import Matrix, matrix_rows
from dextouch.tactile.layout import Side
from services.alignment.retargeting.hand_checks import seen_nodes
from services.alignment.retargeting.wrist_frame import WristFrame, wrist_frame

# What people's palms differ from the mean one's, and what a grip adds, stays below this.
MAX_OFF_RAD: Final = float(np.deg2rad(20.0))
# How far R Rᵀ of a stored transform may be from the identity.
RIGID_TOLERANCE: Final = 1e-6


def calibrated_transform(
    calibration: Mapping[str, Matrix], name: str
) -> Float64[np.ndarray, "4 4"] | None:
    """A rigid transform of a recording's calibration; None if it has none of this name.

    Raises:
        ShapeError: not 4 by 4.
        NonFiniteError: NaN or infinity.
        InvalidInputError: its rotation is none, or mirrors, or the last row is not 0 0 0 1.
    """
    if name not in calibration:
        return None
    what, T = f"calibration {name!r}", np.asarray(calibration[name], dtype=np.float64)
    if T.shape != (4, 4):
        raise ShapeError(f"{what}: got shape {T.shape}, expected (4, 4)")
    if not np.isfinite(T).all():
        raise NonFiniteError(f"{what}: holds NaN or infinity; calibrate again")
    R = T[:3, :3]
    off, determinant = np.abs(R @ R.T - np.eye(3)).max(), np.linalg.det(R)
    if off > RIGID_TOLERANCE or determinant < 0 or T[3].tolist() != [0, 0, 0, 1]:
        raise InvalidInputError(
            f"{what}: no rigid transform (R Rᵀ is off by {off:.1e}, expected at most "
            f"{RIGID_TOLERANCE:.0e}; det {determinant:+.2f}; last row {T[3].tolist()}); calibrate "
            "again"
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

    Args:
        keypoints_m: [T ≥ 1, 25, 3], metres, order of `dextouch.hands.NODES`, in wrist axes or,
            where the calibration says how they are turned, in others that are fixed to the wrist;
            NaN where a node is not seen.
        side: which hand.
        calibration: the recording's; `T_keypoints_SIDE_wrist_SIDE` is read.

    Raises:
        InvalidInputError: what `wrist_frame` refuses (unit, order of nodes, the other hand, too
            little seen, moving axes); keypoints in other axes than the wrist's, with or without
            calibration (`details` holds `fault`); a calibration that is no rigid transform.
        ShapeError: not [T ≥ 1, 25, 3], or a calibration that is not 4 by 4.
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
        _refuse_axes(R_wrist_palm, off_rad, side, is_calibrated=T_keypoints_wrist is not None)
    return keypoints


def _refuse_axes(R: np.ndarray, off_rad: float, side: Side, *, is_calibrated: bool) -> None:
    axis = np.round(vector_from_rotation(R) / off_rad, 2).tolist()
    fingers = np.round(-R[:, 2], 2).tolist()
    told = (
        f"the calibration {calibration_name(side)!r} does not fit this recording: lay the hand "
        "flat and calibrate again, the glove may have slipped"
        if is_calibrated
        else f"record the flat hand and run dextouch station calibrate wrist --side {side}, which "
        f"makes the calibration {calibration_name(side)!r}"
    )
    raise InvalidInputError(
        f"keypoints_{side}: got keypoints that are turned by {np.rad2deg(off_rad):.0f} degrees "
        f"about {axis} from the wrist's axes (the palm points along {fingers}, expected "
        f"[0, 0, -1] within {np.rad2deg(MAX_OFF_RAD):.0f} degrees); {told}",
        fault="axes",
        off_deg=float(np.rad2deg(off_rad)),
    )
