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
@pytest.mark.parametrize("fault", ["black", "half", "torn", "older", "mixed", "alternating"])
def test_faults_are_found_where_they_are(seed, fault, monkeypatch):
    _, images = moving_camera.images(seed, SECONDS, calm=60)
    _, others = moving_camera.images(seed + 20, SECONDS)
    name, expected = fault, AT
    for at in AT:
        if fault == "black":
            images[at] = np.random.default_rng(at).integers(0, 6, images[at].shape)
        elif fault == "half":
            name, images[at] = "torn", half_decoded(images[at], monkeypatch)
        elif fault == "torn":
            images[at, 50:] = others[at, 50:]
        elif fault == "older":
            images[at] = images[at - 8]
        elif fault == "mixed":
            images[[at, at + 1]], expected = (
                images[[at + 1, at]],
                sorted([*AT, *(a + 1 for a in AT)]),
            )
    if fault == "alternating":
        images[1::2], name, expected = others[1::2], "mixed", range(len(images))
    faults = found(images)
    # Exchanged images are found where much moves.
    least = 0.3 if fault == "mixed" else 0.6
    assert len(set(faults[name]) & set(expected)) >= least * len(expected)
    assert set().union(*faults.values()) <= {at + by for at in expected for by in (0, 1)}


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
