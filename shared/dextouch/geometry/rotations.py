"""Conversions between rotation matrices, 6-D vectors, quaternions and rotation vectors."""

from collections.abc import Sequence

import numpy as np
import numpy.typing as npt
from jaxtyping import Float64

from dextouch.errors import DegenerateRotationError, NonFiniteError, ShapeError

# Below this sine of the angle between the two 6-D columns, Gram-Schmidt loses half of float64.
MIN_COLUMN_SINE = 1e-6
# Below this angle sin(x)/x and (1-cos(x))/x² are taken from their series (error < 1e-16).
SERIES_ANGLE_RAD = 1e-3


def _checked(values: np.ndarray, tail: tuple[int, ...], what: str) -> Float64[np.ndarray, "..."]:
    array = np.asarray(values, dtype=np.float64)
    if array.shape[-len(tail) :] != tail:
        raise ShapeError(
            f"{what}: got shape {array.shape}, expected [..., {', '.join(map(str, tail))}]"
        )
    if not np.isfinite(array).all():
        raise NonFiniteError(f"{what}: holds NaN or infinity; drop or mask those samples first")
    return array


def _matrices(rows: Sequence[Sequence[npt.ArrayLike]]) -> Float64[np.ndarray, "*batch m n"]:
    return np.stack([np.stack(row, axis=-1) for row in rows], axis=-2)


def rotation_to_6d(R: np.ndarray) -> Float64[np.ndarray, "*batch 6"]:
    """First two columns of rotation matrices [..., 3, 3] (Zhou et al. 2019, CVPR), as [..., 6].

    The identity gives (1, 0, 0, 0, 1, 0).

    Raises:
        ShapeError: the last two axes are not 3×3.
        NonFiniteError: NaN or infinity.
    """
    checked = _checked(R, (3, 3), "rotation matrix")
    return np.concatenate([checked[..., :, 0], checked[..., :, 1]], axis=-1)


def rotation_from_6d(columns: np.ndarray) -> Float64[np.ndarray, "*batch 3 3"]:
    """Rotation matrices [..., 3, 3] from two columns by Gram-Schmidt (Zhou et al. 2019, eq. 15).

    The columns [..., 6] are linearly independent, of any positive length.

    Raises:
        DegenerateRotationError: a column is zero or both are parallel.
        ShapeError: the last axis is not 6.
        NonFiniteError: NaN or infinity.
    """
    checked = _checked(columns, (6,), "6-D rotation")
    first, second = checked[..., :3], checked[..., 3:]
    # Scaling by the largest entry first keeps squares of tiny or huge numbers inside float64.
    scale_a = np.abs(first).max(axis=-1, keepdims=True)
    scale_b = np.abs(second).max(axis=-1, keepdims=True)
    if (scale_a == 0).any() or (scale_b == 0).any():
        raise DegenerateRotationError(
            "6-D rotation: a column is all zero; expected two independent columns"
        )
    first = first / scale_a
    second = second / scale_b
    x = first / np.linalg.norm(first, axis=-1, keepdims=True)
    second = second / np.linalg.norm(second, axis=-1, keepdims=True)
    rest = second - (x * second).sum(axis=-1, keepdims=True) * x
    sine = np.linalg.norm(rest, axis=-1, keepdims=True)
    if (sine < MIN_COLUMN_SINE).any():
        raise DegenerateRotationError(
            f"6-D rotation: columns are parallel (sine {sine.min():.1e} < {MIN_COLUMN_SINE:.0e}); "
            "expected two independent columns"
        )
    y = rest / sine
    # Once more: after a small sine the first projection leaves an error of 1e-16 / sine.
    y = y - (x * y).sum(axis=-1, keepdims=True) * x
    y = y / np.linalg.norm(y, axis=-1, keepdims=True)
    return np.stack([x, y, np.cross(x, y)], axis=-1)


def rotation_from_quaternion(q_wxyz: np.ndarray) -> Float64[np.ndarray, "*batch 3 3"]:
    """Rotations of quaternions [..., 4] (w, x, y, z); DegenerateRotationError near zero."""
    q = _checked(q_wxyz, (4,), "quaternion")
    norm = np.linalg.norm(q, axis=-1, keepdims=True)
    if (norm < 1e-9).any():
        raise DegenerateRotationError(
            "quaternion: norm below 1e-9; a lost sample is often all zero"
        )
    w, x, y, z = np.moveaxis(q / norm, -1, 0)
    rows = [
        [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
        [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
        [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
    ]
    return _matrices(rows)


def quaternion_from_rotation(R: np.ndarray) -> Float64[np.ndarray, "*batch 4"]:
    """Unit quaternions (w, x, y, z) with w ≥ 0, by Shepperd's method (stable at 180°)."""
    m = _checked(R, (3, 3), "rotation matrix")
    trace = np.trace(m, axis1=-2, axis2=-1)
    diagonal = np.stack([trace, m[..., 0, 0], m[..., 1, 1], m[..., 2, 2]], axis=-1)
    # 4·(w², x², y², z²); the largest one is the safe divisor.
    squares = 1 + 2 * diagonal - trace[..., None]
    squares[..., 0] = 1 + trace
    w_x, w_y = m[..., 2, 1] - m[..., 1, 2], m[..., 0, 2] - m[..., 2, 0]
    w_z = m[..., 1, 0] - m[..., 0, 1]
    x_y, x_z = m[..., 0, 1] + m[..., 1, 0], m[..., 0, 2] + m[..., 2, 0]
    y_z = m[..., 1, 2] + m[..., 2, 1]
    rows = _matrices(
        [
            [squares[..., 0], w_x, w_y, w_z],
            [w_x, squares[..., 1], x_y, x_z],
            [w_y, x_y, squares[..., 2], y_z],
            [w_z, x_z, y_z, squares[..., 3]],
        ]
    )
    best = np.argmax(squares, axis=-1)
    q = np.take_along_axis(rows, best[..., None, None], axis=-2)[..., 0, :]
    q = q / np.linalg.norm(q, axis=-1, keepdims=True)
    return np.where(q[..., :1] < 0, -q, q)


def rotation_from_vector(rotation_vector_rad: np.ndarray) -> Float64[np.ndarray, "*batch 3 3"]:
    """Exponential map so(3) → SO(3) by Rodrigues' formula."""
    v = _checked(rotation_vector_rad, (3,), "rotation vector")
    angle = np.linalg.norm(v, axis=-1)[..., None, None]
    small = angle < SERIES_ANGLE_RAD
    safe = np.where(small, 1.0, angle)
    a = np.where(small, 1 - angle**2 / 6 + angle**4 / 120, np.sin(safe) / safe)
    b = np.where(small, 0.5 - angle**2 / 24 + angle**4 / 720, (1 - np.cos(safe)) / safe**2)
    zero = np.zeros_like(v[..., 0])
    x, y, z = np.moveaxis(v, -1, 0)
    K = _matrices([[zero, -z, y], [z, zero, -x], [-y, x, zero]])
    return np.eye(3) + a * K + b * (K @ K)


def vector_from_rotation(R: np.ndarray) -> Float64[np.ndarray, "*batch 3"]:
    """Logarithm SO(3) → so(3): rotation vectors with angles in [0, π], through the quaternion."""
    q = quaternion_from_rotation(R)
    vector_norm = np.linalg.norm(q[..., 1:], axis=-1, keepdims=True)
    angle = 2 * np.arctan2(vector_norm, q[..., :1])
    small = vector_norm < SERIES_ANGLE_RAD
    safe = np.where(small, 1.0, vector_norm)
    # angle / sin(angle/2) near zero: 2 + (angle/2)²/3
    factor = np.where(small, 2 + vector_norm**2 / 3, angle / safe)
    return factor * q[..., 1:]


def rotation_angle(R: np.ndarray) -> Float64[np.ndarray, "*batch"]:
    """Angle of each rotation in radians, in [0, π]."""
    return np.asarray(np.linalg.norm(vector_from_rotation(R), axis=-1))
