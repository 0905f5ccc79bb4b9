"""Rigid transforms as 4×4 matrices: composition, inversion, and conversion to 7-D poses."""

import numpy as np
from jaxtyping import Float64

from dextouch.errors import ShapeError
from dextouch.geometry.rotations import quaternion_from_rotation, rotation_from_quaternion


def transform(R_a_b: np.ndarray, t_a_b: np.ndarray) -> Float64[np.ndarray, "*batch 4 4"]:
    """T_a_b from a rotation [..., 3, 3] and a translation [..., 3] in metres."""
    R = np.asarray(R_a_b, dtype=np.float64)
    t = np.asarray(t_a_b, dtype=np.float64)
    if R.shape[-2:] != (3, 3) or t.shape[-1:] != (3,):
        raise ShapeError(
            f"transform: got R {R.shape} and t {t.shape}, expected [..., 3, 3] and [..., 3]"
        )
    batch = np.broadcast_shapes(R.shape[:-2], t.shape[:-1])
    T = np.zeros((*batch, 4, 4))
    T[..., :3, :3] = R
    T[..., :3, 3] = t
    T[..., 3, 3] = 1.0
    return T


def invert(T_a_b: np.ndarray) -> Float64[np.ndarray, "*batch 4 4"]:
    """T_b_a, by transposing the rotation (exact for rigid transforms)."""
    T = np.asarray(T_a_b, dtype=np.float64)
    R_b_a = np.swapaxes(T[..., :3, :3], -1, -2)
    return transform(R_b_a, -(R_b_a @ T[..., :3, 3:])[..., 0])


def apply(T_a_b: np.ndarray, points_b: np.ndarray) -> Float64[np.ndarray, "*batch 3"]:
    """Points [..., n, 3] of frame b in frame a, for T_a_b [..., 4, 4]."""
    T = np.asarray(T_a_b, dtype=np.float64)
    points = np.asarray(points_b, dtype=np.float64)
    return points @ np.swapaxes(T[..., :3, :3], -1, -2) + T[..., None, :3, 3]


def transform_from_pose(pose: np.ndarray) -> Float64[np.ndarray, "*batch 4 4"]:
    """T from tracker poses [..., 7]: x y z (m), then quaternion w x y z."""
    pose = np.asarray(pose, dtype=np.float64)
    if pose.shape[-1:] != (7,):
        raise ShapeError(f"pose: got shape {pose.shape}, expected [..., 7] (x y z w qx qy qz)")
    return transform(rotation_from_quaternion(pose[..., 3:]), pose[..., :3])


def pose_from_transform(T: np.ndarray) -> Float64[np.ndarray, "*batch 7"]:
    """Tracker poses [..., 7] (x y z in metres, quaternion w x y z) from transforms."""
    T = np.asarray(T, dtype=np.float64)
    return np.concatenate([T[..., :3, 3], quaternion_from_rotation(T[..., :3, :3])], axis=-1)
