"""Images scaled to a square are averages over areas, and the camera's matrix goes with them."""

import cv2
import numpy as np
import pytest

from dextouch.geometry import pinhole_matrix, project
from dextouch.images import scaled_square


@pytest.mark.parametrize(("height", "width", "side"), [(64, 64, 32), (48, 80, 24), (97, 61, 20)])
def test_pixels_are_those_of_opencvs_area_interpolation(height, width, side):
    image = np.random.default_rng(0).integers(0, 256, (height, width, 3), dtype=np.uint8)
    small, _ = scaled_square(image[None], np.eye(3), side)
    shorter = min(height, width)
    top, left = (height - shorter) // 2, (width - shorter) // 2
    middle = image[top : top + shorter, left : left + shorter].astype(np.float64)
    expected = cv2.resize(middle, (side, side), interpolation=cv2.INTER_AREA)
    assert np.abs(small[0].astype(float) - expected).max() <= 0.51


def test_a_point_is_seen_where_the_new_matrix_says():
    K = pinhole_matrix(width_px=640, height_px=480, fovy_rad=0.9)
    image = np.zeros((480, 640, 3), dtype=np.uint8)
    point = np.array([[0.05, -0.1, 0.7]])
    pixel = project(K, point)[0][0]
    rows, columns = np.mgrid[0:480, 0:640] + 0.5
    image[np.hypot(columns - pixel[0], rows - pixel[1]) < 12] = 255
    small, moved = scaled_square(image[None], K, 60)
    weight = small[0, ..., 0].astype(float)
    rows, columns = np.mgrid[0:60, 0:60] + 0.5
    seen = np.array([(columns * weight).sum(), (rows * weight).sum()]) / weight.sum()
    np.testing.assert_allclose(seen, project(moved, point)[0][0], atol=0.05)


def test_images_of_the_size_stay_as_they_are():
    image, K = np.zeros((2, 16, 16, 3), dtype=np.uint8), np.eye(3)
    same, camera = scaled_square(image, K, 16)
    assert same is image
    assert camera is K
