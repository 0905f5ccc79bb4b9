"""Images that no working camera takes, as other programs make or fill them in."""

import io

import numpy as np
import pytest
from PIL import Image, ImageFile

from dextouch.streams import image_faults, thumbnail
from tests.unit.streams import moving_camera

SECONDS = 4
AT = [31, 62, 90]


def encoded(image):
    data = io.BytesIO()
    Image.fromarray(image).save(data, "JPEG", quality=80)
    return data.getvalue()


def reencoded(images):
    return [np.asarray(Image.open(io.BytesIO(encoded(image)))) for image in images]


def found(images):
    faults = image_faults(np.stack([thumbnail(image) for image in reencoded(images)]))
    return {name: np.flatnonzero(marked).tolist() for name, marked in faults.items()}


def half_decoded(image, monkeypatch):
    """As libjpeg, told to go on, fills in the rest: the driver of some cameras."""
    monkeypatch.setattr(ImageFile, "LOAD_TRUNCATED_IMAGES", True)
    data = encoded(image)
    return np.asarray(Image.open(io.BytesIO(data[: len(data) // 2])))


@pytest.mark.parametrize("seed", range(4))
def test_ordinary_images_have_no_fault(seed):
    _, images = moving_camera.images(seed, SECONDS)
    assert found(images) == {}
    # Nor has what stands still, or goes back the way it came.
    assert found(np.repeat(images[:1], 60, axis=0)) == {}
    assert found(np.concatenate([images[:40], images[39::-1]])) == {}


@pytest.mark.parametrize("seed", range(3))
@pytest.mark.parametrize("fault", ["black", "half", "torn"])
def test_faults_are_found_where_they_are(seed, fault, monkeypatch):
    _, images = moving_camera.images(seed, SECONDS, calm=60)
    _, others = moving_camera.images(seed + 20, SECONDS)
    name = fault
    for at in AT:
        if fault == "black":
            images[at] = np.random.default_rng(at).integers(0, 6, images[at].shape)
        elif fault == "half":
            name, images[at] = "torn", half_decoded(images[at], monkeypatch)
        elif fault == "torn":
            images[at, 50:] = others[at, 50:]
    faults = found(images)
    assert len(set(faults[name]) & set(AT)) >= 0.6 * len(AT)
    assert set().union(*faults.values()) <= {at + by for at in AT for by in (0, 1)}


def repeated(kind, seed, count=300):
    """Pictures of what comes again before a camera at rest, at 30 Hz."""
    rng = np.random.default_rng(seed)
    room, start = rng.uniform(60, 180, (24, 32)), rng.uniform(0, 2 * np.pi)
    y, x = np.mgrid[-12:12, -16:16]
    pictures = []
    for at in range(count):
        phase = start + 2 * np.pi * at / 30 * {"tap": 4, "stir": 1.5, "wave": 5}.get(kind, 2.5)
        if kind == "tap":
            up = 4 * np.clip(1.5 * np.sin(phase) + 0.5, 0, 1)
            shown = np.clip(y + up - 3, 0, 1) * (np.abs(x) < 5)
        elif kind in ("stir", "wave"):
            by_x, by_y = (7, 0) if kind == "wave" else (4, 3)
            far = np.hypot(x - by_x * np.cos(phase), y - by_y * np.sin(phase))
            shown = np.clip(4.5 - far, 0, 1)
        elif kind == "wheel":
            shown = (np.hypot(x, y) < 9) & (np.cos(np.arctan2(y, x) - phase) > 0.5)
        else:
            down = 2 * (rng.random(32) < 0.15)
            shown = (y > 2 - down) & (x % 3 > 0)
        pictures.append(room + (45 - room) * shown + rng.normal(0, 0.25, room.shape))
    return np.array(pictures, dtype=np.float32)


@pytest.mark.parametrize("kind", ["tap", "stir", "wave", "wheel", "type"])
def test_what_comes_again_is_no_fault(kind):
    for seed in range(20):
        assert image_faults(repeated(kind, seed)) == {}


def test_a_hand_that_shows_in_one_image_tears_none():
    pictures = repeated("stir", 0)
    pictures[30:300:30, 14:, 8:22] = 45
    assert image_faults(pictures) == {}


@pytest.mark.parametrize("rate_hz", [24, 25, 28.6, 29.97, 39.8, 40, 50, 60])
@pytest.mark.parametrize("is_rolling", [False, True])
def test_light_that_flickers_tears_no_image(rate_hz, is_rolling):
    row_s = np.arange(24)[:, None] / 24 * 0.025 * is_rolling
    for light_hz, strength in ((100, 0.08), (100, 0.25), (120, 0.08), (120, 0.25)):
        time_s = np.arange(300)[:, None, None] / rate_hz + row_s
        light = 1 + strength * np.sin(2 * np.pi * light_hz * time_s)
        pictures = repeated("stir", light_hz) * light
        assert set(image_faults(pictures.astype(np.float32))) <= {"pumping"}


def test_light_that_is_off_for_a_third_of_a_take_is_no_fault():
    pictures = repeated("tap", 0)
    pictures[100:200] = 3
    assert image_faults(pictures) == {}
    pictures = repeated("tap", 0)
    pictures[200:] = 3
    assert image_faults(pictures) == {}
    pictures[:150] = 3
    assert image_faults(pictures) == {}


@pytest.mark.parametrize("rate_hz", [1.5, 4.0])
def test_light_that_pumps_is_no_motion(rate_hz):
    _, images = moving_camera.images(0, SECONDS)
    light = 1 + 0.25 * np.sin(2 * np.pi * rate_hz * np.arange(len(images)) / 30)
    faults = found(np.clip(images * light[:, None, None, None], 0, 255).astype(np.uint8))
    assert list(faults) == ["pumping"]
    assert len(faults["pumping"]) > 0.2 * len(images)
    # A lamp that is switched once is none.
    images[60:] = images[60:] // 2
    assert found(images) == {}
