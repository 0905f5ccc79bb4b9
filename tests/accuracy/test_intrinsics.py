"""Camera matrices against the one that photos were rendered with, and real photos."""

import sys
from pathlib import Path

import cv2
import numpy as np
import pytest

from dextouch.errors import InvalidInputError, ShapeError
from dextouch.geometry.rotations import rotation_from_vector
from services.alignment.calibration.hand_eye import DegenerateMotionError
from services.alignment.calibration.intrinsics import CharucoBoard, Chessboard, calibrate_camera

PHOTOS = Path(__file__).parents[3] / "shared/data/camera_chessboard"
CHARUCO_PHOTO = PHOTOS.parent / "hand_eye/charuco.jpg"
K = np.array([[520.0, 0.0, 325.0], [0.0, 515.0, 236.0], [0.0, 0.0, 1.0]])
BOARD = Chessboard(9, 6, 0.025)
SQUARE_PX = 60


def chessboard_picture():
    rows, columns = np.indices(((BOARD.rows + 3) * SQUARE_PX, (BOARD.columns + 3) * SQUARE_PX))
    dark = (rows // SQUARE_PX + columns // SQUARE_PX) % 2 == 0
    inside = np.zeros_like(dark)
    inside[SQUARE_PX:-SQUARE_PX, SQUARE_PX:-SQUARE_PX] = True
    return np.where(dark & inside, 30, 225).astype(np.uint8)


def render(rng, *, tilt_rad):
    """A photo of the board by the homography of its plane, with a little blur and noise."""
    metre = BOARD.square_m / SQUARE_PX
    middle = 0.5 * np.array([(BOARD.columns + 3) * SQUARE_PX, (BOARD.rows + 3) * SQUARE_PX])
    to_metres = np.array(
        [[metre, 0, -middle[0] * metre], [0, metre, -middle[1] * metre], [0, 0, 1]]
    )
    R = rotation_from_vector(rng.uniform(-tilt_rad, tilt_rad, 3))
    t = np.array([*rng.uniform(-0.05, 0.05, 2), rng.uniform(0.4, 0.55)])
    # Three times finer, then averaged: pixel centres lie at whole numbers in both.
    finer = np.array([[3.0, 0.0, 1.0], [0.0, 3.0, 1.0], [0.0, 0.0, 1.0]])
    homography = finer @ K @ np.column_stack([R[:, 0], R[:, 1], t]) @ to_metres
    picture = cv2.warpPerspective(
        chessboard_picture(), homography, (1920, 1440), flags=cv2.INTER_LINEAR, borderValue=225
    )
    picture = cv2.resize(picture, (640, 480), interpolation=cv2.INTER_AREA)
    picture = cv2.GaussianBlur(picture, (0, 0), 0.7)
    return np.clip(picture + rng.normal(scale=2, size=picture.shape), 0, 255).astype(np.uint8)


def test_rendered_camera_is_found_within_its_sigmas(capsys):
    rng = np.random.default_rng(2)
    found = calibrate_camera([render(rng, tilt_rad=0.6) for _ in range(14)], BOARD)
    error_px = found.K[[0, 1, 0, 1], [0, 1, 2, 2]] - K[[0, 1, 0, 1], [0, 1, 2, 2]]
    sigmas = np.abs(error_px) / found.sigma_fxfycxcy_px
    with capsys.disabled():
        sys.stdout.write(
            f"\nintrinsics, 14 views: worst {np.abs(error_px).max():.2f} px, bound 1 | "
            f"error in sigmas {sigmas.max():.1f}, bound 4 | rms {found.rms_px:.3f} px, bound 0.3"
        )
    assert np.abs(error_px).max() <= 1
    assert sigmas.max() <= 4
    assert found.rms_px <= 0.3


def test_flat_views_and_missing_boards_are_refused():
    rng = np.random.default_rng(3)
    flat = [render(rng, tilt_rad=0.02) for _ in range(6)]
    with pytest.raises(DegenerateMotionError, match="tilted"):
        calibrate_camera(flat, BOARD)
    with pytest.raises(InvalidInputError, match="found in 0 of 6"):
        calibrate_camera([np.full((480, 640), 128, dtype=np.uint8)] * 6, BOARD)
    with pytest.raises(ShapeError):
        calibrate_camera([], BOARD)
    with pytest.raises(ShapeError):
        calibrate_camera([flat[0], flat[1][:100]], BOARD)
    with pytest.raises(InvalidInputError):
        calibrate_camera(flat, CharucoBoard(5, 7, 0.02, 0.03))
    with pytest.raises(InvalidInputError, match="DICT_5X5_250"):
        calibrate_camera(flat, CharucoBoard(5, 7, 0.03, 0.02, "DICT_1"))


@pytest.mark.skipif(not PHOTOS.is_dir(), reason="no recordings in ../shared/data")
def test_real_photos_agree_with_themselves(capsys):
    photos = [cv2.imread(str(path), cv2.IMREAD_GRAYSCALE) for path in sorted(PHOTOS.glob("*.jpg"))]
    whole = calibrate_camera(photos, BOARD)
    halves = [calibrate_camera(photos[k::2], BOARD) for k in (0, 1)]
    apart = np.abs(halves[0].K - halves[1].K)[[0, 1, 0, 1], [0, 1, 2, 2]]
    sigmas = apart / np.hypot(halves[0].sigma_fxfycxcy_px, halves[1].sigma_fxfycxcy_px)
    with capsys.disabled():
        sys.stdout.write(
            f"\nintrinsics, 13 real photos: fx {whole.K[0, 0]:.1f} +- "
            f"{whole.sigma_fxfycxcy_px[0]:.1f} px, rms {whole.rms_px:.2f} px, bound 0.6 | "
            f"halves {sigmas.max():.1f} sigma, bound 5"
        )
    assert len(whole.used_images) == 13
    assert whole.rms_px <= 0.6
    assert sigmas.max() <= 5


@pytest.mark.skipif(not CHARUCO_PHOTO.is_file(), reason="no recordings in ../shared/data")
def test_real_charuco_board_is_found_but_one_view_is_not_enough():
    photo = cv2.imread(str(CHARUCO_PHOTO))
    board = CharucoBoard(5, 7, 0.03, 0.02)
    with pytest.raises(DegenerateMotionError, match="tilted"):
        calibrate_camera([photo] * 5, board)
