"""Twists (rotation vector, then translation) and the Jacobians that calibration solvers need.

A twist is [..., 6]: rotation vector in rad, then translation in m. T · move(twist) turns T in its
own frame about its own origin and shifts it along its own axes.
"""

import numpy as np
from jaxtyping import Float64

from dextouch.geometry import transform
from dextouch.geometry.rotations import (
    SERIES_ANGLE_RAD,
    rotation_from_vector,
    vector_from_rotation,
)


def hat(vectors: np.ndarray) -> Float64[np.ndarray, "*batch 3 3"]:
    """Skew-symmetric (cross product) matrices of vectors [..., 3]."""
    x, y, z = np.moveaxis(np.asarray(vectors, dtype=np.float64), -1, 0)
    crossed = np.zeros((*x.shape, 3, 3))
    crossed[..., 0, 1], crossed[..., 0, 2], crossed[..., 1, 2] = -z, y, -x
    crossed[..., 1, 0], crossed[..., 2, 0], crossed[..., 2, 1] = z, -y, x
    return crossed


def adjoint(T_a_b: np.ndarray) -> Float64[np.ndarray, "*batch 6 6"]:
    """Takes twists of frame b to frame a: T · move(v) = move(adjoint(T) @ v) · T to first order."""
    R = T_a_b[..., :3, :3]
    full = np.zeros((*R.shape[:-2], 6, 6))
    full[..., :3, :3] = full[..., 3:, 3:] = R
    full[..., 3:, :3] = hat(T_a_b[..., :3, 3]) @ R
    return full


def move(twists: np.ndarray) -> Float64[np.ndarray, "*batch 4 4"]:
    """Transforms of twists [..., 6]; rotation and translation side by side, not a screw."""
    return transform(rotation_from_vector(twists[..., :3]), twists[..., 3:])


def twist(T: np.ndarray) -> Float64[np.ndarray, "*batch 6"]:
    """Twists of transforms; the inverse of `move`."""
    return np.concatenate([vector_from_rotation(T[..., :3, :3]), T[..., :3, 3]], axis=-1)


def right_jacobian_inverse(vectors_rad: np.ndarray) -> Float64[np.ndarray, "*batch 3 3"]:
    """Inverse right Jacobian of SO(3) at a rotation vector.

    For angles below half a turn (Solà et al. 2018, A micro Lie theory, eq. 144).
    """
    angle = np.linalg.norm(vectors_rad, axis=-1)[..., None, None]
    small = angle < SERIES_ANGLE_RAD
    safe = np.where(small, 1.0, angle)
    factor = np.where(
        small,
        1 / 12 + angle**2 / 720,
        1 / safe**2 - (1 + np.cos(safe)) / (2 * safe * np.sin(safe)),
    )
    crossed = hat(vectors_rad)
    return np.eye(3) + 0.5 * crossed + factor * (crossed @ crossed)


def twist_jacobian(Ts: np.ndarray) -> Float64[np.ndarray, "n 6 6"]:
    """Jacobian of the twists of transforms [n, 4, 4] by T · move(v)."""
    J = np.zeros((len(Ts), 6, 6))
    J[:, :3, :3] = right_jacobian_inverse(twist(Ts)[:, :3])
    J[:, 3:, 3:] = Ts[:, :3, :3]
    return J


def nearest_pose(Ts: np.ndarray) -> Float64[np.ndarray, "4 4"]:
    """Mean of poses [n, 4, 4]: rotation nearest to the mean matrix, mean translation."""
    return transform(nearest_rotation(Ts[:, :3, :3].mean(axis=0)), Ts[:, :3, 3].mean(axis=0))


def nearest_rotation(matrix: np.ndarray) -> Float64[np.ndarray, "3 3"]:
    """The rotation nearest to a 3 by 3 matrix (orthogonal Procrustes)."""
    U, _, Vt = np.linalg.svd(matrix)
    return U @ np.diag([1.0, 1.0, np.linalg.det(U @ Vt)]) @ Vt
