"""Calibration boards in photos: corners, poses, coverage of the views and what to capture next."""

import re
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from jaxtyping import Float32, Float64, Int64, UInt8

from dextouch.command_line import progress
from dextouch.data_folder import is_system_file
from dextouch.errors import CorruptDataError, InvalidInputError, NotFoundError, UnknownNameError
from dextouch.geometry import Distortion, apply, transform
from dextouch.geometry.rotations import rotation_from_vector
from services.alignment.calibration import intrinsics

Board = intrinsics.Chessboard | intrinsics.CharucoBoard
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
# With fewer views than this the focal length scatters by more than 0.3 % (docs/calibration.md).
ENOUGH_VIEWS = 25
# Three of these sigmas are 0.3 % of the focal length.
MAX_FOCAL_SIGMA = 0.001
VIEWS_PER_REGION = 2
VIEWS_PER_TILT = 2
# Distortion is largest at the rim: corners must come within this part of every edge.
RIM = 0.15
EDGES = ("left", "upper", "right", "lower")
MIN_TILT_RAD = np.deg2rad(15.0)
MIN_SIZE_RATIO = 1.5
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
class BoardView:
    """Corners of the board, whose print is `pattern`, in one photo; `is_blurred` ones are left out.

    `points_board` are in m, `pixels` follow OpenCV: the centre of the first pixel is 0, 0.
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
    distortion: Distortion

    @staticmethod
    def guessed(width_px: int, height_px: int) -> "Lens":
        """A lens of about 56 degrees field of view, for tilts before there is a calibration."""
        middle = [0.5 * (width_px - 1), 0.5 * (height_px - 1)]
        K = np.array([[0.94 * width_px, 0, middle[0]], [0, 0.94 * width_px, middle[1]], [0, 0, 1]])
        return Lens(K, np.zeros(5))


@dataclass(frozen=True)
class Photos:
    """Photos of one size: views of the board, and names of those without this print of it."""

    views: tuple[BoardView, ...]
    without_board: tuple[str, ...]
    blurred: tuple[str, ...]
    size_px: tuple[int, int]
    pattern: str

    def __len__(self) -> int:
        """Number of all photos."""
        return len(self.views) + len(self.without_board) + len(self.blurred)

    def corners(self) -> intrinsics.FoundBoards:
        """The views as the solver takes them."""
        return replace(found_boards(self.views, self.size_px), num_photos=len(self))

    def tell_left_out(self, say: Callable[[str], None] = print) -> None:
        """List the excluded photos with the reasons."""
        for name in self.without_board:
            say(f"  no board in {name}: left out")
        for name in self.blurred:
            say(
                f"  {name} is blurred: left out; hold camera and board still, or give it more light"
            )


def parse_board(text: str) -> Board:
    """Parse a board (`BOARD_HELP`); raises InvalidInputError, or UnknownNameError of a kind."""
    kind, _, sizes = text.partition(":")
    if kind not in _SIZES:
        raise UnknownNameError("board", kind, list(_SIZES))
    matched = _SIZES[kind].fullmatch(sizes)
    if matched is None:
        raise InvalidInputError(f"board {text!r}: expected {BOARD_HELP}")
    columns, rows, square, unit, *marker = matched.groups()
    size = (int(columns), int(rows), float(square) * _METRES[unit])
    if not marker:
        return intrinsics.Chessboard(*size)
    dictionary = marker[2] or intrinsics.CharucoBoard.dictionary
    if dictionary not in intrinsics.DICTIONARIES:
        raise UnknownNameError("marker dictionary", dictionary, list(intrinsics.DICTIONARIES))
    return intrinsics.CharucoBoard(*size, float(marker[0]) * _METRES[marker[1]], dictionary)


def photo_paths(folder: Path) -> list[Path]:
    """The photos of a folder, sorted by name."""
    if not folder.is_dir():
        raise NotFoundError(f"{folder}: no such folder of photos")
    paths = (path for path in folder.iterdir() if not is_system_file(path.name))
    return sorted(path for path in paths if path.suffix.lower() in SUFFIXES)


def decode_photo(data: bytes, *, where: str) -> UInt8[np.ndarray, "h w"]:
    """Decode a photo to grey in its sensor's raster, to which K belongs: EXIF is ignored."""
    import cv2

    encoded = np.frombuffer(data, dtype=np.uint8)
    form = cv2.IMREAD_GRAYSCALE | cv2.IMREAD_IGNORE_ORIENTATION
    photo = cv2.imdecode(encoded, form) if data else None
    if photo is None:
        raise CorruptDataError(f"{where}: {len(data)} bytes are not an image")
    return np.asarray(photo, dtype=np.uint8)


def find_board(name: str, photo: np.ndarray, board: Board) -> BoardView | None:
    """Detect the board in a grey photo (uint8 [h, w]); None if not found."""
    found = intrinsics.find_boards([photo], board)
    if not found.photos:
        return None
    pixels = found.pixels_px[0]
    if isinstance(board, intrinsics.Chessboard):
        pixels = _dark_first(photo, pixels, board)
    width_px = intrinsics.edge_width_px(photo, found.points_board[0], pixels)
    is_blurred = width_px > intrinsics.max_edge_width_px(photo)
    return BoardView(name, found.points_board[0], pixels, found.pattern, is_blurred)


def read_photos(paths: Sequence[Path], board: Board) -> Photos:
    """Find the board in photos of one size; raises CorruptDataError or InvalidInputError."""
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
    return isinstance(board, intrinsics.Chessboard) and (board.columns - board.rows) % 2 == 0


def check_unambiguous(board: Board, text: str) -> None:
    """Refuse a board, described as `text`, that looks the same turned; raises InvalidInputError."""
    if is_ambiguous(board):
        raise InvalidInputError(
            f"board {text!r} looks the same after half a turn; use one with an odd and an "
            "even number of inner corners, or a ChArUco board"
        )


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


def _dark_first(photo: np.ndarray, pixels: np.ndarray, board: intrinsics.Chessboard) -> np.ndarray:
    """Order the corners to start beside a dark square, where that resolves the symmetry."""
    if is_ambiguous(board):
        return pixels
    grid = pixels.reshape(board.rows, board.columns, 2)
    ends = [grid[:2, :2].mean(axis=(0, 1)), grid[-2:, -2:].mean(axis=(0, 1))]
    first, last = (photo[round(float(y)), round(float(x))] for x, y in ends)
    return pixels if first < last else pixels[::-1].copy()


@dataclass(frozen=True)
class Coverage:
    """Coverage of a camera by views of a board.

    `views_by_region` are numbers of views in each ninth of the image, `tilts_rad` [n, 2] angles of
    the board's normal to the viewing ray (right, down), `focal_sigma` the sigma of the focal length
    as a share of it (infinity where there is none), `todo` advice, most important first.
    """

    views_by_region: Int64[np.ndarray, "3 3"]
    tilts_rad: Float64[np.ndarray, "n 2"]
    focal_sigma: float
    todo: tuple[str, ...]


def camera_coverage(
    views: Sequence[BoardView], size_px: tuple[int, int], lens: Lens | None = None
) -> Coverage:
    """Coverage of images of a size by the board, and what it gives; a lens of None is guessed."""
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
    focal_sigma, no_lens = _focal_sigma(views, size_px)
    if no_lens:
        todo = [no_lens]
    if not todo and focal_sigma > MAX_FOCAL_SIGMA:
        todo = [_surer(focal_sigma, tilts_rad)]
    return Coverage(by_region, tilts_rad, focal_sigma, tuple(todo))


def _focal_sigma(views: Sequence[BoardView], size_px: tuple[int, int]) -> tuple[float, str]:
    """Sigma of the focal length as a share of it, and why no camera of the model took the views."""
    try:
        return intrinsics.calibrate_found(found_boards(views, size_px)).focal_sigma, ""
    except intrinsics.LensModelError as error:
        return float("inf"), error.message
    except InvalidInputError:
        return float("inf"), ""


def _surer(focal_sigma: float, tilts_rad: np.ndarray) -> str:
    """Advice for the focal length: the tilt of which there are fewest views, near the camera."""
    counts = [(tilts_rad @ np.array(one) >= MIN_TILT_RAD).sum() for one in TILTS.values()]
    words = list(TILTS)[int(np.argmin(counts))]
    known = f"to {focal_sigma:.2%}" if np.isfinite(focal_sigma) else "too badly"
    return (
        f"tilt the board by 30 to 45 degrees with {words} to the camera, near enough to fill half "
        f"of the image: the focal length is known {known}, expected {MAX_FOCAL_SIGMA:.1%}"
    )


def found_boards(views: Sequence[BoardView], size_px: tuple[int, int]) -> intrinsics.FoundBoards:
    """Views as the solver takes them."""
    points = tuple(view.points_board for view in views)
    pixels = tuple(view.pixels for view in views)
    pattern = views[0].pattern if views else ""
    return intrinsics.FoundBoards(
        points, pixels, size_px, tuple(range(len(views))), len(views), pattern
    )


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
