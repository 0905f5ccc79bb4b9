"""Checks and comparisons of rigid transforms, such as those that a calibration holds."""

from collections.abc import Mapping
from typing import Final

import numpy as np
from jaxtyping import Float64

from dextouch.errors import InvalidInputError, NonFiniteError, ShapeError
from dextouch.geometry import invert
from dextouch.geometry.rotations import rotation_angle
from dextouch.schemas import Matrix

# How far R Rᵀ of a stored transform may be from the identity.
RIGID_TOLERANCE: Final = 1e-6


def rigid_transform(matrix: object, *, what: str) -> Float64[np.ndarray, "4 4"]:
    """Validate a matrix of a calibration as a rigid transform, float64 [4, 4].

    Args:
        matrix: 4 rows of 4 numbers.
        what: its name, for the message.

    Raises:
        ShapeError: not 4 by 4.
        NonFiniteError: NaN or infinity.
        InvalidInputError: its rotation is none, or mirrors, or the last row is not 0 0 0 1.
    """
    T = np.asarray(matrix, dtype=np.float64)
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


def calibrated_transform(
    calibration: Mapping[str, Matrix], name: str
) -> Float64[np.ndarray, "4 4"] | None:
    """A rigid transform of a recording's calibration; None if it has none of this name.

    Raises:
        ShapeError, NonFiniteError, InvalidInputError: it is no rigid transform.
    """
    if name not in calibration:
        return None
    return rigid_transform(calibration[name], what=f"calibration {name!r}")


def pose_difference(
    Ts_world_a: np.ndarray, Ts_world_b: np.ndarray
) -> tuple[Float64[np.ndarray, " n"], Float64[np.ndarray, " n"]]:
    """Distance (m) and angle (rad) between simultaneous poses."""
    Ts_world_a = np.asarray(Ts_world_a, dtype=np.float64)
    Ts_world_b = np.asarray(Ts_world_b, dtype=np.float64)
    distance = np.linalg.norm(Ts_world_a[:, :3, 3] - Ts_world_b[:, :3, 3], axis=-1)
    T_a_b = invert(Ts_world_a) @ Ts_world_b
    return np.asarray(distance), rotation_angle(T_a_b[:, :3, :3])
