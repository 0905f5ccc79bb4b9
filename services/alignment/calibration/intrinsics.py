"""Photos of a flat board in, a camera's matrix and distortion with standard deviations out."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from jaxtyping import Float32, Float64

from dextouch.errors import InvalidInputError, ShapeError, UnknownNameError
from dextouch.geometry.rotations import rotation_from_vector
from services.alignment.calibration.hand_eye import DegenerateMotionError

MIN_VIEWS = 5
MIN_CORNERS = 8
# Views from one direction alone cannot tell focal length from distance.
MIN_TILT_SPREAD_RAD = np.deg2rad(15.0)
MAX_FOCAL_SIGMA = 0.05
DICTIONARIES = ("DICT_4X4_50", "DICT_5X5_250", "DICT_6X6_250", "DICT_APRILTAG_36h11")


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
class CameraCalibration:
    """A pinhole camera with distortion k1 k2 p1 p2 k3.

    `sigma_*` are standard deviations of fx fy cx cy and of the distortion; they tell how good the
    calibration is. `rms_px` does not: it is as small for 8 views as for 40. `coverage` is the part
    of a 4 × 4 grid over the image in which corners were seen.
    """

    K: Float64[np.ndarray, "3 3"]
    distortion: Float64[np.ndarray, "5"]
    sigma_fxfycxcy_px: Float64[np.ndarray, "4"]
    sigma_distortion: Float64[np.ndarray, "5"]
    rms_px: float
    coverage: float
    image_size_px: tuple[int, int]
    used_images: tuple[int, ...]


def calibrate_camera(
    images: Sequence[np.ndarray], board: Chessboard | CharucoBoard
) -> CameraCalibration:
    """Intrinsics from photos of one board in different tilts and places.

    Args:
        images: uint8 [h, w] or [h, w, 3], all of one size; photos without the board are left out.
        board: what is on the photos.

    Raises:
        InvalidInputError: the board is found in too few photos, or the board is no board.
        DegenerateMotionError: the views do not show the focal length; tilt the board.
        ShapeError: no images, or of different sizes.
    """
    import cv2

    photos = [_grey(image, index) for index, image in enumerate(images)]
    if len({photo.shape for photo in photos}) != 1:
        shapes = sorted({photo.shape for photo in photos})
        raise ShapeError(f"photos: got sizes {shapes}, expected one size and at least one photo")
    detect = (
        _chessboard_detector(board) if isinstance(board, Chessboard) else _charuco(board, photos)
    )
    found = {index: corners for index, p in enumerate(photos) if (corners := detect(p)) is not None}
    if len(found) < MIN_VIEWS:
        raise InvalidInputError(
            f"photos: the board is found in {len(found)} of {len(photos)}, expected at least "
            f"{MIN_VIEWS}; check the board's size and kind ({board}), light and sharpness"
        )
    height, width = photos[0].shape
    rms_px, K, distortion, turns, _, sigma, *_ = cv2.calibrateCameraExtended(
        [points for points, _ in found.values()],
        [pixels for _, pixels in found.values()],
        (width, height),
        np.eye(3),
        np.zeros(5),
    )
    sigma = np.asarray(sigma, dtype=np.float64).ravel()
    _check_views(np.array(turns, dtype=np.float64).reshape(-1, 3), np.asarray(K), sigma)
    return CameraCalibration(
        K=np.asarray(K, dtype=np.float64),
        distortion=np.asarray(distortion, dtype=np.float64).ravel()[:5],
        sigma_fxfycxcy_px=sigma[:4],
        sigma_distortion=sigma[4:9],
        rms_px=float(rms_px),
        coverage=_coverage([pixels for _, pixels in found.values()], width, height),
        image_size_px=(width, height),
        used_images=tuple(found),
    )


View = tuple[Float32[np.ndarray, "n 3"], Float32[np.ndarray, "n 2"]]


def _grey(image: np.ndarray, index: int) -> np.ndarray:
    image = np.asarray(image)
    if image.dtype != np.uint8 or image.ndim not in {2, 3} or image.shape[2:] not in {(), (3,)}:
        raise ShapeError(
            f"photo {index}: got {image.dtype} {image.shape}, expected uint8 [h, w] or [h, w, 3]"
        )
    return image if image.ndim == 2 else np.rint(image.mean(axis=2)).astype(np.uint8)


def _chessboard_detector(board: Chessboard) -> Any:  # noqa: ANN401 - a function of one image
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


def _charuco(board: CharucoBoard, photos: Sequence[np.ndarray]) -> Any:  # noqa: ANN401 - likewise
    """A detector for the board's printing; boards printed before OpenCV 4.6 start otherwise."""
    import cv2

    if board.dictionary not in DICTIONARIES:
        raise UnknownNameError("marker dictionary", board.dictionary, list(DICTIONARIES))
    if min(board.columns, board.rows) < 3 or not 0 < board.marker_m < board.square_m:
        raise InvalidInputError(f"board: got {board}, expected markers smaller than squares")
    dictionary = cv2.aruco.getPredefinedDictionary(getattr(cv2.aruco, board.dictionary))
    detectors = []
    for legacy in (False, True):
        printed = cv2.aruco.CharucoBoard(
            (board.columns, board.rows), board.square_m, board.marker_m, dictionary
        )
        printed.setLegacyPattern(legacy)
        detectors.append(_charuco_detector(printed))
    seen = [sum(detect(photo) is not None for photo in photos) for detect in detectors]
    return detectors[int(np.argmax(seen))]


def _charuco_detector(printed: Any) -> Any:  # noqa: ANN401 - OpenCV's board, a function
    import cv2

    detector = cv2.aruco.CharucoDetector(printed)
    places = np.asarray(printed.getChessboardCorners(), dtype=np.float32)

    def detect(photo: np.ndarray) -> View | None:
        corners, ids, _, _ = detector.detectBoard(photo)
        if ids is None or len(ids) < MIN_CORNERS:
            return None
        return places[ids.ravel()], np.asarray(corners, dtype=np.float32).reshape(-1, 2)

    return detect


def _check_views(turns_rad: np.ndarray, K: np.ndarray, sigma: np.ndarray) -> None:
    """Refuse views that do not show the focal length; `turns_rad` are the board's rotations."""
    normals = rotation_from_vector(turns_rad)[:, :, 2]
    spread_rad = float(np.arccos(np.clip(normals @ normals.T, -1, 1)).max())
    relative = float(max(sigma[0] / K[0, 0], sigma[1] / K[1, 1]))
    if spread_rad < MIN_TILT_SPREAD_RAD or not relative <= MAX_FOCAL_SIGMA:
        raise DegenerateMotionError(
            f"intrinsics: the board's directions differ by {np.rad2deg(spread_rad):.0f} degrees "
            f"at most and the focal length is known to {relative:.1%}; expected at least "
            f"{np.rad2deg(MIN_TILT_SPREAD_RAD):.0f} degrees and {MAX_FOCAL_SIGMA:.0%}: take photos "
            "with the board tilted by 20 to 45 degrees about both its axes",
            spread_deg=float(np.rad2deg(spread_rad)),
            relative_sigma=relative,
        )


def _coverage(pixels: Sequence[np.ndarray], width: int, height: int) -> float:
    cells = (np.concatenate(list(pixels)) / np.array([width, height]) * 4).astype(int).clip(0, 3)
    return len({(int(x), int(y)) for x, y in cells}) / 16
