"""Cameras that see otherwise than they move, on images that OpenCV projects."""

import numpy as np
import pytest

from dextouch.streams import CameraMotion, View, thumbnail, view_faults
from dextouch.streams.camera_motion import ViewFaults
from tests.unit.streams import moving_camera

SECONDS = 8
SEEDS = range(3)


def faults(seed, change=lambda images: images, *, late_s=0.0, motion_seed=None):
    t_ns, images = moving_camera.images(seed, SECONDS, late_s)
    own = CameraMotion(*moving_camera.poses(seed if motion_seed is None else motion_seed, SECONDS))
    other = CameraMotion(*moving_camera.poses(seed if motion_seed is not None else 99, SECONDS))
    images = change(images)
    pictures = np.stack([thumbnail(image) for image in images])
    view = View(t_ns, pictures, moving_camera.K, images.shape[1:3])
    return view_faults("camera_head", view, {"camera_head": own, "camera_wrist_left": other})


@pytest.mark.parametrize("seed", SEEDS)
def test_a_camera_that_sees_as_it_moves_has_no_fault(seed):
    assert faults(seed) == ViewFaults(still_share=0.0)


@pytest.mark.parametrize("seed", SEEDS)
@pytest.mark.parametrize(
    ("turn", "change"),
    [
        ("mirrored, left for right", lambda a: a[:, :, ::-1]),
        ("mirrored, top for bottom", lambda a: a[:, ::-1]),
        ("turned by 180 degrees", lambda a: a[:, ::-1, ::-1]),
        ("turned by 90 degrees clockwise", lambda a: np.rot90(a, -1, (1, 2))),
        ("turned by 90 degrees anticlockwise", lambda a: np.rot90(a, 1, (1, 2))),
    ],
)
def test_turned_and_mirrored_images_are_named(seed, turn, change):
    assert faults(seed, change).turn == turn


@pytest.mark.parametrize("late_s", [-0.05, 0.05, 0.1, 0.3])
def test_a_lag_is_measured_with_its_uncertainty(late_s):
    for seed in SEEDS:
        lag_s, sigma_s = faults(seed, late_s=late_s).lag_s
        # Images are drawn to the nearest 10 ms, and so is what is said of small lags.
        assert abs(lag_s - late_s) < 0.008
        assert sigma_s < 0.01


@pytest.mark.parametrize("seed", SEEDS)
def test_the_images_of_another_camera_are_named(seed):
    assert faults(seed, motion_seed=seed + 50).like == "camera_wrist_left"


@pytest.mark.parametrize(
    "shown", [lambda a: a[:1], lambda a: np.full_like(a[:1], 6), lambda a: np.full_like(a[:1], 90)]
)
def test_a_picture_with_nothing_but_noise_is_still(shown):
    def loop(images):
        noise = np.random.default_rng(5).normal(0, 4, images.shape)
        return np.clip(shown(images) + noise, 0, 255).astype(np.uint8)

    assert faults(0, loop) == ViewFaults(still_share=1.0)


def test_a_camera_at_rest_says_nothing():
    t_ns, Ts = moving_camera.poses(0, SECONDS)
    rest = CameraMotion(t_ns, np.tile(Ts[:1], (len(Ts), 1, 1)))
    t_ns, images = moving_camera.images(0, SECONDS)
    view = View(t_ns, np.stack([thumbnail(i) for i in images]), moving_camera.K, (120, 160))
    assert view_faults("camera_head", view, {"camera_head": rest}) == ViewFaults()
