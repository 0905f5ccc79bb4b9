"""The table under a moving camera, against hand calculation and against OpenCV."""

import cv2
import numpy as np
import pytest
import torch

from dextouch.geometry import apply, invert, project, transform
from dextouch.geometry.rotations import rotation_from_vector
from services.world_model.rendering.inputs import CameraMotion, is_inside, sample_images
from tests.unit.world_model.rendering.scene_by_hand import DOWN, K


def _motion(T_start, T_camera):
    return CameraMotion.between(K[None], T_start[None], T_camera[None])


def test_a_camera_that_moves_sideways_shifts_the_table():
    T_start = transform(DOWN, np.array([0.0, 0.0, 0.6]))
    T_camera = transform(DOWN, np.array([0.06, 0.0, 0.6]))
    positions = _motion(T_start, T_camera).image_positions((64, 64))[0]
    # 6 cm at 60 cm distance are a tenth of the focal length.
    np.testing.assert_allclose(positions[10, 20], [20.5 + 0.1 * K[0, 0], 10.5], atol=1e-4)


def test_table_points_are_found_where_the_start_camera_projects_them():
    rng = np.random.default_rng(0)
    T_start, T_camera = (
        transform(
            DOWN @ rotation_from_vector(rng.normal(size=3) * 0.2),
            np.array([*rng.normal(size=2) * 0.1, h]),
        )
        for h in (0.6, 0.7)
    )
    points = np.concatenate([rng.uniform(-0.2, 0.2, (30, 2)), np.zeros((30, 1))], axis=1)
    before, _ = project(K, apply(invert(T_start), points))
    now, _ = project(K, apply(invert(T_camera), points))
    np.testing.assert_allclose(_motion(T_start, T_camera).to_start(now[None])[0], before, atol=1e-6)


def test_the_warp_is_that_of_opencv():
    rng = np.random.default_rng(1)
    T_start = transform(DOWN, np.array([0.0, 0.0, 0.6]))
    T_camera = transform(
        DOWN @ rotation_from_vector(np.array([0.05, -0.04, 0.1])), np.array([0.02, 0.01, 0.65])
    )
    smooth = cv2.GaussianBlur(rng.uniform(0, 1, (64, 64, 3)).astype(np.float32), (0, 0), 2)
    corners = np.array([[-0.1, -0.1, 0], [0.1, -0.1, 0], [0.1, 0.1, 0], [-0.1, 0.1, 0]])
    before, _ = project(K, apply(invert(T_start), corners))
    now, _ = project(K, apply(invert(T_camera), corners))
    # OpenCV counts from the centre of the first pixel.
    H = cv2.getPerspectiveTransform(
        (before - 0.5).astype(np.float32), (now - 0.5).astype(np.float32)
    )
    expected = cv2.warpPerspective(smooth, H, (64, 64), borderMode=cv2.BORDER_REPLICATE)
    positions = torch.from_numpy(_motion(T_start, T_camera).image_positions((64, 64)))
    planes = torch.from_numpy(smooth).permute(2, 0, 1)[None]
    warped = sample_images(planes, positions, interpolation="bilinear")[0].permute(1, 2, 0)
    # OpenCV rounds positions to 1/32 px.
    np.testing.assert_allclose(warped.numpy(), expected, atol=0.02)


def test_above_the_horizon_only_turns_move_the_image():
    level = np.array([[1.0, 0, 0], [0, 0, 1.0], [0, -1.0, 0]])
    T_start = transform(level, np.array([0, 0, 0.5]))
    T_camera = transform(level, np.array([0.2, 0.1, 0.6]))
    positions = _motion(T_start, T_camera).image_positions((64, 64))[0]
    np.testing.assert_allclose(positions[5, 40], [40.5, 5.5], atol=1e-4)


@pytest.mark.parametrize(
    "place", [[0, 0, 0], [0, 0, 1e-12], [1e4, 1e4, 1e4], [0, 0, -0.6], [0, 0, 1e-3]]
)
@pytest.mark.parametrize("vector", [[0.0, 0, 0], [np.pi, 0, 0], [np.pi / 2, 0, 0]])
def test_every_camera_gives_finite_positions(place, vector):
    T_start = transform(DOWN, np.array([0.0, 0.0, 0.6]))
    T_camera = transform(
        rotation_from_vector(np.array(vector)) @ DOWN, np.array(place, dtype=float)
    )
    positions = _motion(T_start, T_camera).image_positions((64, 64))
    assert np.isfinite(positions).all()
    assert np.abs(positions).max() <= 256


def test_a_camera_that_stands_still_moves_nothing():
    T = transform(DOWN @ rotation_from_vector(np.array([0.1, 0.2, 0.3])), np.array([0.1, 0.2, 0.6]))
    positions = _motion(T, T).image_positions((32, 64))[0]
    assert positions[7, 11].tolist() == [11.5, 7.5]
    assert is_inside(positions, (32, 64)).all()
