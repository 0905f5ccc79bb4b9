"""Calibration boards in photos: their corners, poses, and the photos that cannot be used."""

import re
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from jaxtyping import Float32, Float64, UInt8

from dextouch.command_line import progress
from dextouch.errors import CorruptDataError, InvalidInputError, NotFoundError, UnknownNameError
from dextouch.geometry import transform
from dextouch.geometry.rotations import rotation_from_vector
from services.alignment.calibration.intrinsics import (
    DICTIONARIES,
    CharucoBoard,
    Chessboard,
    FoundBoards,
    edge_width_px,
    find_boards,
    max_edge_width_px,
)

Board = Chessboard | CharucoBoard
SUFFIXES = (".jpg", ".jpeg", ".png", ".bmp", ".tif", ".tiff")
BOARD_HELP = (
    "chessboard:9x6:25mm (inner corners, square) or "
    "charuco:5x7:30mm:22mm[:DICT_5X5_250] (squares, square, marker, dictionary)"
)
_METRES = {"mm": 1e-3, "cm": 1e-2, "m": 1.0}
_LENGTH = r":(\d*\.?\d+)(mm|cm|m)"
_SIZES = {
    "chessboard": re.compile(rf"(\d+)x(\d+){_LENGTH}"),
    "charuco": re.compile(rf"(\d+)x(\d+){_LENGTH}{_LENGTH}(?::(\w+))?"),
}


@dataclass(frozen=True)
class BoardView:
    """Corners of the board detected in one photo.

    `points_board` are positions on the board (m), `pixels` follow OpenCV: the centre of the first
    pixel is 0, 0. `pattern` is the board's print. `is_blurred` photos must be excluded: camera or
    board moved, and the corners are inaccurate.
    """

    name: str
    points_board: Float32[np.ndarray, "n 3"]
    pixels: Float32[np.ndarray, "n 2"]
    pattern: str
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


@dataclass(frozen=True)
class Photos:
    """Photos of one size: views of the board, and the names of those left out.

    `without_board` includes photos in which the board seems to be printed in another way.
    """

    views: tuple[BoardView, ...]
    without_board: tuple[str, ...]
    blurred: tuple[str, ...]
    size_px: tuple[int, int]
    pattern: str

    def __len__(self) -> int:
        """Number of all photos."""
        return len(self.views) + len(self.without_board) + len(self.blurred)

    def corners(self) -> FoundBoards:
        """The views as the solver takes them."""
        return FoundBoards(
            tuple(view.points_board for view in self.views),
            tuple(view.pixels for view in self.views),
            self.size_px,
            tuple(range(len(self.views))),
            len(self),
            self.pattern,
        )

    def tell_left_out(self) -> None:
        """List the excluded photos with the reasons."""
        for name in self.without_board:
            print(f"  no board in {name}: left out")
        for name in self.blurred:
            print(
                f"  {name} is blurred: left out; hold camera and board still, or give it more light"
            )


def parse_board(text: str) -> Board:
    """Parse a board description (`BOARD_HELP`).

    Raises:
        InvalidInputError: invalid syntax.
        UnknownNameError: no such kind of board or dictionary.
    """
    kind, _, sizes = text.partition(":")
    if kind not in _SIZES:
        raise UnknownNameError("board", kind, list(_SIZES))
    matched = _SIZES[kind].fullmatch(sizes)
    if matched is None:
        raise InvalidInputError(f"board {text!r}: expected {BOARD_HELP}")
    columns, rows, square, unit, *marker = matched.groups()
    size = (int(columns), int(rows), float(square) * _METRES[unit])
    if not marker:
        return Chessboard(*size)
    dictionary = marker[2] or CharucoBoard.dictionary
    if dictionary not in DICTIONARIES:
        raise UnknownNameError("marker dictionary", dictionary, list(DICTIONARIES))
    return CharucoBoard(*size, float(marker[0]) * _METRES[marker[1]], dictionary)


def photo_paths(folder: Path) -> list[Path]:
    """The photos of a folder, sorted by name."""
    if not folder.is_dir():
        raise NotFoundError(f"{folder}: no such folder of photos")
    return sorted(path for path in folder.iterdir() if path.suffix.lower() in SUFFIXES)


def decode_photo(data: bytes, *, where: str) -> UInt8[np.ndarray, "h w"]:
    """Decode a photo to a grey image."""
    import cv2

    encoded = np.frombuffer(data, dtype=np.uint8)
    photo = cv2.imdecode(encoded, cv2.IMREAD_GRAYSCALE) if data else None
    if photo is None:
        raise CorruptDataError(f"{where}: {len(data)} bytes are not an image")
    return np.asarray(photo, dtype=np.uint8)


def find_board(name: str, photo: np.ndarray, board: Board) -> BoardView | None:
    """Detect the board in a grey photo (uint8 [h, w]); None if not found."""
    found = find_boards([photo], board)
    if not found.photos:
        return None
    pixels = found.pixels_px[0]
    if isinstance(board, Chessboard):
        pixels = _dark_first(photo, pixels, board)
    width_px = edge_width_px(photo, found.points_board[0], pixels)
    is_blurred = width_px > max_edge_width_px(photo)
    return BoardView(name, found.points_board[0], pixels, found.pattern, is_blurred)


def read_photos(paths: Sequence[Path], board: Board) -> Photos:
    """Read photos and find the board in each, with a progress bar.

    The board's print is the one with most corners; others are false detections.

    Raises:
        CorruptDataError: a file that cannot be decoded.
        InvalidInputError: photos of different sizes.
    """
    seen: list[BoardView] = []
    size: tuple[int, ...] = ()
    for path in progress(paths, "looking for the board", len(paths)):
        photo = decode_photo(path.read_bytes(), where=str(path))
        if size not in {(), photo.shape}:
            raise InvalidInputError(
                f"{path}: got {photo.shape[1]} by {photo.shape[0]} px, expected {size[1]} by "
                f"{size[0]} as {paths[0].name}; photos must come from one camera mode"
            )
        size = photo.shape
        view = find_board(path.name, photo, board)
        seen += [] if view is None else [view]
    corners = {view.pattern: 0 for view in seen}
    for view in seen:
        corners[view.pattern] += len(view.pixels)
    pattern = max(corners, key=lambda name: corners[name], default="no board")
    found = {view.name: view for view in seen if view.pattern == pattern}
    return Photos(
        tuple(view for view in found.values() if not view.is_blurred),
        tuple(path.name for path in paths if path.name not in found),
        tuple(view.name for view in found.values() if view.is_blurred),
        (size[1], size[0]),
        pattern,
    )


def is_ambiguous(board: Board) -> bool:
    """Whether the board is symmetric under a half turn, so that its pose is ambiguous."""
    return isinstance(board, Chessboard) and (board.columns - board.rows) % 2 == 0


def board_pose(view: BoardView, lens: Lens) -> Float64[np.ndarray, "4 4"]:
    """T_camera_board of one view, by least squares on its corners."""
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


def reprojection(view: BoardView, lens: Lens) -> Float64[np.ndarray, "n 2"]:
    """Measured minus predicted pixels of a view's corners, at the board's best pose."""
    import cv2

    T_camera_board = board_pose(view, lens)
    turn, _ = cv2.Rodrigues(T_camera_board[:3, :3])
    predicted, _ = cv2.projectPoints(
        view.points_board.astype(np.float64), turn, T_camera_board[:3, 3], lens.K, lens.distortion
    )
    return view.pixels.astype(np.float64) - np.asarray(predicted).reshape(-1, 2)


def _dark_first(photo: np.ndarray, pixels: np.ndarray, board: Chessboard) -> np.ndarray:
    """Order the corners to start beside a dark square, where that resolves the symmetry."""
    if is_ambiguous(board):
        return pixels
    grid = pixels.reshape(board.rows, board.columns, 2)
    ends = [grid[:2, :2].mean(axis=(0, 1)), grid[-2:, -2:].mean(axis=(0, 1))]
    first, last = (photo[round(float(y)), round(float(x))] for x, y in ends)
    return pixels if first < last else pixels[::-1].copy()
