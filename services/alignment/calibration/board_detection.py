"""Detection of chessboard and ChArUco corners in photos, for camera calibration."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float32

from dextouch.errors import InvalidInputError, ShapeError, UnknownNameError

MIN_CORNERS = 8
DICTIONARIES = ("DICT_4X4_50", "DICT_5X5_250", "DICT_6X6_250", "DICT_APRILTAG_36h11")
CHESSBOARD = "chessboard"
CHARUCO = "ChArUco"
LEGACY_CHARUCO = "ChArUco, legacy (as printed before OpenCV 4.6)"
EITHER_CHARUCO = "ChArUco, odd rows (legacy and current are the same)"


@dataclass(frozen=True)
class Chessboard:
    """A plain chessboard: `columns` × `rows` inner corners, squares of `square_m`."""

    columns: int
    rows: int
    square_m: float


@dataclass(frozen=True)
class CharucoBoard:
    """A ChArUco board: `columns` × `rows` squares, with markers of a dictionary in them."""

    columns: int
    rows: int
    square_m: float
    marker_m: float
    dictionary: str = "DICT_5X5_250"


@dataclass(frozen=True)
class FoundBoards:
    """Corners of one board on photos of one size.

    Attributes:
        points_board: a photo each, [k, 3] corners in board coordinates (m).
        pixels_px: a photo each, [k, 2] where they are.
        image_size_px: width, height.
        photos: indices of the photos on which the board was found.
        num_photos: number of processed photos.
        pattern: how the board is printed.
    """

    points_board: tuple[Float32[np.ndarray, "_ 3"], ...]
    pixels_px: tuple[Float32[np.ndarray, "_ 2"], ...]
    image_size_px: tuple[int, int]
    photos: tuple[int, ...]
    num_photos: int
    pattern: str

    def only(self, chosen: Sequence[int]) -> "FoundBoards":
        """A subset of the photos, by index into `photos`."""
        return FoundBoards(
            tuple(self.points_board[index] for index in chosen),
            tuple(self.pixels_px[index] for index in chosen),
            self.image_size_px,
            tuple(self.photos[index] for index in chosen),
            self.num_photos,
            self.pattern,
        )


View = tuple[Float32[np.ndarray, "_ 3"], Float32[np.ndarray, "_ 2"]]
Detector = Callable[[np.ndarray], View | None]


def find_boards(images: Sequence[np.ndarray], board: Chessboard | CharucoBoard) -> FoundBoards:
    """Detect a board in every photo; photos without it are skipped.

    Both ways in which ChArUco boards are printed are tried, and the one that fits is named.

    Args:
        images: uint8 [h, w] or [h, w, 3], all of one size.
        board: what is on the photos.

    Raises:
        ShapeError: no images, or of different sizes.
        InvalidInputError: the board is no board.
    """
    photos = [_grey(image, index) for index, image in enumerate(images)]
    if len({photo.shape for photo in photos}) != 1:
        shapes = sorted({photo.shape for photo in photos})
        raise ShapeError(f"photos: got sizes {shapes}, expected one size and at least one photo")
    detectors = (
        {CHESSBOARD: _chessboard(board)} if isinstance(board, Chessboard) else _charuco(board)
    )
    seen = {
        pattern: {index: view for index, p in enumerate(photos) if (view := detect(p)) is not None}
        for pattern, detect in detectors.items()
    }
    pattern = max(seen, key=lambda name: sum(len(pixels) for _, pixels in seen[name].values()))
    height, width = photos[0].shape
    return FoundBoards(
        tuple(points for points, _ in seen[pattern].values()),
        tuple(pixels for _, pixels in seen[pattern].values()),
        (width, height),
        tuple(seen[pattern]),
        len(photos),
        pattern,
    )


def _grey(image: np.ndarray, index: int) -> np.ndarray:
    image = np.asarray(image)
    if image.dtype != np.uint8 or image.ndim not in {2, 3} or image.shape[2:] not in {(), (3,)}:
        raise ShapeError(
            f"photo {index}: got {image.dtype} {image.shape}, expected uint8 [h, w] or [h, w, 3]"
        )
    return image if image.ndim == 2 else np.rint(image.mean(axis=2)).astype(np.uint8)


def _chessboard(board: Chessboard) -> Detector:
    import cv2

    if min(board.columns, board.rows) < 3 or board.square_m <= 0:
        raise InvalidInputError(f"board: got {board}, expected at least 3 by 3 inner corners")
    rows, columns = np.mgrid[: board.rows, : board.columns]
    flat = np.stack([columns, rows, np.zeros_like(rows)], axis=-1).reshape(-1, 3)
    points = (flat * board.square_m).astype(np.float32)

    def detect(photo: np.ndarray) -> View | None:
        ok, corners = cv2.findChessboardCorners(photo, (board.columns, board.rows))
        if not ok:
            return None
        # A window of less than half a square, or the next corner pulls.
        gap_px = np.linalg.norm(np.diff(corners.reshape(board.rows, -1, 2), axis=1), axis=-1).min()
        half_px = int(np.clip(0.35 * gap_px, 2, 11))
        stop = (cv2.TERM_CRITERIA_EPS + cv2.TERM_CRITERIA_MAX_ITER, 50, 1e-3)
        corners = cv2.cornerSubPix(photo, corners, (half_px, half_px), (-1, -1), stop)
        return points, np.asarray(corners, dtype=np.float32).reshape(-1, 2)

    return detect


def _charuco(board: CharucoBoard) -> dict[str, Detector]:
    """Detectors by marker layout, which OpenCV 4.6 changed."""
    import cv2

    if board.dictionary not in DICTIONARIES:
        raise UnknownNameError("marker dictionary", board.dictionary, list(DICTIONARIES))
    if min(board.columns, board.rows) < 3 or not 0 < board.marker_m < board.square_m:
        raise InvalidInputError(f"board: got {board}, expected markers smaller than squares")
    dictionary = cv2.aruco.getPredefinedDictionary(getattr(cv2.aruco, board.dictionary))

    def detector(*, legacy: bool) -> Detector:
        printed = cv2.aruco.CharucoBoard(
            (board.columns, board.rows), board.square_m, board.marker_m, dictionary
        )
        printed.setLegacyPattern(legacy)
        charuco = cv2.aruco.CharucoDetector(printed)
        places = np.asarray(printed.getChessboardCorners(), dtype=np.float32)

        def detect(photo: np.ndarray) -> View | None:
            corners, ids, _, _ = charuco.detectBoard(photo)
            if ids is None or len(ids) < MIN_CORNERS:
                return None
            return places[ids.ravel()], np.asarray(corners, dtype=np.float32).reshape(-1, 2)

        return detect

    if board.rows % 2:
        return {EITHER_CHARUCO: detector(legacy=False)}
    return {CHARUCO: detector(legacy=False), LEGACY_CHARUCO: detector(legacy=True)}
