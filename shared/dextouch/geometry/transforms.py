"""Rigid transforms as 4×4 matrices, and pinhole projection of points to pixels.

Projected points are in the optical frame (x right, y down, z forward).
"""

import math

import numpy as np
from jaxtyping import Bool, Float64

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


def rigid_error(T: np.ndarray) -> float:
    """How far transforms [..., 4, 4] are from rigid ones: 0 for rotations with the row 0 0 0 1.

    The largest difference of RᵀR from the identity and of the last row; infinite for reflections
    and where a value is not finite, 0 for no transforms.
    """
    T = np.asarray(T, dtype=np.float64)
    R = T[..., :3, :3]
    if not np.isfinite(T).all() or (np.linalg.det(R) < 0).any():
        return math.inf
    off = np.abs(np.swapaxes(R, -1, -2) @ R - np.eye(3)).max(initial=0.0)
    return float(np.abs(T[..., 3, :] - [0.0, 0.0, 0.0, 1.0]).max(initial=off))


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


def pinhole_matrix(*, width_px: int, height_px: int, fovy_rad: float) -> Float64[np.ndarray, "3 3"]:
    """K of an ideal camera with square pixels and its principal point at the image centre.

    Pixel centres lie at half-integers (the first pixel spans 0 … 1), so cx = width / 2.
    """
    focal_px = 0.5 * height_px / np.tan(0.5 * fovy_rad)
    return np.array(
        [[focal_px, 0.0, 0.5 * width_px], [0.0, focal_px, 0.5 * height_px], [0.0, 0.0, 1.0]]
    )


def project(
    K: np.ndarray, points_camera: np.ndarray, *, min_depth_m: float = 0.01
) -> tuple[Float64[np.ndarray, "*batch 2"], Bool[np.ndarray, "*batch"]]:
    """Pixels [..., 2] of points [..., 3] in metres, and whether each lies in front of the camera.

    Points nearer than `min_depth_m` are projected as if at that depth and marked False. Lens
    distortion is not modelled: in images of a real camera, points are off by its
    `distortion_<camera>`.
    """
    points = np.asarray(points_camera, dtype=np.float64)
    in_front = points[..., 2] >= min_depth_m
    depth = np.maximum(points[..., 2:], min_depth_m)
    pixels = points[..., :2] / depth * np.array([K[0, 0], K[1, 1]]) + np.array([K[0, 2], K[1, 2]])
    return pixels, in_front
