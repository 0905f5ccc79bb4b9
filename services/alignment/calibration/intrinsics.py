"""Camera intrinsics from photos of a flat board: detected corners, blur, and calibration."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
from jaxtyping import Float32, Float64, UInt8

from dextouch.errors import InvalidInputError, ShapeError, UnknownNameError
from dextouch.geometry import Distortion
from services.alignment.calibration.motion import DegenerateMotionError

if TYPE_CHECKING:
    from services.alignment.calibration.lens_fit import LensFit

MIN_CORNERS = 8
DICTIONARIES = ("DICT_4X4_50", "DICT_5X5_250", "DICT_6X6_250", "DICT_APRILTAG_36h11")
CHESSBOARD = "chessboard"
CHARUCO = "ChArUco"
LEGACY_CHARUCO = "ChArUco, legacy (as printed before OpenCV 4.6)"
EITHER_CHARUCO = "ChArUco, odd rows (legacy and current are the same)"
MIN_VIEWS = 5
# Views from one direction alone cannot tell focal length from distance.
MIN_TILT_SPREAD_RAD = np.deg2rad(15.0)
MAX_FOCAL_SIGMA = 0.05
# Corners that turn between neighbours by more than this share of a square are not of the board: the
# detector took the rim of the print for one. Boards turned by 60 degrees at 0.3 m reach 0.2.
MAX_CORNER_SHIFT = 0.4
# Measured sides of markers are up to 3 % too small where blurred, and up to 15 % where a board
# fills a wide lens; corners move by more than 0.2 px where the entered size is off by a third.
MAX_MARKER_ERROR = 0.15
# Views with residuals above this multiple of the median (and this many pixels) have such corners,
# which move the focal length by more than its reported sigma: 0.5 % by one corner of 25 views.
MAX_RESIDUAL_RATIO, MIN_WRONG_PX = 3.0, 0.2
MAX_SHARE_LEFT_OUT = 0.2
# Photos whose corners differ by less than this share of the diagonal (RMS; 7 px of 1280 by 720)
# show one place: blur, light and the detector's errors are common to them. Their mean is exact to
# 0.02 px.
MAX_SAME_PLACE = 0.005
# A lens is none of the model's where structure over the image is more than noise, with this
# probability of a mistake, and this large (px RMS). What is smaller is part of the sigmas.
MAX_CHANCE = 1e-6
MIN_MISFIT_SHARE, MIN_MISFIT_PX = 0.5, 0.3
# Of the focal length, RMS from photo to photo, as of lenses that zoom or focus anew meanwhile; less
# is part of the sigmas. That of 13 photos of a real camera is 0.1 %.
MAX_FOCAL_SPREAD = 0.005
# The fisheye model is named where it leaves less than this of the residual.
FISHEYE_SHARE = 0.7
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


class LensModelError(InvalidInputError):
    """The camera is none that the model describes, or changed while it was photographed."""


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
    """Corners of one board on photos of one size (width, height).

    `points_board` are [k, 3] corners of each photo on the board (m), `pixels_px` [k, 2] where they
    are, `photos` the indices of those of `num_photos` that show the board, `pattern` says how it is
    printed.
    """

    points_board: tuple[Float32[np.ndarray, "_ 3"], ...]
    pixels_px: tuple[Float32[np.ndarray, "_ 2"], ...]
    image_size_px: tuple[int, int]
    photos: tuple[int, ...]
    num_photos: int
    pattern: str


@dataclass(frozen=True)
class CameraCalibration:
    """A pinhole camera (K in px) with distortion k1 k2 p1 p2 k3, and standard deviations.

    Attributes:
        sigma_fxfycxcy_px: standard deviations of fx fy cx cy: how good the calibration is.
        rms_px: of the residuals, both axes together; as small for 8 views as for 40.
        rms_by_place_px: the same by place of the board; a much larger one is of a blurred photo.
        board_bend_m: height of the board's bend, which is estimated where the corners show it.
        board_stretch: by how much the print is longer along its columns' axis (x) than along the
            other, as a share, likewise.
        coverage: share of a 4 × 4 grid over the image in which corners were seen.
        used_images: indices of the photos on which the board was found and fits the others.
    """

    K: Float64[np.ndarray, "3 3"]
    distortion: Distortion
    sigma_fxfycxcy_px: Float64[np.ndarray, "4"]
    sigma_distortion: Distortion
    rms_px: float
    rms_by_place_px: Float64[np.ndarray, " n"]
    board_bend_m: float
    board_stretch: float
    coverage: float
    used_images: tuple[int, ...]

    @property
    def focal_sigma(self) -> float:
        """Standard deviation of the focal length as a share of it, the larger of both axes."""
        return float((self.sigma_fxfycxcy_px[:2] / np.diag(self.K)[:2]).max())


class View(NamedTuple):
    """Corners on the board (m) and in a photo; side of its markers as a share of a square."""

    points_board: Float32[np.ndarray, "_ 3"]
    pixels_px: Float32[np.ndarray, "_ 2"]
    marker_ratio: float | None = None


Detector = Callable[[np.ndarray], View | None]


def find_boards(images: Sequence[np.ndarray], board: Chessboard | CharucoBoard) -> FoundBoards:
    """Detect a board in photos (uint8 [h, w] or [h, w, 3], all of one size); others are skipped.

    Both ways in which ChArUco boards are printed are tried, and the one that fits is named. Raises
    ShapeError: no images, or of different sizes; InvalidInputError: the board is no board, or its
    markers have another size.
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
    pattern = max(seen, key=lambda name: sum(len(view.pixels_px) for view in seen[name].values()))
    views = seen[pattern].values()
    if isinstance(board, CharucoBoard):
        _check_markers([v.marker_ratio for v in views if v.marker_ratio is not None], board)
    height, width = photos[0].shape
    return FoundBoards(
        tuple(view.points_board for view in views),
        tuple(view.pixels_px for view in views),
        (width, height),
        tuple(seen[pattern]),
        len(photos),
        pattern,
    )


def calibrate_camera(
    images: Sequence[np.ndarray], board: Chessboard | CharucoBoard
) -> CameraCalibration:
    """Intrinsics from photos, uint8 [h, w] or [h, w, 3], of one board in different tilts.

    Photos without the board are left out. Raises ShapeError: no images, or of different sizes;
    others as `calibrate_found`.
    """
    return calibrate_found(find_boards(images, board))


def calibrate_found(found: FoundBoards) -> CameraCalibration:
    """`calibrate_camera` for corners that were detected before.

    Photos of one place count once; places that do not fit the others are left out, at most a fifth.
    Raises InvalidInputError: the board is found in too few photos; DegenerateMotionError: the views
    do not show the focal length; LensModelError: another kind of lens, such as a fisheye, or it
    changed.
    """
    if len(found.photos) < MIN_VIEWS:
        raise InvalidInputError(
            f"photos: the board is found in {len(found.photos)} of {found.num_photos}, expected at "
            f"least {MIN_VIEWS}; check the board's size and kind, light and sharpness"
        )
    places = _places(found)
    if len(places) < MIN_VIEWS:
        raise DegenerateMotionError(
            f"intrinsics: {len(found.photos)} photos show the board in {len(places)} places, "
            f"expected at least {MIN_VIEWS}: take photos with the board tilted by 20 to 45 degrees "
            "about both its axes",
            num_places=len(places),
        )
    max_left_out = int(MAX_SHARE_LEFT_OUT * len(places))
    min_places = max(len(places) - max_left_out, MIN_VIEWS)
    fit = _fitted(places, found.image_size_px)
    while len(places) > min_places:
        worst = int(np.argmax(fit.rms_by_photo_px))
        limit_px = max(MAX_RESIDUAL_RATIO * float(np.median(fit.rms_by_photo_px)), MIN_WRONG_PX)
        if fit.rms_by_photo_px[worst] <= limit_px:
            break
        del places[worst]
        fit = _fitted(places, found.image_size_px)
    _check_lens(fit, places, found.image_size_px)
    result = _calibration(fit, places, found.image_size_px)
    spread_rad = float(np.arccos(np.clip(fit.normals @ fit.normals.T, -1, 1)).max())
    relative = result.focal_sigma
    if spread_rad < MIN_TILT_SPREAD_RAD or not relative <= MAX_FOCAL_SIGMA:
        raise DegenerateMotionError(
            f"intrinsics: the board's directions differ by {np.rad2deg(spread_rad):.0f} degrees "
            f"at most and the focal length is known to {relative:.1%}; expected at least "
            f"{np.rad2deg(MIN_TILT_SPREAD_RAD):.0f} degrees and {MAX_FOCAL_SIGMA:.0%}: take photos "
            "with the board tilted by 20 to 45 degrees about both its axes",
            spread_deg=float(np.rad2deg(spread_rad)),
            relative_sigma=relative,
        )
    return result


class _Place(NamedTuple):
    """Corners of the board in one place: the first photo's, averaged over photos of the same."""

    points_board: np.ndarray
    pixels_px: np.ndarray
    photos: tuple[int, ...]


def _places(found: FoundBoards) -> list[_Place]:
    """Photos by place: each belongs to the first before it that shows common corners nearby."""
    limit_px = MAX_SAME_PLACE * float(np.hypot(*found.image_size_px))
    groups: list[list[int]] = []
    for index in range(len(found.photos)):
        for group in groups:
            if _distance_px(found, group[0], index) < limit_px:
                group.append(index)
                break
        else:
            groups.append([index])
    places = []
    for group in groups:
        points = found.points_board[group[0]]
        same = [index for index in group if np.array_equal(found.points_board[index], points)]
        mean = np.mean([found.pixels_px[index] for index in same], axis=0)
        places.append(_Place(points, mean, tuple(found.photos[index] for index in group)))
    return places


def _distance_px(found: FoundBoards, first: int, second: int) -> float:
    """Distance between the corners that both photos show, RMS; infinite where these are few."""
    is_same = (found.points_board[first][:, None] == found.points_board[second]).all(axis=-1)
    rows, columns = np.nonzero(is_same)
    if len(rows) < MIN_CORNERS:
        return float("inf")
    distances_px = found.pixels_px[first][rows] - found.pixels_px[second][columns]
    return float(np.sqrt(np.square(distances_px).sum(axis=1).mean()))


def _fitted(places: list[_Place], size_px: tuple[int, int]) -> "LensFit":
    # Here, since commands that measure nothing import this module on stations without OpenCV.
    from services.alignment.calibration.lens_fit import fit_lens

    points, pixels, _ = zip(*places, strict=True)
    return fit_lens(points, pixels, size_px)


def _check_lens(fit: "LensFit", places: list[_Place], size_px: tuple[int, int]) -> None:
    from services.alignment.calibration.lens_fit import MAX_NAMED_BEND, fisheye_rms_px, fit_lens

    problem = _problem(fit)
    if not problem:
        return
    points, pixels, _ = zip(*places, strict=True)
    fisheye_px = fisheye_rms_px(points, pixels, size_px)
    bent = fit_lens(points, pixels, size_px, max_bend=MAX_NAMED_BEND)
    if fisheye_px < FISHEYE_SHARE * fit.rms_px:
        problem = (
            "the camera is no pinhole with distortion k1 k2 p1 p2 k3: an equidistant (fisheye) "
            f"lens fits with {fisheye_px:.2f} px RMS, the pinhole model with {fit.rms_px:.2f} px; "
            "use a lens of less than 100 degrees, or undistort the images to a pinhole camera with "
            "cv2.fisheye before recording"
        )
    elif bent.rms_px < FISHEYE_SHARE * fit.rms_px:
        problem = (
            f"the board is bent by {bent.board_bend_m * 1e3:.1f} mm, which leaves "
            f"{bent.rms_px:.2f} px RMS instead of {fit.rms_px:.2f}; glue it to a flat plate, and "
            "take all photos anew"
        )
    raise LensModelError(
        f"intrinsics: {problem}",
        rms_px=fit.rms_px,
        fisheye_rms_px=fisheye_px,
    )


def _problem(fit: "LensFit") -> str:
    """Why no camera of the model took the photos, or different ones did; else empty."""
    is_off = fit.image.p_value < MAX_CHANCE and fit.image_share > MIN_MISFIT_SHARE
    if is_off and fit.misfit_px > MIN_MISFIT_PX:
        return (
            "the camera is no pinhole with distortion k1 k2 p1 p2 k3: residuals follow the place "
            f"in the image by {fit.misfit_px:.2f} px of {fit.rms_px:.2f} px RMS; check that the "
            "lens is no fisheye, the photos are whole images of one camera, without stabilisation, "
            "and all of one board"
        )
    if fit.focal_p < MAX_CHANCE and fit.focal_spread > MAX_FOCAL_SPREAD:
        return (
            f"the focal length seems to differ by {fit.focal_spread:.1%} RMS from photo to photo; "
            "switch autofocus, zoom and stabilisation off, hold camera and board still (rolling "
            "shutters distort what moves), check that all photos are of one camera, and take them "
            "anew"
        )
    return ""


def _calibration(
    fit: "LensFit", places: list[_Place], size_px: tuple[int, int]
) -> CameraCalibration:
    cells = np.concatenate([place.pixels_px for place in places]) / np.array(size_px) * 4
    sigma = np.sqrt(np.diag(fit.covariance))
    return CameraCalibration(
        K=fit.K,
        distortion=fit.distortion,
        sigma_fxfycxcy_px=sigma[:4],
        sigma_distortion=sigma[4:],
        rms_px=fit.rms_px,
        rms_by_place_px=fit.rms_by_photo_px,
        board_bend_m=fit.board_bend_m,
        board_stretch=fit.board_stretch,
        coverage=len(np.unique(cells.astype(int).clip(0, 3), axis=0)) / 16,
        used_images=tuple(sorted(photo for place in places for photo in place.photos)),
    )


def max_edge_width_px(photo: np.ndarray) -> float:
    """Edge width above which a photo of this size counts as blurred."""
    return MAX_EDGE_WIDTH_PX * max(1.0, float(np.hypot(*photo.shape)) / USUAL_DIAGONAL_PX)


def edge_width_px(
    photo: UInt8[np.ndarray, "h w"], points_board: np.ndarray, pixels: np.ndarray
) -> float:
    """Width over which edges of squares rise: 2.5 sigma of the blur; infinity without neighbours.

    Corners [n, 3] of a regular grid (m) are seen at [n, 2] pixels (middle of the first pixel 0, 0);
    the wider of the medians along the board's two axes counts.
    """
    grid = np.asarray(points_board, dtype=np.float64)[:, :2]
    separation_m = grid[None] - grid[:, None]
    length = np.linalg.norm(separation_m, axis=-1)
    square_m = length[length > 0].min()
    ends = np.asarray(pixels, dtype=np.float64)
    widths = []
    for step_m in square_m * np.eye(2):
        first, second = np.nonzero(np.abs(separation_m - step_m).max(axis=-1) < 0.01 * square_m)
        if len(first):
            widths.append(np.median(_widths_px(photo, ends[first], ends[second])))
    return float(max(widths, default=np.inf))


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
        pixels = np.asarray(corners, dtype=np.float32).reshape(-1, 2)
        return View(points, pixels) if _is_regular(pixels.reshape(*rows.shape, 2)) else None

    return detect


def _is_regular(grid: Float32[np.ndarray, "rows columns 2"]) -> bool:
    """Whether all corners lie about midway between their neighbours, or go on as these do."""
    for lines in (grid, grid.swapaxes(0, 1)):
        steps = np.diff(lines, axis=0)
        lengths = np.linalg.norm(steps, axis=-1)
        turns = np.linalg.norm(np.diff(steps, axis=0), axis=-1)
        if (turns > MAX_CORNER_SHIFT * np.minimum(lengths[1:], lengths[:-1])).any():
            return False
    return True


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
            corners, ids, markers, _ = charuco.detectBoard(photo)
            if ids is None or len(ids) < MIN_CORNERS:
                return None
            points = places[ids.ravel()]
            pixels = np.asarray(corners, dtype=np.float32).reshape(-1, 2)
            outlines = np.asarray(markers, dtype=np.float32).reshape(-1, 4, 2)
            return View(points, pixels, _marker_ratio(points / board.square_m, pixels, outlines))

        return detect

    if board.rows % 2:
        return {EITHER_CHARUCO: detector(legacy=False)}
    return {CHARUCO: detector(legacy=False), LEGACY_CHARUCO: detector(legacy=True)}


def _marker_ratio(
    places: np.ndarray, pixels: np.ndarray, outlines_px: Float32[np.ndarray, "markers 4 2"]
) -> float | None:
    """Side of the median marker, in squares; None if the corners (in squares) are in a line."""
    import cv2

    if np.ptp(places[:, :2], axis=0).min() == 0 or not len(outlines_px):
        return None
    to_board, _ = cv2.findHomography(pixels, places[:, :2])
    outlines = cv2.perspectiveTransform(outlines_px.reshape(1, -1, 2), to_board)
    sides_px, sides = (
        np.sqrt([cv2.contourArea(np.asarray(one, dtype=np.float32)) for one in each])
        for each in (outlines_px, outlines.reshape(-1, 4, 2))
    )
    # Outlines go through the middles of the outermost dark pixels, half a pixel inside.
    return float(np.median(sides * (1 + 1 / sides_px)))


def _check_markers(ratios: Sequence[float], board: CharucoBoard) -> None:
    """Refuse markers of another size than entered: they pull the corners between them."""
    entered, measured = board.marker_m / board.square_m, float(np.median(ratios or [0.0]))
    if ratios and abs(measured / entered - 1) > MAX_MARKER_ERROR:
        raise InvalidInputError(
            f"board: its markers measure {measured:.2f} of a square, got {board.marker_m * 1e3:g} "
            f"mm for squares of {board.square_m * 1e3:g} mm ({entered:.2f}), expected within "
            f"{MAX_MARKER_ERROR:.0%}: measure both on the print; markers of "
            f"{measured * board.square_m * 1e3:.1f} mm would fit these squares",
            marker_ratio=measured,
        )


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
