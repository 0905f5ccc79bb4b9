"""Pinhole projection of points in the optical frame (x right, y down, z forward) to pixels."""

import numpy as np
from jaxtyping import Bool, Float64


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
