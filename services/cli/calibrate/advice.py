"""Coverage of calibration views, and advice on what to capture next."""

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import combinations

import numpy as np
from jaxtyping import Float64, Int64

from dextouch.geometry import apply, invert
from dextouch.geometry.rotations import vector_from_rotation
from services.cli.calibrate.boards import BoardView, Lens, board_pose

# With fewer views than this the focal length scatters by more than 0.3 % (docs/calibration.md).
ENOUGH_VIEWS = 25
VIEWS_PER_REGION = 2
VIEWS_PER_TILT = 2
# Distortion is largest at the rim: corners must come within this part of every edge.
RIM = 0.15
EDGES = ("left", "upper", "right", "lower")
MIN_TILT_RAD = np.deg2rad(15.0)
MIN_SIZE_RATIO = 1.5
ENOUGH_HAND_EYE_VIEWS = 20
ENOUGH_TURN_RAD = np.deg2rad(15.0)
REGIONS = np.array(
    [[f"{y} {x}" for x in ("left", "centre", "right")] for y in ("upper", "middle", "lower")]
)
# Directions of the board's normal, right and down, in which an edge is nearer to the camera.
TILTS = {
    "its left edge nearer": (1.0, 0.0),
    "its right edge nearer": (-1.0, 0.0),
    "its upper edge nearer": (0.0, 1.0),
    "its lower edge nearer": (0.0, -1.0),
}


@dataclass(frozen=True)
class Coverage:
    """Coverage of a camera by views of a board.

    Attributes:
        views_by_region: number of views with corners in each ninth of the image.
        tilts_rad: [n, 2] angle of the board's normal to the viewing ray: right, down.
        todo: advice, most important first; empty if the coverage is sufficient.
    """

    views_by_region: Int64[np.ndarray, "3 3"]
    tilts_rad: Float64[np.ndarray, "n 2"]
    todo: tuple[str, ...]


@dataclass(frozen=True)
class TurnCoverage:
    """Rotations of a tracker about the axes of its own frame, over all pairs of views.

    Attributes:
        turns_rad: [pairs, 3] rotation vectors of the pairs' relative motions.
        spread_rad: [3] RMS about x, y, z.
        todo: advice; empty if the coverage is sufficient.
    """

    turns_rad: Float64[np.ndarray, "pairs 3"]
    spread_rad: Float64[np.ndarray, "3"]
    todo: tuple[str, ...]


def camera_coverage(
    views: Sequence[BoardView], size_px: tuple[int, int], lens: Lens | None = None
) -> Coverage:
    """Coverage of the image by positions, tilts and sizes of the board.

    Args:
        views: views with a detected board.
        size_px: width and height of the photos.
        lens: lens of the camera; a default guess if unknown.
    """
    lens = lens or Lens.guessed(*size_px)
    by_region, by_edge = np.zeros((3, 3), dtype=np.int64), np.zeros(4, dtype=np.int64)
    tilts_rad, sizes = np.zeros((len(views), 2)), np.zeros(len(views))
    for index, view in enumerate(views):
        share = view.pixels / np.array(size_px)
        by_edge += np.concatenate([share.min(axis=0) < RIM, share.max(axis=0) > 1 - RIM])
        columns, rows = (share * 3).astype(int).clip(0, 2).T
        by_region += np.bincount(3 * rows + columns, minlength=9).reshape(3, 3) > 0
        tilts_rad[index] = _tilt_rad(view, lens)
        sizes[index] = np.linalg.norm(np.ptp(view.pixels, axis=0)) / np.hypot(*size_px)
    todo = [*_places(by_region, by_edge), *_poses(tilts_rad, sizes)]
    if not todo and len(views) < ENOUGH_VIEWS:
        todo = [f"take {ENOUGH_VIEWS - len(views)} more photos, each from another direction"]
    return Coverage(by_region, tilts_rad, tuple(todo))


def _tilt_rad(view: BoardView, lens: Lens) -> Float64[np.ndarray, "2"]:
    """Angle between the board's normal and the ray to its middle, as a vector: right, down."""
    T_camera_board = board_pose(view, lens)
    middle_m = apply(T_camera_board, view.points_board.mean(axis=0, keepdims=True))[0]
    ray, normal = middle_m / np.linalg.norm(middle_m), T_camera_board[:3, 2]
    towards = -abs(normal @ ray)
    across = np.copysign(1.0, -(normal @ ray)) * normal - ray * towards
    length = np.linalg.norm(across)
    return across[:2] / length * np.arccos(min(-towards, 1.0)) if length > 0 else np.zeros(2)


def _places(by_region: np.ndarray, by_edge: np.ndarray) -> list[str]:
    missing = REGIONS[by_region < VIEWS_PER_REGION].tolist()
    if len(missing) == REGIONS.size:
        return ["hold the board in front of the camera, flat, well lit and still"]
    if missing:
        return [f"move the board to the {', '.join(missing)} of the image"]
    edges = [EDGES[index] for index in np.flatnonzero(by_edge < VIEWS_PER_REGION)]
    return [f"move the board close to the {', '.join(edges)} edge of the image"] if edges else []


def _poses(tilts_rad: np.ndarray, sizes: np.ndarray) -> list[str]:
    todo = [
        f"tilt the board by 20 to 45 degrees with {words} to the camera"
        for words, direction in TILTS.items()
        if (tilts_rad @ np.array(direction) >= MIN_TILT_RAD).sum() < VIEWS_PER_TILT
    ]
    if len(sizes) and sizes.max() < MIN_SIZE_RATIO * sizes.min():
        where = "nearer to" if sizes.max() < 0.6 else "farther from"
        todo.append(f"hold the board {where} the camera")
    return todo


def turn_coverage(Ts_world_tracker: np.ndarray) -> TurnCoverage:
    """Rotation coverage of tracker poses [n ≥ 2, 4, 4]."""
    num_views = len(Ts_world_tracker)
    pairs = np.array(list(combinations(range(num_views), 2)))
    relative = invert(Ts_world_tracker[pairs[:, 1]]) @ Ts_world_tracker[pairs[:, 0]]
    turns_rad = vector_from_rotation(relative[:, :3, :3])
    spread_rad = np.sqrt((turns_rad**2).mean(axis=0))
    todo = [
        f"turn the tracker by 30 degrees and more about its {axis} axis (spread so far "
        f"{np.rad2deg(spread):.0f} degrees)"
        for axis, spread in zip("xyz", spread_rad, strict=True)
        if spread < ENOUGH_TURN_RAD
    ]
    if num_views < ENOUGH_HAND_EYE_VIEWS:
        todo.append(f"take {ENOUGH_HAND_EYE_VIEWS - num_views} more photos with poses")
    return TurnCoverage(turns_rad, spread_rad, tuple(todo))
