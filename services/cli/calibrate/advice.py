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
_ROWS, _COLUMNS = ("upper", "middle", "lower"), ("left", "centre", "right")
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
        views_by_edge: number of views near the left, upper, right and lower edge.
        tilts_rad: [n, 2] angle of the board's normal to the viewing ray: right, down.
        sizes: [n] board diagonal relative to the image diagonal, 0 … about 1.
        todo: advice, most important first; empty if the coverage is sufficient.
    """

    views_by_region: Int64[np.ndarray, "3 3"]
    views_by_edge: Int64[np.ndarray, "4"]
    tilts_rad: Float64[np.ndarray, "n 2"]
    sizes: Float64[np.ndarray, " n"]
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
    width_px, height_px = size_px
    lens = lens or Lens.guessed(width_px, height_px)
    by_region, by_edge = np.zeros((3, 3), dtype=np.int64), np.zeros(4, dtype=np.int64)
    tilts, sizes = np.zeros((len(views), 2)), np.zeros(len(views))
    for index, view in enumerate(views):
        share = view.pixels / np.array([width_px, height_px])
        by_edge += np.concatenate([share.min(axis=0) < RIM, share.max(axis=0) > 1 - RIM])
        cells = (share * 3).astype(int).clip(0, 2)
        for column, row in {(int(x), int(y)) for x, y in cells}:
            by_region[row, column] += 1
        T_camera_board = board_pose(view, lens)
        middle_m = apply(T_camera_board, view.points_board.mean(axis=0, keepdims=True))[0]
        tilts[index] = _tilt_rad(T_camera_board, middle_m)
        extent_px = view.pixels.max(axis=0) - view.pixels.min(axis=0)
        sizes[index] = np.linalg.norm(extent_px) / np.hypot(width_px, height_px)
    todo = (*_place_todo(by_region, by_edge), *_pose_todo(tilts, sizes))
    if not todo and len(views) < ENOUGH_VIEWS:
        todo = (f"take {ENOUGH_VIEWS - len(views)} more photos, each from another direction",)
    return Coverage(by_region, by_edge, tilts, sizes, todo)


def _tilt_rad(T_camera_board: np.ndarray, middle_m: np.ndarray) -> Float64[np.ndarray, "2"]:
    """Angle between the board's normal and the ray to its middle, as a vector: right, down.

    A normal that points right, seen from the camera, has its left edge nearer.
    """
    ray = middle_m / np.linalg.norm(middle_m)
    normal = T_camera_board[:3, 2]
    normal = normal if normal @ ray < 0 else -normal
    across = normal + ray * (-(normal @ ray))
    angle = np.arccos(np.clip(-(normal @ ray), -1.0, 1.0))
    length = np.linalg.norm(across)
    return across[:2] / length * angle if length > 0 else np.zeros(2)


def _place_todo(by_region: np.ndarray, by_edge: np.ndarray) -> list[str]:
    missing = [
        f"{_ROWS[row]} {_COLUMNS[column]}"
        for row, column in zip(*np.nonzero(by_region < VIEWS_PER_REGION), strict=True)
    ]
    if len(missing) == 9:
        return ["hold the board in front of the camera, flat, well lit and still"]
    if missing:
        return [f"move the board to the {', '.join(missing)} of the image"]
    edges = [EDGES[index] for index in np.flatnonzero(by_edge < VIEWS_PER_REGION)]
    if edges:
        return [f"move the board close to the {', '.join(edges)} edge of the image"]
    return []


def _pose_todo(tilts_rad: np.ndarray, sizes: np.ndarray) -> list[str]:
    todo = []
    for words, direction in TILTS.items():
        along = tilts_rad @ np.array(direction)
        if (along >= MIN_TILT_RAD).sum() < VIEWS_PER_TILT:
            todo.append(f"tilt the board by 20 to 45 degrees with {words} to the camera")
    if len(sizes) and sizes.max() < MIN_SIZE_RATIO * sizes.min():
        where = "nearer to" if sizes.max() < 0.6 else "farther from"
        todo.append(f"hold the board {where} the camera")
    return todo


def turn_coverage(Ts_world_tracker: np.ndarray) -> TurnCoverage:
    """Rotation coverage of tracker poses [n ≥ 2, 4, 4]."""
    pairs = np.array(list(combinations(range(len(Ts_world_tracker)), 2)))
    relative = invert(Ts_world_tracker[pairs[:, 1]]) @ Ts_world_tracker[pairs[:, 0]]
    turns_rad = vector_from_rotation(relative[:, :3, :3])
    spread_rad = np.sqrt((turns_rad**2).mean(axis=0))
    todo = [
        f"turn the tracker by 30 degrees and more about its {axis} axis (spread so far "
        f"{np.rad2deg(spread):.0f} degrees)"
        for axis, spread in zip("xyz", spread_rad, strict=True)
        if spread < ENOUGH_TURN_RAD
    ]
    num_views = len(Ts_world_tracker)
    if num_views < ENOUGH_HAND_EYE_VIEWS:
        todo.append(f"take {ENOUGH_HAND_EYE_VIEWS - num_views} more photos with poses")
    return TurnCoverage(turns_rad, spread_rad, tuple(todo))
