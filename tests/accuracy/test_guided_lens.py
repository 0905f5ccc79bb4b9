"""Guided lens calibration: when it counts as done, the focal length is right.

Corners are projected here, by the documented model of a camera; none come from the code under test.
"""

import sys

import numpy as np
import pytest

from dextouch.errors import InvalidInputError
from services.alignment.calibration.intrinsics import CHESSBOARD, calibrate_found
from services.alignment.station_calibration import boards
from services.alignment.station_calibration.camera_views import MAX_VIEWS

COLUMNS, ROWS, SQUARE_M = 9, 6, 0.025
SIZE_PX = (640, 480)
FOCAL_PX, MIDDLE_PX = np.array([552.0, 547.0]), np.array([327.0, 231.0])
K1, K2, P1, P2 = -0.12, 0.05, 0.001, -0.0008
BOUND = 0.003


def axis_turn(axis, angle):
    c, s = np.cos(angle), np.sin(angle)
    i, j = [(1, 2), (0, 2), (0, 1)][axis]
    R = np.eye(3)
    R[i, i] = R[j, j] = c
    R[i, j], R[j, i] = (s, -s) if axis == 1 else (-s, s)
    return R


def pixels_of(points):
    x, y = points[:, 0] / points[:, 2], points[:, 1] / points[:, 2]
    r2 = x**2 + y**2
    radial = 1 + K1 * r2 + K2 * r2**2
    seen_x = x * radial + 2 * P1 * x * y + P2 * (r2 + 2 * x**2)
    seen_y = y * radial + P1 * (r2 + 2 * y**2) + 2 * P2 * x * y
    return np.stack([seen_x, seen_y], axis=1) * FOCAL_PX + MIDDLE_PX


def random_view(rng, *, noise_px, tilts_rad=(0.0, 0.6), depths_m=(0.3, 0.7)):
    """A board that is wholly in the image, tilted about one of its axes or about both."""
    column, row = np.meshgrid(np.arange(COLUMNS), np.arange(ROWS))
    flat = np.stack([column.ravel(), row.ravel(), np.zeros(COLUMNS * ROWS)], axis=1) * SQUARE_M
    while True:
        tilts = rng.uniform(*tilts_rad, 2) * rng.choice([-1, 1], 2)
        R = axis_turn(2, rng.uniform(-0.4, 0.4)) @ axis_turn(0, tilts[0]) @ axis_turn(1, tilts[1])
        depth_m = rng.uniform(*depths_m)
        middle = np.array([*rng.uniform(-0.5, 0.5, 2) * depth_m, depth_m])
        points = (flat - flat.mean(axis=0)) @ R.T + middle
        pixels = pixels_of(points)
        if (pixels > 4).all() and (pixels < np.array(SIZE_PX) - 5).all():
            break
    seen = pixels + noise_px * rng.standard_normal(pixels.shape)
    return boards.BoardView("", flat.astype("f4"), seen.astype("f4"), CHESSBOARD, is_blurred=False)


def with_wrong_corner(view, rng):
    """One corner of the board is taken for one half a square further out."""
    pixels = view.pixels.copy()
    pixels[0] += 0.5 * (pixels[0] - pixels[1]) + rng.uniform(-1, 1, 2)
    return boards.BoardView("", view.points_board, pixels, CHESSBOARD, is_blurred=False)


def guided(views):
    """Views that the page has kept when it calls itself done; None if it never does.

    It is asked every few views, to spare the tests' time.
    """
    for count in range(boards.ENOUGH_VIEWS, len(views) + 1, 5):
        if not boards.camera_coverage(views[:count], SIZE_PX).todo:
            return views[:count]
    return None


def focal_error(views):
    found = calibrate_found(boards.found_boards(views, SIZE_PX))
    return float(np.abs(np.diag(found.K)[:2] / FOCAL_PX - 1).max())


@pytest.mark.long
@pytest.mark.parametrize("noise_px", [0.05, 0.1, 0.2])
def test_done_means_that_the_focal_length_is_right(noise_px, capsys):
    """Two of the views have a wrong corner; then the operator tilts the board, near, as asked."""
    rng = np.random.default_rng(7)
    errors, counts = [], []
    for _ in range(5):
        views = [random_view(rng, noise_px=noise_px) for _ in range(boards.ENOUGH_VIEWS)]
        for index in rng.choice(boards.ENOUGH_VIEWS, 2, replace=False):
            views[index] = with_wrong_corner(views[index], rng)
        asked = {"noise_px": noise_px, "tilts_rad": (0.5, 0.7), "depths_m": (0.3, 0.45)}
        more = [random_view(rng, **asked) for _ in range(boards.ENOUGH_VIEWS, MAX_VIEWS)]
        done = guided(views + more)
        if done is not None:
            errors.append(focal_error(done))
            counts.append(len(done))
    with capsys.disabled():
        sys.stdout.write(
            f"\nguided lens, {noise_px} px: {len(errors)} of 5 done after {counts} views, focal "
            f"length off by {max(errors, default=0):.3%} at most, bound {BOUND:.1%}"
        )
    assert len(errors) == 5
    assert max(errors) < BOUND


@pytest.mark.long
@pytest.mark.parametrize(
    ("num_views", "options"),
    [
        (12, {"noise_px": 0.3}),
        (MAX_VIEWS, {"noise_px": 0.3, "tilts_rad": (0.0, 0.12)}),
        (MAX_VIEWS, {"noise_px": 0.3, "depths_m": (0.69, 0.7)}),
        (30, {"noise_px": 2.0}),
    ],
)
def test_views_that_leave_the_focal_length_open_are_not_done(num_views, options):
    rng = np.random.default_rng(5)
    views = [random_view(rng, **options) for _ in range(num_views)]
    assert boards.camera_coverage(views, SIZE_PX).todo
    assert guided(views) is None


@pytest.mark.long
def test_what_scatters_beyond_the_bound_is_never_done():
    """Sets of few and noisy views: of those that are wrong by more than the bound, all go on."""
    rng = np.random.default_rng(11)
    num_wrong = 0
    for _ in range(12):
        noise_px = float(rng.uniform(0.3, 1.5))
        views = [random_view(rng, noise_px=noise_px) for _ in range(boards.ENOUGH_VIEWS)]
        coverage = boards.camera_coverage(views, SIZE_PX)
        try:
            is_wrong = focal_error(views) > BOUND
        except InvalidInputError:
            is_wrong = True
        num_wrong += is_wrong
        assert coverage.todo or not is_wrong
    assert num_wrong >= 2


def test_a_wrong_corner_is_left_out_with_its_view():
    rng = np.random.default_rng(3)
    views = [random_view(rng, noise_px=0.05) for _ in range(25)]
    views[4] = with_wrong_corner(views[4], rng)
    found = calibrate_found(boards.found_boards(views, SIZE_PX))
    assert found.used_images == tuple(index for index in range(25) if index != 4)
    assert found.rms_px < 0.1
    assert focal_error(views) < BOUND
