"""Baseline image: an earlier image, warped by the camera's known motion over the table."""

import numpy as np
from jaxtyping import Float64, UInt8

from dextouch.geometry import apply, invert


def warp_over_table(
    image: UInt8[np.ndarray, "h w 3"],
    K: np.ndarray,
    T_world_then: np.ndarray,
    T_world_now: np.ndarray,
) -> UInt8[np.ndarray, "h w 3"]:
    """Image of a camera now if everything in its earlier image lies on the table plane z = 0.

    Bilinear; pixels outside the image repeat its edge. Rays that miss the table count as
    infinitely far.
    """
    height, width = image.shape[:2]
    u, v = np.meshgrid(np.arange(width) + 0.5, np.arange(height) + 0.5)
    pixels = np.stack([u, v, np.ones_like(u)], axis=-1).reshape(-1, 3)
    rays = pixels @ np.linalg.inv(K).T @ T_world_now[:3, :3].T
    down = rays[:, 2] < -1e-9
    far = np.where(down, -T_world_now[2, 3] / np.where(down, rays[:, 2], 1.0), 1e6)
    points = T_world_now[:3, 3] + far[:, None] * rays
    then = apply(invert(T_world_then), points)
    depth = np.where(np.abs(then[:, 2:]) > 1e-9, then[:, 2:], 1e-9)
    at = (then / depth) @ K.T - 0.5
    return _bilinear(image, at[:, :2]).reshape(height, width, 3)


def _bilinear(image: np.ndarray, at_px: np.ndarray) -> UInt8[np.ndarray, "n 3"]:
    height, width = image.shape[:2]
    x = np.clip(at_px[:, 0], 0, width - 1)
    y = np.clip(at_px[:, 1], 0, height - 1)
    left, top = np.floor(x).astype(int), np.floor(y).astype(int)
    right, bottom = np.minimum(left + 1, width - 1), np.minimum(top + 1, height - 1)
    fx, fy = (x - left)[:, None], (y - top)[:, None]
    values: Float64[np.ndarray, "n 3"] = (
        image[top, left] * (1 - fx) * (1 - fy)
        + image[top, right] * fx * (1 - fy)
        + image[bottom, left] * (1 - fx) * fy
        + image[bottom, right] * fx * fy
    )
    return np.round(values).astype(np.uint8)
