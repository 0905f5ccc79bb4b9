"""Pinhole camera with distortion fitted to corners of a board that may be slightly bent.

Residuals of a bent board follow the place on it, and the bend is estimated, too (as Strobl and
Hirzinger 2011); of another lens model the place in the image, of a changed lens the order of
photos.
"""

from collections.abc import Sequence
from typing import NamedTuple

import cv2
import numpy as np
from jaxtyping import Float64
from numpy.polynomial import chebyshev

from dextouch.errors import InvalidInputError
from dextouch.geometry import NUM_DISTORTION, Distortion
from dextouch.geometry.rotations import rotation_from_vector
from services.alignment.calibration.motion import Structure, structure

# Radial functions show an equidistant lens, of which k1 k2 k3 leave waves along the radius.
# fx fy cx cy and the distortion.
NUM_LENS = 4 + NUM_DISTORTION
NUM_RADIAL = 10
# Others show what is not round: a tilted sensor, or a part of the image cut out.
MAX_DEGREE = 3
# A bend is estimated where chance would rarely show so much; else its sigma is for nothing.
MAX_BEND_P = 1e-3
BEND_ROUNDS = 4
# Of half the board's length: 3 mm of 15 cm. No board that is used is bent more; lenses that are
# none of the model's seem to bend it.
MAX_BEND = 0.02
# Field of view from which the fisheye model is fitted; lenses of 90 to 150 degrees converge.
FISHEYE_GUESS_RAD = np.deg2rad(140.0)
# Focal lengths, principal point and k1 that change along the photos.
NUM_DRIFTING = 5


class LensFit(NamedTuple):
    """Least squares, and what its residuals show.

    Attributes:
        covariance: of fx fy cx cy k1 k2 p1 p2 k3, for errors as large as those along smooth
            functions of image, board and time, if larger than between neighbouring corners.
        board_bend_m: largest distance of a corner from a plane.
        image: structure over the image; `drift`: over the order of the photos.
        misfit_px: RMS of the residuals that `image` explains, both axes together.
        image_share: of the squares of all residuals that it explains.
        focal_drift: change of the focal length from the first photo to the last, as a share of it.
    """

    K: Float64[np.ndarray, "3 3"]
    distortion: Distortion
    covariance: Float64[np.ndarray, "lens lens"]
    normals: Float64[np.ndarray, "n 3"]
    board_bend_m: float
    image: Structure
    drift: Structure
    misfit_px: float
    image_share: float
    focal_drift: float
    rms_px: float
    rms_by_photo_px: Float64[np.ndarray, " n"]


class _Design(NamedTuple):
    """Residuals (px) and how they depend on unknowns, without what the board's poses explain."""

    residuals: np.ndarray
    lens: np.ndarray
    bend: np.ndarray
    image: np.ndarray
    drift: np.ndarray


class _Camera(NamedTuple):
    K: np.ndarray
    distortion: np.ndarray
    turns: Sequence[np.ndarray]
    shifts: Sequence[np.ndarray]
    by_photo_px: np.ndarray


def fit_lens(
    points_board: Sequence[np.ndarray], pixels: Sequence[np.ndarray], size_px: tuple[int, int]
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
    bends = [_bends((one - middle) / radius_m) for one in points]
    camera = _calibrated(points, pixels, size_px, None)
    design = _design(points, pixels, bends, camera, size_px)
    bend = np.zeros(bends[0].shape[1])
    flat = structure(design.residuals, design.lens, design.bend, num_others=6 * len(points))
    for _ in range(BEND_ROUNDS if flat.p_value < MAX_BEND_P else 0):
        step = structure(design.residuals, design.lens, design.bend).coefficients
        if np.abs(bend + step).max() > MAX_BEND * radius_m:
            break
        bend += step
        bent = [
            one + np.outer(heights @ bend, [0.0, 0.0, 1.0])
            for one, heights in zip(points, bends, strict=True)
        ]
        camera = _calibrated(bent, pixels, size_px, camera)
        design = _design(bent, pixels, bends, camera, size_px)
    return _with_statistics(
        camera, design, np.concatenate(bends) @ bend, [len(one) for one in points]
    )


def _with_statistics(
    camera: _Camera, design: _Design, heights_m: np.ndarray, num_corners: list[int]
) -> LensFit:
    residuals, num_others = design.residuals, 6 * len(num_corners)
    with_bend = np.column_stack([design.lens, design.bend])
    fitted = with_bend if heights_m.any() else design.lens
    # Beside what the image explains: a lens of another model is no lens that changes.
    drift = structure(
        residuals,
        np.column_stack([fitted, design.image]),
        design.drift,
        num_others=num_others,
    )
    # With what the solver did not reach, as it does not for lenses far from the model.
    whole = np.column_stack([with_bend, design.image])
    image = structure(residuals, whole[:, :0], whole, num_others=num_others)
    smooth = np.column_stack([design.bend, design.image, design.drift])
    found = structure(residuals, fitted, smooth, num_others=num_others)
    freedom = len(residuals) - num_others - fitted.shape[1]
    variance = max(found.ratio * found.rest, float(residuals @ residuals) / freedom)
    scale = 1 / np.linalg.norm(fitted, axis=0)
    shares = np.linalg.pinv((fitted * scale).T @ (fitted * scale), hermitian=True)
    squares = max(float(np.square(camera.by_photo_px) @ num_corners), np.finfo(float).tiny)
    noise = image.rest * freedom
    turns = np.array(camera.turns, dtype=np.float64).reshape(-1, 3)
    return LensFit(
        K=camera.K,
        distortion=camera.distortion,
        covariance=(variance * np.outer(scale, scale) * shares)[:NUM_LENS, :NUM_LENS],
        normals=rotation_from_vector(turns)[:, :, 2],
        board_bend_m=float(np.ptp(heights_m)),
        image=image,
        drift=drift,
        misfit_px=float(np.sqrt(max(squares - noise, 0.0) / sum(num_corners))),
        image_share=max(1 - noise / squares, 0.0),
        focal_drift=float(np.abs(2 * drift.coefficients[:2] / np.diag(camera.K)[:2]).max()),
        rms_px=float(np.sqrt(squares / sum(num_corners))),
        rms_by_photo_px=camera.by_photo_px,
    )


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
    K, distortion = (np.eye(3), np.zeros(NUM_DISTORTION)) if start is None else start[:2]
    flags = 0 if start is None else cv2.CALIB_USE_INTRINSIC_GUESS
    boards, seen = ([one.astype(np.float32) for one in series] for series in (points, pixels))
    try:
        _, K, distortion, turns, shifts, _, _, by_photo = cv2.calibrateCameraExtended(
            boards, seen, size_px, K.copy(), distortion.copy(), flags=flags
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


def _bends(flat: np.ndarray) -> np.ndarray:
    """Height of a bent sheet, which has no other shape that a plane cannot explain, [k, 3]."""
    x, y = flat[:, 0], flat[:, 1]
    return np.column_stack([x * x, x * y, y * y])


def _design(
    points: list[np.ndarray],
    pixels: list[np.ndarray],
    bends: list[np.ndarray],
    camera: _Camera,
    size_px: tuple[int, int],
) -> _Design:
    rows = []
    middle, half_px = camera.K[:2, 2], 0.5 * float(np.hypot(*size_px))
    times = np.linspace(-1, 1, len(points))
    poses = zip(camera.turns, camera.shifts, strict=True)
    for one, seen, bend, (turn, shift), time in zip(
        points, pixels, bends, poses, times, strict=True
    ):
        predicted, J = cv2.projectPoints(one, turn, shift, camera.K, camera.distortion)
        predicted, J = predicted.reshape(-1, 2), np.asarray(J)
        normal = rotation_from_vector(np.asarray(turn).reshape(1, 3))[0, :, 2]
        along_normal = (J[:, 3:6] @ normal).reshape(-1, 2, 1)
        by_bend = (along_normal * bend[:, None]).reshape(len(J), -1)
        lens = J[:, 6 : 6 + NUM_LENS]
        columns = np.column_stack(
            [
                (seen - predicted).ravel(),
                lens,
                by_bend,
                _fields((predicted - middle) / half_px),
                time * lens[:, :NUM_DRIFTING],
            ]
        )
        Q, _ = np.linalg.qr(J[:, :6])
        rows.append(columns - Q @ (Q.T @ columns))
    stacked = np.concatenate(rows)
    ends = [1, 1 + NUM_LENS, 4 + NUM_LENS, stacked.shape[1] - NUM_DRIFTING]
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
