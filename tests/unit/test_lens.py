"""Cameras with distortion, against OpenCV's model of the lens."""

import cv2
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from dextouch.geometry import (
    NUM_DISTORTION,
    box_pixels,
    distortion_of,
    points_on_level,
    project,
    undistorted,
)

K = np.array([[560.0, 0.0, 322.0], [0.0, 555.0, 238.0], [0.0, 0.0, 1.0]])
STRAIGHT = np.zeros(5)
LENSES = (
    STRAIGHT,
    np.array([-0.28, 0.09, 0.001, -0.0008, 0.0]),
    np.array([0.1, 0, 0, 0.002, -0.02]),
)
SIZE_PX = (640, 480)


def looking_down(tilt_rad, yaw_rad=0.3, height_m=0.6):
    """A camera over the table: its optical axis is `tilt_rad` from straight down."""
    turn, _ = cv2.Rodrigues(np.array([0.0, 0.0, yaw_rad]))
    down, _ = cv2.Rodrigues(np.array([np.pi + tilt_rad, 0.0, 0.0]))
    T = np.eye(4)
    T[:3, :3], T[:3, 3] = turn @ down, [0.05, -0.4, height_m]
    return T


def seen_by_opencv(points_world, distortion, T_world_camera, camera=K):
    # OpenCV's rotation vectors lose digits near half a turn, so it gets points in the camera.
    points = (np.asarray(points_world) - T_world_camera[:3, 3]) @ T_world_camera[:3, :3]
    pixels, _ = cv2.projectPoints(points, np.zeros(3), np.zeros(3), camera, distortion)
    return pixels.reshape(-1, 2)


@given(
    lens=st.sampled_from(range(len(LENSES))),
    tilt_rad=st.floats(0.0, 0.9),
    z_m=st.floats(-0.1, 0.2),
    seed=st.integers(0, 2**31),
)
def test_pixels_that_opencv_gives_lead_back_to_the_points(lens, tilt_rad, z_m, seed):
    T = looking_down(tilt_rad)
    rng = np.random.default_rng(seed)
    pixels = rng.uniform(0, SIZE_PX, size=(20, 2))
    points, hits = points_on_level(pixels, (K, LENSES[lens]), T, z_m)
    assert hits.all()
    np.testing.assert_allclose(points[:, 2], z_m, atol=1e-12)
    np.testing.assert_allclose(seen_by_opencv(points, LENSES[lens], T), pixels, atol=1e-6)


@pytest.mark.parametrize("distortion", LENSES)
def test_rays_are_those_of_opencvs_undistorted_points(distortion):
    u, v = np.meshgrid(np.arange(0, 641, 40.0), np.arange(0, 481, 40.0))
    pixels = np.stack([u, v], axis=-1).reshape(-1, 2)
    criteria = (cv2.TERM_CRITERIA_COUNT | cv2.TERM_CRITERIA_EPS, 200, 1e-14)
    rays = cv2.undistortPointsIter(pixels[:, None], K, distortion, None, None, criteria)
    # A camera that looks straight down from 1 m, with x to the right and y to the front.
    T = np.diag([1.0, -1.0, -1.0, 1.0])
    T[2, 3] = 1.0
    points, _ = points_on_level(pixels, (K, distortion), T, 0.0)
    np.testing.assert_allclose(points[:, :2] * [1, -1], rays.reshape(-1, 2), atol=1e-9)


def test_points_are_seen_where_opencv_sees_them():
    points = np.random.default_rng(0).uniform([-0.3, -0.2, 0.5], [0.3, 0.2, 1.5], size=(50, 3))
    for distortion in LENSES:
        pixels, in_front = project(K, points, distortion)
        assert in_front.all()
        expected, _ = cv2.projectPoints(points, np.zeros(3), np.zeros(3), K, distortion)
        np.testing.assert_allclose(pixels, expected.reshape(-1, 2), atol=1e-9)
    np.testing.assert_allclose(project(K, points, STRAIGHT)[0], project(K, points)[0])


def test_rays_that_miss_the_plane_have_no_point():
    T = looking_down(0.9)
    # Above the horizon, which lies π/2 − 0.9 over the middle: at most 238 − 555 tan(0.67) px.
    points, hits = points_on_level(np.array([[320.0, -250.0]]), (K, STRAIGHT), T, 0.0)
    assert not hits[0]
    assert np.isnan(points[0]).all()
    # The plane is behind a camera that is below it.
    assert not points_on_level(np.array([[320.0, 240.0]]), (K, STRAIGHT), T, 0.7)[1][0]


def test_a_pixel_beyond_where_the_lens_turns_back_has_no_point():
    # x (1 − 0.45 x²) is at most 0.574, at x = 0.861.
    distortion = np.array([-0.45, 0.0, 0.0, 0.0, 0.0])
    T = looking_down(0.0)
    pixels = np.array([[322 + 0.57 * 560, 238.0], [322 + 0.58 * 560, 238.0]])
    assert points_on_level(pixels, (K, distortion), T, 0.0)[1].tolist() == [True, False]


def test_corners_of_a_box():
    T_world_object = np.eye(4)
    T_world_object[:3, 3] = [0.0, 0.0, 0.05]
    T = looking_down(0.5, yaw_rad=0.0)
    pixels = box_pixels(
        np.array([0.0, 0.0, 0.01, 0.1, 0.2, 0.03]), T_world_object, (K, LENSES[1]), T
    )
    corners = [[x, y, z] for z in (0.03, 0.09) for y in (-0.2, 0.2) for x in (-0.1, 0.1)]
    np.testing.assert_allclose(pixels, seen_by_opencv(np.array(corners), LENSES[1], T), atol=1e-9)


@pytest.mark.parametrize("distortion", LENSES[1:])
def test_images_are_undistorted_as_by_opencv(distortion):
    noise = np.random.default_rng(7).integers(0, 256, (2, 12, 16, 3), dtype=np.uint8)
    images = np.stack([cv2.resize(one, SIZE_PX, interpolation=cv2.INTER_CUBIC) for one in noise])
    # OpenCV's first pixel has its centre at 0, ours at 0.5.
    camera = K - np.array([[0, 0, 0.5], [0, 0, 0.5], [0, 0, 0]])
    x, y = cv2.initUndistortRectifyMap(camera, distortion, None, camera, SIZE_PX, cv2.CV_32FC1)
    expected = [
        cv2.remap(one, x, y, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE) for one in images
    ]
    got = undistorted(images, K, distortion)
    # Only the map is ours: a rounding of it may choose another of 32 places within a pixel.
    off = np.abs(got.astype(int) - np.stack(expected))
    assert off.max() <= 4
    assert off.mean() < 0.1
    assert np.abs(got.astype(int) - images).mean() > 3 * off.mean()


def test_images_without_distortion_are_left_alone():
    images = np.zeros((1, 480, 640, 3), dtype=np.uint8)
    assert undistorted(images, K, STRAIGHT) is images
    assert undistorted(images[:0], K, LENSES[1]).shape == (0, 480, 640, 3)


def test_coefficients_that_a_calibration_lacks_are_zero():
    calibration = {"distortion_head": ((0.1, -0.2, 1e-3, 2e-3),), "K_head": np.eye(3)}
    assert distortion_of(calibration, "head").tolist() == [0.1, -0.2, 1e-3, 2e-3, 0.0]
    assert distortion_of(calibration, "wrist_left").tolist() == [0.0] * NUM_DISTORTION
