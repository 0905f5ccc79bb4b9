"""Blur measurement on photos of a board, to exclude blurred ones from a calibration.

A photo taken while camera or board moves shifts all corners along the motion, by half a pixel at 6
px of blur, which the residuals do not show because the board's pose absorbs it. The edges of the
squares do show it, those across the motion more than those along it.
"""

import numpy as np
from jaxtyping import Float64, UInt8

# Wider edges are blurred. Measured on rendered ChArUco boards: sharp 2.0 to 2.2 px, out of focus by
# 1.5 px (one sigma) 3.1 to 3.7, moved by 3 px 2.4 to 3.3, moved by 6 px 4.1 to 5.1; on photos of a
# real camera of 640 by 480 px 2.0 to 3.1.
MAX_EDGE_WIDTH_PX = 3.8
# That of 1280 by 720 px. Angles count: the pixels of larger images are smaller ones.
USUAL_DIAGONAL_PX = 1469.0
# The profile across an edge, as a part of it: further off the markers of ChArUco boards begin.
REACH = 0.12
MIN_REACH_PX = 2.0
STEP_PX = 0.5


def max_edge_width_px(photo: np.ndarray) -> float:
    """Edge width above which a photo of this size counts as blurred."""
    return MAX_EDGE_WIDTH_PX * max(1.0, float(np.hypot(*photo.shape)) / USUAL_DIAGONAL_PX)


def edge_width_px(
    photo: UInt8[np.ndarray, "h w"], points_board: np.ndarray, pixels: np.ndarray
) -> float:
    """Width over which the edges between dark and light squares rise.

    The edges along each of the board's two axes are summarized by their median; the wider counts.

    Args:
        photo: grey.
        points_board: [n, 3] corners in board coordinates (m), of a regular grid.
        pixels: [n, 2] where they were seen; the middle of the first pixel is 0, 0.

    Returns:
        About 2.5 sigma of the blur; infinity where no two corners are neighbours.
    """
    grid = np.asarray(points_board, dtype=np.float64)[:, :2]
    apart = grid[None] - grid[:, None]
    length = np.linalg.norm(apart, axis=-1)
    square_m = length[length > 0].min()
    ends = np.asarray(pixels, dtype=np.float64)
    widths = []
    for step_m in square_m * np.eye(2):
        first, second = np.nonzero(np.abs(apart - step_m).max(axis=-1) < 0.01 * square_m)
        if len(first):
            widths.append(np.median(_widths_px(photo, ends[first], ends[second])))
    return float(max(widths, default=np.inf))


def _widths_px(
    photo: np.ndarray, first: np.ndarray, second: np.ndarray
) -> Float64[np.ndarray, " edges"]:
    """Contrast over the steepest rise across the middle of each edge."""
    along = second - first
    length_px = np.linalg.norm(along, axis=1, keepdims=True)
    across = np.column_stack([-along[:, 1], along[:, 0]]) / length_px
    reach_px = max(MIN_REACH_PX, REACH * float(np.median(length_px)))
    offsets = np.arange(-reach_px, reach_px + STEP_PX / 2, STEP_PX)
    middle = 0.5 * (first + second)[:, None]
    profiles = _sampled(photo, middle + offsets[:, None] * across[:, None])
    steepest = np.abs(np.diff(profiles, axis=1)).max(axis=1) / STEP_PX
    # Of the squares beside the edges: a blurred profile does not reach it within its length.
    beside = np.linspace(-0.25, 0.25, 9)[:, None] * (length_px * across)[:, None]
    dark, light = np.quantile(_sampled(photo, middle + beside), (0.1, 0.9))
    return (light - dark) / np.maximum(steepest, 1e-9)


def _sampled(photo: np.ndarray, places: np.ndarray) -> Float64[np.ndarray, "edges steps"]:
    """Bilinear grey levels at pixels [..., 2]; outside the photo those of its rim."""
    # Here, since commands that measure nothing import this module on stations without scipy.
    from scipy.ndimage import map_coordinates

    at = np.moveaxis(places, -1, 0)[::-1]
    return map_coordinates(photo.astype(np.float64), at, order=1, mode="nearest")
