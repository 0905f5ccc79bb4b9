"""Camera matrices against the one that photos were rendered with, and real photos."""

import sys
from functools import cache
from pathlib import Path

import cv2
import numpy as np
import pytest

from benchmarks.simulated import board_scenes as scenes
from dextouch.errors import InvalidInputError, ShapeError
from dextouch.geometry.rotations import rotation_from_vector
from services.alignment.calibration.intrinsics import (
    CHARUCO,
    EITHER_CHARUCO,
    LEGACY_CHARUCO,
    CharucoBoard,
    Chessboard,
    FoundBoards,
    calibrate_found,
    find_boards,
)
from services.alignment.calibration.motion import DegenerateMotionError

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
    found = calibrate_found(find_boards([render(rng, tilt_rad=0.6) for _ in range(14)], BOARD))
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


def test_a_corner_on_the_rim_of_the_print_is_no_corner_of_the_board(monkeypatch):
    """OpenCV took one for the outermost corner of a noisy image: 12 px off, with no other sign."""
    photo, whole = render(np.random.default_rng(2), tilt_rad=0.4), cv2.findChessboardCorners
    assert find_boards([photo], BOARD).photos == (0,)

    def wrong(*given):
        found, corners = whole(*given)
        corners = corners.copy()
        corners[0] += 0.6 * (corners[0] - corners[1])
        return found, corners

    monkeypatch.setattr(cv2, "findChessboardCorners", wrong)
    monkeypatch.setattr(cv2, "cornerSubPix", lambda _photo, corners, *_: corners)
    assert find_boards([photo], BOARD).photos == ()


def test_flat_views_and_missing_boards_are_refused():
    rng = np.random.default_rng(3)
    flat = [render(rng, tilt_rad=0.02) for _ in range(6)]
    with pytest.raises(DegenerateMotionError, match="tilted"):
        calibrate_found(find_boards(flat, BOARD))
    with pytest.raises(InvalidInputError, match="found in 0 of 6"):
        calibrate_found(find_boards([np.full((480, 640), 128, dtype=np.uint8)] * 6, BOARD))
    with pytest.raises(ShapeError):
        calibrate_found(find_boards([], BOARD))
    with pytest.raises(ShapeError):
        calibrate_found(find_boards([flat[0], flat[1][:100]], BOARD))
    with pytest.raises(InvalidInputError):
        calibrate_found(find_boards(flat, CharucoBoard(5, 7, 0.02, 0.03)))
    with pytest.raises(InvalidInputError, match="DICT_5X5_250"):
        calibrate_found(find_boards(flat, CharucoBoard(5, 7, 0.03, 0.02, "DICT_1")))


@pytest.mark.skipif(not PHOTOS.is_dir(), reason="no recordings in ../shared/data")
def test_real_photos_agree_with_themselves(capsys):
    photos = [cv2.imread(str(path), cv2.IMREAD_GRAYSCALE) for path in sorted(PHOTOS.glob("*.jpg"))]
    whole = calibrate_found(find_boards(photos, BOARD))
    halves = [calibrate_found(find_boards(photos[k::2], BOARD)) for k in (0, 1)]
    apart = np.abs(halves[0].K - halves[1].K)[[0, 1, 0, 1], [0, 1, 2, 2]]
    sigmas = apart / np.hypot(halves[0].sigma_fxfycxcy_px, halves[1].sigma_fxfycxcy_px)
    with capsys.disabled():
        sys.stdout.write(
            f"\nintrinsics, 13 real photos: fx {whole.K[0, 0]:.1f} +- "
            f"{whole.sigma_fxfycxcy_px[0]:.1f} px, rms {whole.rms_px:.3f} px, bound 0.20 | "
            f"halves {sigmas.max():.1f} sigma, bound 5"
        )
    assert len(whole.used_images) == 13
    assert whole.rms_px <= 0.20
    assert whole.rms_by_place_px.shape == (13,)
    assert sigmas.max() <= 5


@pytest.mark.skipif(not CHARUCO_PHOTO.is_file(), reason="no recordings in ../shared/data")
def test_real_charuco_board_is_found_but_one_view_is_not_enough():
    photo = cv2.imread(str(CHARUCO_PHOTO))
    board = CharucoBoard(5, 7, 0.03, 0.02)
    with pytest.raises(DegenerateMotionError, match="tilted"):
        calibrate_found(find_boards([photo] * 5, board))
    found = find_boards([photo], board)
    assert found.pattern == EITHER_CHARUCO
    assert len(found.pixels_px[0]) >= 20


def leave_one_out_rms_px(found):
    """Error of each photo, RMS in pixels, when only the board's pose is fitted to the photo."""
    left = []
    for index, (points, pixels) in enumerate(zip(found.points_board, found.pixels_px, strict=True)):
        kept = [k for k in range(len(found.photos)) if k != index]
        others = calibrate_found(scenes.selected_boards(found, kept))
        camera = others.K, others.distortion
        _, turn, shift = cv2.solvePnP(points, pixels, *camera)
        projected, _ = cv2.projectPoints(points, turn, shift, *camera)
        error = np.asarray(projected, dtype=np.float64).reshape(-1, 2) - pixels
        left.append(np.sqrt(np.square(error).sum(axis=1).mean()))
    return np.array(left)


@pytest.mark.skipif(not PHOTOS.is_dir(), reason="no recordings in ../shared/data")
def test_a_real_photo_is_predicted_from_the_others(capsys):
    photos = [cv2.imread(str(path), cv2.IMREAD_GRAYSCALE) for path in sorted(PHOTOS.glob("*.jpg"))]
    left_px = leave_one_out_rms_px(find_boards(photos, BOARD))
    rms_px = float(np.sqrt(np.square(left_px).mean()))
    with capsys.disabled():
        sys.stdout.write(
            f"\nintrinsics, leave one of 13 photos out: rms {rms_px:.3f} px, worst "
            f"{left_px.max():.3f} px, bound 0.3"
        )
    assert left_px.shape == (13,)
    assert left_px.max() <= 0.3


@cache
def simulated(seed, num_views):
    motion = scenes.Motion(num_views=num_views, sideways_m=0.25)
    views = scenes.make_scene(seed, motion).views
    return FoundBoards(
        tuple(points.astype(np.float32) for points in views.points_board),
        tuple(pixels.astype(np.float32) for pixels in views.pixels_px),
        scenes.IMAGE_SIZE_PX,
        tuple(range(num_views)),
        num_views,
        "chessboard",
    )


@pytest.mark.long
def test_simulated_cameras_spread_as_their_sigmas_say(capsys):
    rows, columns = [0, 1, 0, 1], [0, 1, 2, 2]
    all_found = [calibrate_found(simulated(seed, 25)) for seed in range(20)]
    errors_px = np.array([found.K[rows, columns] - scenes.K[rows, columns] for found in all_found])
    sigmas_px = np.sqrt(np.mean([found.sigma_fxfycxcy_px**2 for found in all_found], axis=0))
    focal = np.abs(errors_px[:, 0]) / scenes.K[0, 0]
    ratios = sigmas_px / errors_px.std(axis=0)
    bends = np.array([found.distortion for found in all_found])
    bend_sigmas = np.sqrt(np.mean([found.sigma_distortion**2 for found in all_found], axis=0))
    bend_ratios = bend_sigmas / bends.std(axis=0)
    with capsys.disabled():
        sys.stdout.write(
            f"\nintrinsics, 25 simulated views, 20 seeds: |df|/f median {np.median(focal):.2%}, "
            f"bound 0.3 % (worst {focal.max():.2%}) | sigma over spread {np.round(ratios, 2)} "
            f"{np.round(bend_ratios, 2)}, bounds 0.5 and 2"
        )
    assert np.median(focal) <= 0.003
    for ratio in (*ratios, *bend_ratios):
        assert 0.5 <= ratio <= 2


def test_coverage_counts_the_parts_of_the_image_with_corners():
    found = simulated(0, 25)
    half = [(points, pixels, pixels[:, 0] < 500) for points, pixels in zip(
        found.points_board, found.pixels_px, strict=True
    )]  # fmt: skip
    kept = [k for k, (_, _, is_left) in enumerate(half) if is_left.sum() >= 12]
    left_only = FoundBoards(
        tuple(half[k][0][half[k][2]] for k in kept),
        tuple(half[k][1][half[k][2]] for k in kept),
        found.image_size_px,
        tuple(kept),
        25,
        "chessboard",
    )
    # 500 of 1280 pixels are in the left two of four columns.
    assert calibrate_found(left_only).coverage <= 0.5


def charuco_photos(board, *, legacy):
    dictionary = cv2.aruco.getPredefinedDictionary(getattr(cv2.aruco, board.dictionary))
    printed = cv2.aruco.CharucoBoard(
        (board.columns, board.rows), board.square_m, board.marker_m, dictionary
    )
    printed.setLegacyPattern(legacy)
    size_px = (board.columns * 60, board.rows * 60)
    picture = printed.generateImage(size_px, None, 0, 1)
    rng = np.random.default_rng(0)
    to_metres = np.diag([board.square_m / 60, board.square_m / 60, 1.0])
    to_metres[:2, 2] = -0.5 * board.square_m * np.array([board.columns, board.rows])
    photos = []
    for _ in range(6):
        R = rotation_from_vector(rng.uniform(-0.5, 0.5, 3))
        t = np.array([*rng.uniform(-0.02, 0.02, 2), rng.uniform(0.3, 0.4)])
        homography = K @ np.column_stack([R[:, 0], R[:, 1], t]) @ to_metres
        photos.append(cv2.warpPerspective(picture, homography, (640, 480), borderValue=255))
    return photos


@pytest.mark.parametrize(("legacy", "name"), [(False, CHARUCO), (True, LEGACY_CHARUCO)])
def test_both_printings_of_a_charuco_board_are_told_apart(legacy, name):
    board = CharucoBoard(5, 6, 0.03, 0.022)
    photos = charuco_photos(board, legacy=legacy)
    boards = find_boards(photos, board)
    assert boards.pattern == name
    assert boards.photos == tuple(range(6))
    found = calibrate_found(boards)
    assert abs(found.K[0, 0] - K[0, 0]) <= 4 * found.sigma_fxfycxcy_px[0]
    assert found.rms_px < 0.3


@pytest.mark.parametrize("legacy", [False, True])
def test_markers_of_another_size_than_entered_are_refused_with_their_size(legacy):
    photos = charuco_photos(CharucoBoard(5, 6, 0.03, 0.022), legacy=legacy)
    for close_m in (0.021, 0.0235):
        assert len(find_boards(photos, CharucoBoard(5, 6, 0.03, close_m)).photos) == 6
    for wrong_m in (0.010, 0.015, 0.018, 0.027, 0.029):
        board = CharucoBoard(5, 6, 0.03, wrong_m)
        with pytest.raises(InvalidInputError, match=r"measure 0.7\d of a square") as refused:
            find_boards(photos, board)
        assert refused.value.details["marker_ratio"] == pytest.approx(22 / 30, rel=0.03)
        # One photo is enough, so that a guided run says it at once.
        with pytest.raises(InvalidInputError, match="would fit these squares"):
            find_boards(photos[:1], board)
