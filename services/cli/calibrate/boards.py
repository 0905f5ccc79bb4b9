"""Detection of calibration boards in photos, and their poses."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float32, Float64

from dextouch.errors import InvalidInputError, UnknownNameError
from dextouch.geometry import transform
from dextouch.geometry.rotations import rotation_from_vector
from services.alignment.calibration.board_detection import (
    DICTIONARIES,
    CharucoBoard,
    Chessboard,
    find_boards,
)
from services.alignment.calibration.sharpness import edge_width_px, max_edge_width_px

Board = Chessboard | CharucoBoard
_METRES = {"mm": 1e-3, "cm": 1e-2, "m": 1.0}
BOARD_HELP = (
    "chessboard:9x6:25mm (inner corners, square) or "
    "charuco:5x7:30mm:22mm[:DICT_5X5_250] (squares, square, marker, dictionary)"
)


@dataclass(frozen=True)
class BoardView:
    """Corners of the board detected in one photo.

    `points_board` are positions on the board (m), `pixels` follow OpenCV: the centre of the first
    pixel is 0, 0. `pattern` is the board's print, `edge_width_px` the blur of its edges.
    `is_blurred` photos must be excluded: camera or board moved, and the corners are inaccurate.
    """

    name: str
    points_board: Float32[np.ndarray, "n 3"]
    pixels: Float32[np.ndarray, "n 2"]
    pattern: str
    edge_width_px: float
    is_blurred: bool


@dataclass(frozen=True)
class Lens:
    """OpenCV's camera: K with pixel centres at whole numbers, distortion k1 k2 p1 p2 k3."""

    K: Float64[np.ndarray, "3 3"]
    distortion: Float64[np.ndarray, "5"]

    @staticmethod
    def guessed(width_px: int, height_px: int) -> "Lens":
        """A lens of about 56 degrees field of view, for tilts before there is a calibration."""
        middle = [0.5 * (width_px - 1), 0.5 * (height_px - 1)]
        K = np.array([[0.94 * width_px, 0, middle[0]], [0, 0.94 * width_px, middle[1]], [0, 0, 1]])
        return Lens(K, np.zeros(5))


def parse_board(text: str) -> Board:
    """Parse a board description (`BOARD_HELP`).

    Raises:
        InvalidInputError: invalid syntax.
        UnknownNameError: no such kind of board or dictionary.
    """
    kind, *parts = text.split(":")
    if kind not in {"chessboard", "charuco"}:
        raise UnknownNameError("board", kind, ["chessboard", "charuco"])
    try:
        columns, rows = (int(number) for number in parts[0].split("x"))
        lengths = [_metres(part) for part in parts[1:3]]
        if kind == "chessboard":
            (square_m,) = (_metres(part) for part in parts[1:])
            return Chessboard(columns, rows, square_m)
        square_m, marker_m = lengths
        dictionary = parts[3] if len(parts) > 3 else CharucoBoard.dictionary
    except (ValueError, IndexError) as error:
        raise InvalidInputError(f"board {text!r}: expected {BOARD_HELP}") from error
    if dictionary not in DICTIONARIES:
        raise UnknownNameError("marker dictionary", dictionary, list(DICTIONARIES))
    return CharucoBoard(columns, rows, square_m, marker_m, dictionary)


def find_board(name: str, photo: np.ndarray, board: Board) -> BoardView | None:
    """Detect the board in a grey photo (uint8 [h, w]); None if not found.

    Raises:
        InvalidInputError: an invalid board.
    """
    found = find_boards([photo], board)
    if not found.photos:
        return None
    pixels = found.pixels_px[0]
    if isinstance(board, Chessboard):
        pixels = _dark_first(photo, pixels, board)
    width_px = edge_width_px(photo, found.points_board[0], pixels)
    is_blurred = width_px > max_edge_width_px(photo)
    return BoardView(name, found.points_board[0], pixels, found.pattern, width_px, is_blurred)


def usual_pattern(views: Sequence[BoardView]) -> str:
    """Pattern supported by most corners; views with another one are false detections."""
    corners: dict[str, int] = {}
    for view in views:
        corners[view.pattern] = corners.get(view.pattern, 0) + len(view.pixels)
    return max(corners, key=lambda pattern: corners[pattern]) if corners else "no board"


def is_ambiguous(board: Board) -> bool:
    """Whether the board is symmetric under a half turn, so that its pose is ambiguous."""
    return isinstance(board, Chessboard) and (board.columns - board.rows) % 2 == 0


def board_pose(view: BoardView, lens: Lens) -> Float64[np.ndarray, "4 4"]:
    """T_camera_board of one view, by least squares on its corners.

    Raises:
        InvalidInputError: the corners allow no pose (all on one line).
    """
    import cv2

    points, pixels = view.points_board.astype(np.float64), view.pixels.astype(np.float64)
    try:
        found, turn, shift = cv2.solvePnP(
            points, pixels, lens.K, lens.distortion, flags=cv2.SOLVEPNP_IPPE
        )
        if found:
            turn, shift = cv2.solvePnPRefineLM(points, pixels, lens.K, lens.distortion, turn, shift)
    except cv2.error as error:
        raise InvalidInputError(f"{view.name}: the corners give no pose ({error.err})") from error
    if not found:
        raise InvalidInputError(f"{view.name}: the corners give no pose; leave the photo out")
    R = rotation_from_vector(np.asarray(turn, dtype=np.float64).ravel())
    return transform(R, np.asarray(shift, dtype=np.float64).ravel())


def reprojection(
    view: BoardView, lens: Lens, T_camera_board: np.ndarray
) -> Float64[np.ndarray, "n 2"]:
    """Measured minus predicted pixels of a view's corners."""
    import cv2

    turn, _ = cv2.Rodrigues(T_camera_board[:3, :3])
    predicted, _ = cv2.projectPoints(
        view.points_board.astype(np.float64), turn, T_camera_board[:3, 3], lens.K, lens.distortion
    )
    return view.pixels.astype(np.float64) - np.asarray(predicted).reshape(-1, 2)


def _metres(text: str) -> float:
    for unit in ("mm", "cm", "m"):
        if text.endswith(unit):
            return float(text.removesuffix(unit)) * _METRES[unit]
    raise ValueError(text)


def _dark_first(photo: np.ndarray, pixels: np.ndarray, board: Chessboard) -> np.ndarray:
    """Order the corners to start beside a dark square, where that resolves the symmetry."""
    if is_ambiguous(board):
        return pixels
    grid = pixels.reshape(board.rows, board.columns, 2)
    ends = [grid[:2, :2].mean(axis=(0, 1)), grid[-2:, -2:].mean(axis=(0, 1))]
    first, last = (photo[round(float(y)), round(float(x))] for x, y in ends)
    return pixels if first < last else pixels[::-1].copy()
