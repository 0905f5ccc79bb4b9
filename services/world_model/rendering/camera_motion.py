"""Image motion caused by a known motion of the head camera over the table.

Pixels of the table plane (z = 0 in the world) move by a homography; rays that meet the plane
beyond `FAR_M`, or never, move as if they came from infinity.
"""

from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Bool, Float, Float32, Float64
from torch import Tensor
from torch.nn import functional

from dextouch.geometry import invert
from services.world_model.rendering.configuration import Interpolation

FAR_M = 20.0
# A camera nearer to the plane than this sees it edge-on.
MIN_HEIGHT_M = 1e-3
# Positions farther outside than this many image sides all sample the border.
_MAX_SIDES = 4.0
_MIN_DEPTH = 1e-9


def pixel_centres(height_px: int, width_px: int) -> Float64[np.ndarray, "pixels 2"]:
    """Positions of all pixel centres, row by row; the first is (0.5, 0.5)."""
    u, v = np.meshgrid(np.arange(width_px) + 0.5, np.arange(height_px) + 0.5)
    return np.stack([u.ravel(), v.ravel()], axis=1)


@dataclass(frozen=True)
class CameraMotion:
    """Maps from pixels of later images to pixels of start images.

    Attributes:
        table: homogeneous pixels of a later image to those of the start, on the table.
        infinity: the same for points at infinity.
        inverse_depth: row vectors whose product with a homogeneous pixel is 1 / (depth of the
            table there), in 1/m; zero for a camera that sees the table as a line.
    """

    table: Float64[np.ndarray, "n 3 3"]
    infinity: Float64[np.ndarray, "n 3 3"]
    inverse_depth: Float64[np.ndarray, "n 1 3"]

    @classmethod
    def between(
        cls, K: np.ndarray, T_world_start: np.ndarray, T_world_camera: np.ndarray
    ) -> "CameraMotion":
        """Motion between the start and later cameras [n, 4, 4], with equal K [n, 3, 3]."""
        R_start_camera = np.swapaxes(T_world_start[:, :3, :3], -1, -2) @ T_world_camera[:, :3, :3]
        infinity = K @ R_start_camera @ np.linalg.inv(K)
        is_above = (np.abs(T_world_camera[:, 2, 3]) > MIN_HEIGHT_M)[:, None, None]
        plane = np.where(is_above, _plane_projection(K, T_world_camera), np.eye(3))
        camera_to_table = np.linalg.inv(plane)
        table = _plane_projection(K, T_world_start) @ camera_to_table
        same = (T_world_start == T_world_camera).all(axis=(1, 2))[:, None, None]
        return cls(
            np.where(same, np.eye(3), table),
            np.where(same, np.eye(3), infinity),
            np.where(is_above, camera_to_table[:, 2:], 0.0),
        )

    def to_start(
        self, pixels: Float64[np.ndarray, "n points 2"]
    ) -> Float64[np.ndarray, "n points 2"]:
        """Start image positions of the table or the far background at these pixels."""
        homogeneous = np.concatenate([pixels, np.ones((*pixels.shape[:2], 1))], axis=2)
        return np.swapaxes(self._to_start(np.swapaxes(homogeneous, 1, 2)), 1, 2)

    def image_positions(self, shape_px: tuple[int, int]) -> Float32[np.ndarray, "n h w 2"]:
        """Start image position of each pixel of the later image, at most four sides away."""
        height, width = shape_px
        centres = pixel_centres(height, width)
        homogeneous = np.ones((3, height * width), dtype=np.float32)
        homogeneous[:2] = centres.T
        limit = _MAX_SIDES * max(shape_px)
        positions = self._to_start(homogeneous).clip(-limit, limit)
        return np.ascontiguousarray(np.swapaxes(positions, 1, 2)).reshape(-1, height, width, 2)

    def _to_start(self, homogeneous: np.ndarray) -> np.ndarray:
        """Positions [n, 2, points] of homogeneous pixels [3, points] or [n, 3, points]."""
        kind = homogeneous.dtype
        chosen = self.table.astype(kind) @ homogeneous
        is_near = self.inverse_depth.astype(kind) @ homogeneous > 1.0 / FAR_M
        is_near &= chosen[:, 2:] > _MIN_DEPTH
        if not is_near.all():
            chosen = np.where(is_near, chosen, self.infinity.astype(kind) @ homogeneous)
        # Points behind the start camera were not in its image: move them far to the left and top.
        seen = chosen[:, 2:] > _MIN_DEPTH
        positions = chosen[:, :2] / np.where(seen, chosen[:, 2:], 1.0)
        return positions if seen.all() else np.where(seen, positions, kind.type(-1e6))


def _plane_projection(K: np.ndarray, T_world_camera: np.ndarray) -> Float64[np.ndarray, "*b 3 3"]:
    """Matrices that project points (x, y, 1) of the table to pixels times depth."""
    return np.asarray(K @ invert(T_world_camera)[..., :3, [0, 1, 3]])


def sample_images(
    images: Float32[Tensor, "n c h w"],
    positions: Float32[Tensor, "n rows cols 2"],
    *,
    interpolation: Interpolation,
) -> Float32[Tensor, "n c rows cols"]:
    """Sample images at positions in pixels; outside, the nearest border pixel."""
    sides = torch.tensor([images.shape[3], images.shape[2]], dtype=torch.float32)
    return functional.grid_sample(
        images,
        positions * (2.0 / sides) - 1.0,
        mode=interpolation,
        padding_mode="border",
        align_corners=False,
    )


def is_inside(
    positions: Float[np.ndarray, "*b 2"], shape_px: tuple[int, int]
) -> Bool[np.ndarray, "*b"]:
    """Whether positions in pixels lie inside an image."""
    height, width = shape_px
    u, v = positions[..., 0], positions[..., 1]
    return np.asarray((u >= 0) & (u <= width) & (v >= 0) & (v <= height))
