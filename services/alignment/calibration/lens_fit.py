"""Pinhole camera with distortion fitted to corners of a board that may be bent or stretched.

Residuals of such a board follow the place on it, and its shape is estimated, too (as Strobl and
Hirzinger 2011); of another lens model the place in the image; of a lens that changes, or a moving
camera, they are common to a photo.
"""

from collections.abc import Sequence
from typing import NamedTuple

import cv2
import numpy as np
from jaxtyping import Float64
from numpy.polynomial import chebyshev
from scipy.special import chdtrc, fdtrc

from dextouch.errors import InvalidInputError
from dextouch.geometry import NUM_DISTORTION, Distortion
from dextouch.geometry.rotations import rotation_from_vector, vector_from_rotation
from services.alignment.calibration.motion import MIN_INDEPENDENCE, Structure, structure

# Radial functions show an equidistant lens, of which k1 k2 k3 leave waves along the radius.
# fx fy cx cy and the distortion.
NUM_LENS = 4 + NUM_DISTORTION
NUM_RADIAL = 10
# Others show what is not round: a tilted sensor, or a part of the image cut out.
MAX_DEGREE = 3
# A shape is estimated where chance would rarely show so much; else its sigma is for nothing.
MAX_SHAPE_P = 1e-3
SHAPE_ROUNDS = 4
# Of `_shapes`: three of a bend, two of a stretch.
NUM_SHAPES = 5
# A bend of half the board's length: 3 mm of 15 cm. No board that is used is bent more; lenses that
# are none of the model's seem to bend it.
MAX_BEND = 0.02
# Of lengths along the two axes of a print; no printer errs by more.
MAX_STRETCH = 0.1
# To name the cause, bends of more are fitted: 15 mm of 15 cm.
MAX_NAMED_BEND = 0.1
# Field of view from which the fisheye model is fitted; lenses of 90 to 150 degrees converge.
FISHEYE_GUESS_RAD = np.deg2rad(140.0)
# Share of the width at which the focal length starts. From OpenCV's closed form its steps go astray
# in some sets of small boards, by 29 % of the focal length in one of ten.
USUAL_FOCAL = 0.94
STOP = (cv2.TERM_CRITERIA_COUNT + cv2.TERM_CRITERIA_EPS, 100, 1e-12)
# What differs between photos at random is part of the sigmas where chance would rarely show it.
MAX_PHOTO_P = 0.01


class LensFit(NamedTuple):
    """Least squares, and what its residuals show.

    Attributes:
        covariance: of fx fy cx cy k1 k2 p1 p2 k3, for errors as large as those along smooth
            functions of image, board and time, if larger than between neighbouring corners.
        board_bend_m: largest distance of a corner from a plane.
        board_stretch: length along the columns' axis over that along the rows', less one.
        image: structure over the image.
        misfit_px: RMS of the residuals that `image` explains, both axes together.
        image_share: of the squares of all residuals that it explains.
        focal_spread: RMS change of the focal length from photo to photo beyond noise, as a share of
            it; chance shows so much with the probability `focal_p`.
    """

    K: Float64[np.ndarray, "3 3"]
    distortion: Distortion
    covariance: Float64[np.ndarray, "lens lens"]
    normals: Float64[np.ndarray, "n 3"]
    board_bend_m: float
    board_stretch: float
    image: Structure
    misfit_px: float
    image_share: float
    focal_p: float
    focal_spread: float
    rms_px: float
    rms_by_photo_px: Float64[np.ndarray, " n"]


class _Design(NamedTuple):
    """Residuals (px) and how they depend on unknowns, without what the board's poses explain."""

    residuals: np.ndarray
    lens: np.ndarray
    shape: np.ndarray
    image: np.ndarray


class _Camera(NamedTuple):
    K: np.ndarray
    distortion: np.ndarray
    turns: Sequence[np.ndarray]
    shifts: Sequence[np.ndarray]
    by_photo_px: np.ndarray


def fit_lens(
    points_board: Sequence[np.ndarray],
    pixels: Sequence[np.ndarray],
    size_px: tuple[int, int],
    *,
    max_bend: float = MAX_BEND,
) -> LensFit:
    """Fit a camera to corners [k, 3] (m) of a flat board and where photos show them [k, 2] (px).

    The points are one board's, in the same coordinates in all photos. Raises InvalidInputError: no
    camera shows the corners so.
    """
    points = [np.asarray(one, dtype=np.float64) for one in points_board]
    pixels = [np.asarray(one, dtype=np.float64) for one in pixels]
    everywhere = np.concatenate(points)
    middle = everywhere.mean(axis=0)
    radius_m = float(np.linalg.norm(everywhere - middle, axis=1).max())
    shapes = [_shapes(one - middle, radius_m) for one in points]
    camera = _calibrated(points, pixels, size_px, None)
    design = _design(points, pixels, shapes, camera, size_px)
    found = np.zeros(NUM_SHAPES)
    limit = radius_m * np.array([max_bend] * 3 + [MAX_STRETCH] * 2)
    flat = structure(design.residuals, design.lens, design.shape, num_others=6 * len(points))
    for _ in range(SHAPE_ROUNDS if flat.p_value < MAX_SHAPE_P else 0):
        step = structure(design.residuals, design.lens, design.shape).coefficients
        if (np.abs(found + step) > limit).any():
            break
        found += step
        shaped = [one + by @ found for one, by in zip(points, shapes, strict=True)]
        camera = _calibrated(shaped, pixels, size_px, camera)
        design = _design(shaped, pixels, shapes, camera, size_px)
    fit = _with_statistics(
        camera, design, [len(one) for one in points], is_shaped=bool(found.any())
    )
    bend_m = float(np.ptp(np.concatenate(shapes)[:, 2] @ found))
    return fit._replace(board_bend_m=bend_m, board_stretch=float(found[3] / radius_m))


def _with_statistics(
    camera: _Camera, design: _Design, num_corners: list[int], *, is_shaped: bool
) -> LensFit:
    residuals, num_others = design.residuals, 6 * len(num_corners)
    with_shape = np.column_stack([design.lens, design.shape])
    fitted = with_shape if is_shaped else design.lens
    # With what the solver did not reach, as it does not for lenses far from the model.
    whole = np.column_stack([with_shape, design.image])
    image = structure(residuals, whole[:, :0], whole, num_others=num_others)
    smooth = np.column_stack([design.shape, design.image])
    found = structure(residuals, fitted, smooth, num_others=num_others)
    freedom = len(residuals) - num_others - fitted.shape[1]
    # Beside what the image explains: a lens of another model is no lens that changes.
    beside = np.column_stack([fitted, design.image])
    zoom = design.lens[:, :2] @ np.diag(camera.K)[:2]
    focal_p, focal_spread = _by_photo(residuals, beside, zoom, num_corners)
    variance = max(found.ratio * found.rest, float(residuals @ residuals) / freedom)
    scale = 1 / np.linalg.norm(fitted, axis=0)
    shares = np.linalg.pinv((fitted * scale).T @ (fitted * scale), hermitian=True)
    covariance = variance * np.outer(scale, scale) * shares
    excess = _excess_by_photo(residuals, fitted * scale, num_corners, variance * np.diag(shares))
    covariance = (covariance * np.sqrt(np.outer(excess, excess)))[:NUM_LENS, :NUM_LENS]
    if focal_p < MAX_PHOTO_P:
        # That of the next image differs as those of the photos do.
        focal_px = np.diag(camera.K)[:2]
        covariance[:2, :2] += focal_spread**2 * np.outer(focal_px, focal_px)
    squares = max(float(np.square(camera.by_photo_px) @ num_corners), np.finfo(float).tiny)
    noise = image.rest * freedom
    turns = np.array(camera.turns, dtype=np.float64).reshape(-1, 3)
    return LensFit(
        K=camera.K,
        distortion=camera.distortion,
        covariance=covariance,
        normals=rotation_from_vector(turns)[:, :, 2],
        board_bend_m=0.0,
        board_stretch=0.0,
        image=image,
        misfit_px=float(np.sqrt(max(squares - noise, 0.0) / sum(num_corners))),
        image_share=max(1 - noise / squares, 0.0),
        focal_p=focal_p,
        focal_spread=focal_spread,
        rms_px=float(np.sqrt(squares / sum(num_corners))),
        rms_by_photo_px=camera.by_photo_px,
    )


def _by_photo(
    residuals: np.ndarray, fitted: np.ndarray, function: np.ndarray, num_corners: list[int]
) -> tuple[float, float]:
    """Probability and RMS, beyond noise, of coefficients of a function for each photo by itself.

    All are without what the poses explain. Functions of photos share with the fitted ones as many
    degrees of freedom as the trace says.
    """
    U, s, _ = np.linalg.svd(fitted / np.linalg.norm(fitted, axis=0), full_matrices=False)
    L = U[:, s > MIN_INDEPENDENCE]
    left = residuals - L @ (L.T @ residuals)
    starts = np.r_[0, np.cumsum(2 * np.array(num_corners))[:-1]]
    squares = np.maximum(np.add.reduceat(function**2, starts), np.finfo(float).tiny)
    along = np.square(np.add.reduceat(function * left, starts)) / squares
    shared = np.square(np.add.reduceat(function[:, None] * L, starts)).sum(axis=1) / squares
    num, explained = len(starts) - float(shared.sum()), float(along.sum())
    freedom = max(len(left) - 6 * len(starts) - L.shape[1] - num, 1.0)
    rest = max(float(left @ left) - explained, np.finfo(float).tiny) / freedom
    p_value = fdtrc(max(num, 1.0), freedom, explained / max(num, 1.0) / rest)
    return float(p_value), float(np.sqrt(max(explained - num * rest, 0.0) / squares.sum()))


def _excess_by_photo(
    residuals: np.ndarray, fitted: np.ndarray, num_corners: list[int], variances: np.ndarray
) -> Float64[np.ndarray, " unknowns"]:
    """By how much variances exceed given ones, from what leaving each photo out changes.

    Errors that are common to a photo, of whatever kind, show in this jackknife (Efron 1982); it is
    only used where chance would rarely show so much.
    """
    ends = np.cumsum(2 * np.array(num_corners))[:-1]
    whole = fitted.T @ fitted
    changes = []
    for r, J in zip(np.split(residuals, ends), np.split(fitted, ends), strict=True):
        changes.append(np.linalg.pinv(whole - J.T @ J, hermitian=True) @ (J.T @ r))
    freedom = len(num_corners) - 1
    change = np.array(changes) - np.mean(changes, axis=0)
    ratio = np.square(change).sum(axis=0) * freedom / (freedom + 1) / variances
    return np.where(chdtrc(freedom, ratio * freedom) < MAX_PHOTO_P, ratio, 1.0)


def known_lens_misfit(
    views: tuple[Sequence[np.ndarray], Sequence[np.ndarray]],
    K: np.ndarray,
    distortion: np.ndarray,
    Ts_camera_board: np.ndarray,
) -> tuple[Structure, Structure]:
    """What another lens, and what another shape of the board, explains of residuals (px²).

    Views are corners on the board [k, 3] (m) and in images [k, 2] (px), the board's poses [n, 4, 4]
    those of the least residuals. Coefficients begin with the changes of fx and fy.
    """
    points, pixels = (list(series) for series in views)
    turns = list(vector_from_rotation(Ts_camera_board[:, :3, :3]))
    camera = _Camera(K, distortion, turns, list(Ts_camera_board[:, :3, 3]), np.zeros(0))
    shapes = [_shapes(one - points[0].mean(axis=0), float(np.ptp(points[0]))) for one in points]
    size_px = (max(round(2 * K[0, 2]), 1), max(round(2 * K[1, 2]), 1))
    design = _design(points, pixels, shapes, camera, size_px)
    lens, board = (
        structure(design.residuals, functions[:, :0], functions, num_others=6 * len(points))
        for functions in (design.lens, design.shape)
    )
    return lens, board


def fisheye_rms_px(
    points_board: Sequence[np.ndarray], pixels: Sequence[np.ndarray], size_px: tuple[int, int]
) -> float:
    """Residual of OpenCV's equidistant (fisheye) model; infinity where it does not converge."""
    focal_px = size_px[0] / FISHEYE_GUESS_RAD
    guess = np.array([[focal_px, 0, 0.5 * size_px[0]], [0, focal_px, 0.5 * size_px[1]], [0, 0, 1]])
    flags = (
        cv2.fisheye.CALIB_RECOMPUTE_EXTRINSIC
        | cv2.fisheye.CALIB_FIX_SKEW
        | cv2.fisheye.CALIB_USE_INTRINSIC_GUESS
    )
    boards, seen = (
        [np.asarray(one, dtype=np.float64)[None] for one in series]
        for series in (points_board, pixels)
    )
    try:
        rms_px, *_ = cv2.fisheye.calibrate(boards, seen, size_px, guess, np.zeros(4), flags=flags)
    except cv2.error:
        return float("inf")
    return float(rms_px)


def _calibrated(
    points: list[np.ndarray],
    pixels: list[np.ndarray],
    size_px: tuple[int, int],
    start: _Camera | None,
) -> _Camera:
    focal_px, middle = USUAL_FOCAL * size_px[0], 0.5 * (np.array(size_px) - 1)
    usual = np.array([[focal_px, 0, middle[0]], [0, focal_px, middle[1]], [0, 0, 1]])
    K, distortion = (usual, np.zeros(NUM_DISTORTION)) if start is None else start[:2]
    flags = cv2.CALIB_USE_INTRINSIC_GUESS
    boards, seen = ([one.astype(np.float32) for one in series] for series in (points, pixels))
    try:
        _, K, distortion, turns, shifts, _, _, by_photo = cv2.calibrateCameraExtended(
            boards, seen, size_px, K.copy(), distortion.copy(), flags=flags, criteria=STOP
        )
    except cv2.error as error:
        raise InvalidInputError(
            f"intrinsics: the corners of {len(points)} photos give no camera ({error.err}); check "
            "that all photos are of one camera, and the size and kind of the board"
        ) from error
    K, distortion = (np.asarray(values, dtype=np.float64) for values in (K, distortion))
    return _Camera(
        K,
        distortion.ravel()[:NUM_DISTORTION],
        turns,
        shifts,
        np.asarray(by_photo, dtype=np.float64).ravel(),
    )


def _shapes(flat_m: np.ndarray, radius_m: float) -> np.ndarray:
    """Shapes that no plane explains, [k, 3, 5] for corners [k, 3]: a bent sheet, and a stretch.

    All are of size one at the radius; the last two keep the board's size, in its plane.
    """
    x, y = flat_m[:, 0] / radius_m, flat_m[:, 1] / radius_m
    shapes = np.zeros((len(flat_m), 3, NUM_SHAPES))
    shapes[:, 2, :3] = np.column_stack([x * x, x * y, y * y])
    shapes[:, :2, 3] = 0.5 * np.column_stack([x, -y])
    shapes[:, :2, 4] = 0.5 * np.column_stack([y, x])
    return shapes


def _design(
    points: list[np.ndarray],
    pixels: list[np.ndarray],
    shapes: list[np.ndarray],
    camera: _Camera,
    size_px: tuple[int, int],
) -> _Design:
    rows = []
    middle, half_px = camera.K[:2, 2], 0.5 * float(np.hypot(*size_px))
    poses = zip(camera.turns, camera.shifts, strict=True)
    for one, seen, shape, (turn, shift) in zip(points, pixels, shapes, poses, strict=True):
        predicted, J = cv2.projectPoints(one, turn, shift, camera.K, camera.distortion)
        predicted, J = predicted.reshape(-1, 2), np.asarray(J)
        R = rotation_from_vector(np.asarray(turn).reshape(1, 3))[0]
        by_shape = (J[:, 3:6] @ R).reshape(-1, 2, 3) @ shape
        lens = J[:, 6 : 6 + NUM_LENS]
        columns = np.column_stack(
            [
                (seen - predicted).ravel(),
                lens,
                by_shape.reshape(len(J), -1),
                _fields((predicted - middle) / half_px),
            ]
        )
        Q, _ = np.linalg.qr(J[:, :6])
        rows.append(columns - Q @ (Q.T @ columns))
    stacked = np.concatenate(rows)
    ends = [1, 1 + NUM_LENS, 1 + NUM_LENS + NUM_SHAPES]
    residuals, *others = np.split(stacked, ends, axis=1)
    return _Design(residuals[:, 0], *others)


def _fields(places: np.ndarray) -> np.ndarray:
    """Smooth vector fields over an image at places [k, 2] (about -1 … 1), as columns [2 k, m]."""
    radius = np.linalg.norm(places, axis=1, keepdims=True)
    outward = places / np.maximum(radius, np.finfo(float).tiny)
    inside = np.clip(places, -1, 1)
    waves = chebyshev.chebvander(2 * np.clip(radius[:, 0], 0, 1) - 1, NUM_RADIAL - 1)
    radial = (outward[:, :, None] * waves[:, None]).reshape(2 * len(places), -1)
    products = chebyshev.chebvander2d(inside[:, 0], inside[:, 1], [MAX_DEGREE, MAX_DEGREE])
    i, j = np.indices((MAX_DEGREE + 1, MAX_DEGREE + 1))
    products = products[:, (i + j <= MAX_DEGREE).ravel()]
    both = np.einsum("km,ab->kamb", products, np.eye(2)).reshape(2 * len(places), -1)
    return np.column_stack([radial, both])
