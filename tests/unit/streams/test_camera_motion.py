"""Cameras that see otherwise than they move, on images that OpenCV projects."""

import cv2
import numpy as np
import pytest
from scipy.ndimage import gaussian_filter1d
from scipy.spatial.transform import Rotation

from dextouch.streams import MovingCamera, View, thumbnail, view_faults
from dextouch.streams.camera_motion import ViewFaults
from tests.unit.streams import moving_camera

SECONDS = 5
SEEDS = range(3)


def faults(seed, change=lambda images: images, *, late_s=0.0):
    t_ns, images = moving_camera.images(seed, SECONDS, late_s)
    images = change(images)
    pictures = np.stack([thumbnail(image) for image in images])
    view = View(t_ns, pictures, moving_camera.K, images.shape[1:3])
    return view_faults(view, MovingCamera(*moving_camera.poses(seed, SECONDS)))


@pytest.mark.parametrize("seed", SEEDS)
def test_a_camera_that_sees_as_it_moves_has_no_fault(seed):
    assert faults(seed) == ViewFaults(still_share=0.0)


@pytest.mark.parametrize("seed", SEEDS)
@pytest.mark.parametrize(
    ("turn", "change"),
    [
        ("mirrored_left_for_right", lambda a: a[:, :, ::-1]),
        ("mirrored_top_for_bottom", lambda a: a[:, ::-1]),
        ("turned_by_180_degrees", lambda a: a[:, ::-1, ::-1]),
        ("turned_by_90_degrees_clockwise", lambda a: np.rot90(a, -1, (1, 2))),
        ("turned_by_90_degrees_anticlockwise", lambda a: np.rot90(a, 1, (1, 2))),
    ],
)
def test_turned_and_mirrored_images_are_named(seed, turn, change):
    assert list(faults(seed, change).looks) == [turn]


@pytest.mark.parametrize(
    "late_s", [0.1, *(pytest.param(s, marks=pytest.mark.long) for s in (-0.05, 0.3))]
)
def test_late_images_do_not_look_turned(late_s):
    assert [dict(faults(seed, late_s=late_s).looks) for seed in range(10)] == [{}] * 10


def with_hands(seed, follows, count=145):
    """A room, and before it two hands (18 % of the picture); the head is 0.2 s behind them.

    Pictures, and the head's angles right and down, at 30 Hz.
    """
    rng = np.random.default_rng(seed)
    hands, sway = gaussian_filter1d(rng.standard_normal((2, count + 300, 2)), 8, axis=1)
    hands *= [0.21 / hands.std(), 0.15 / hands.std()]
    head = follows * hands[94 : 94 + count] + sway[100 : 100 + count] * 0.004 / sway.std()
    hands = hands[100 : 100 + count]
    room, hand = (
        cv2.GaussianBlur(rng.standard_normal(size), (0, 0), blur)
        for size, blur in (((300, 400), 3), ((40, 26), 1.5))
    )
    room, hand = 130 + 25 * room / room.std(), 80 + 25 * hand / hand.std()
    pictures = []
    for at, to in zip(head * 100, (hands - head) * 100, strict=True):
        image = cv2.getRectSubPix(
            room.astype(np.float32), (128, 96), tuple(np.array([200.0, 150.0]) + at)
        )
        for off in (-26, 26):
            shift = np.array([[1, 0, 50.0 + off + to[0]], [0, 1, 48 + to[1]]])
            seen = cv2.warpAffine(np.ones(hand.shape), shift, (128, 96)) > 0.5
            image = np.where(seen, cv2.warpAffine(hand, shift, (128, 96)), image)
        pictures.append(cv2.resize(image, (32, 24), interpolation=cv2.INTER_AREA))
    return np.array(pictures) + rng.normal(0, 0.25, (count, 24, 32)), head


@pytest.mark.parametrize("seed", range(10))
@pytest.mark.parametrize("follows", [0.0, 0.5])
def test_hands_are_no_turn(seed, follows):
    pictures, head = with_hands(seed, follows)
    t_ns = np.arange(len(head)) * 1_000_000_000 // 30
    Ts = np.tile(np.eye(4), (len(head), 1, 1))
    turns = np.stack([-head[:, 1], head[:, 0], 0 * head[:, 0]], axis=1)
    Ts[:, :3, :3] = Rotation.from_rotvec(turns).as_matrix()
    K = np.array([[500.0, 0, 320], [0, 500, 240], [0, 0, 1]])
    view = View(t_ns, pictures.astype(np.float32), K, (480, 640))
    assert view_faults(view, MovingCamera(t_ns, Ts)).looks == {}


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
    rest = MovingCamera(t_ns, np.tile(Ts[:1], (len(Ts), 1, 1)))
    t_ns, images = moving_camera.images(0, SECONDS)
    view = View(t_ns, np.stack([thumbnail(i) for i in images]), moving_camera.K, (120, 160))
    assert view_faults(view, rest) == ViewFaults()
