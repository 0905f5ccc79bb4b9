"""PSNR and SSIM of images against closed forms and a plain double loop."""

import numpy as np
import pytest

from dextouch.errors import NonFiniteError, ShapeError
from dextouch.metrics.image import MAX_PSNR_DB, psnr, ssim

rng = np.random.default_rng(5)
IMAGES = rng.integers(0, 256, (3, 20, 24, 3), dtype=np.uint8)


def test_psnr_of_a_known_error():
    true = np.full((2, 8, 8, 3), 100, dtype=np.uint8)
    assert psnr(predicted=true + np.uint8(5), true=true) == pytest.approx(20 * np.log10(255 / 5))


def test_psnr_is_the_mean_over_images():
    true = np.zeros((2, 4, 4, 3), dtype=np.uint8)
    predicted = true.copy()
    predicted[0] += 1
    predicted[1] += 16
    expected = (20 * np.log10(255) + 20 * np.log10(255 / 16)) / 2
    assert psnr(predicted=predicted, true=true) == pytest.approx(expected)


def test_equal_images_are_capped_and_similar():
    assert psnr(predicted=IMAGES, true=IMAGES) == MAX_PSNR_DB
    assert ssim(predicted=IMAGES, true=IMAGES) == pytest.approx(1.0)


def test_unsigned_subtraction_does_not_wrap():
    dark, bright = np.zeros((4, 4, 3), np.uint8), np.full((4, 4, 3), 255, np.uint8)
    assert psnr(predicted=dark, true=bright) == pytest.approx(0.0)


def test_ssim_of_flat_images_is_the_luminance_term():
    a, b, c1 = 60.0, 180.0, (0.01 * 255) ** 2
    images = [np.full((16, 16, 3), v) for v in (a, b)]
    expected = (2 * a * b + c1) / (a * a + b * b + c1)
    assert ssim(predicted=images[0], true=images[1]) == pytest.approx(expected)


def test_ssim_equals_the_plain_definition():
    true = IMAGES[0, :14, :13].astype(float)
    predicted = np.clip(true + rng.normal(0, 25, true.shape), 0, 255)
    axis = np.arange(11) - 5
    kernel = np.exp(-(axis[:, None] ** 2 + axis[None, :] ** 2) / (2 * 1.5**2))
    kernel /= kernel.sum()
    c1, c2 = (0.01 * 255) ** 2, (0.03 * 255) ** 2
    values = []
    for row in range(4):
        for column in range(3):
            for colour in range(3):
                a = predicted[row : row + 11, column : column + 11, colour]
                b = true[row : row + 11, column : column + 11, colour]
                mean_a, mean_b = (kernel * a).sum(), (kernel * b).sum()
                var_a = (kernel * (a - mean_a) ** 2).sum()
                var_b = (kernel * (b - mean_b) ** 2).sum()
                cov = (kernel * (a - mean_a) * (b - mean_b)).sum()
                values.append(
                    (2 * mean_a * mean_b + c1)
                    * (2 * cov + c2)
                    / ((mean_a**2 + mean_b**2 + c1) * (var_a + var_b + c2))
                )
    assert ssim(predicted=predicted, true=true) == pytest.approx(np.mean(values), abs=1e-9)


def test_noise_lowers_both():
    true = np.tile(np.linspace(0, 255, 32), (32, 1))[..., None].repeat(3, -1)
    little, much = (true + rng.normal(0, s, true.shape) for s in (2, 20))
    assert psnr(predicted=little, true=true) > psnr(predicted=much, true=true) + 15
    assert ssim(predicted=little, true=true) > ssim(predicted=much, true=true) + 0.1


@pytest.mark.parametrize("measure", [psnr, ssim])
def test_bad_images_are_refused(measure):
    with pytest.raises(ShapeError, match="same shape"):
        measure(predicted=IMAGES, true=IMAGES[:, :-1])
    with pytest.raises(ShapeError, match=r"n, n, 3"):
        measure(predicted=IMAGES[..., :1], true=IMAGES[..., :1])
    with pytest.raises(ShapeError, match="not empty"):
        measure(predicted=IMAGES[:0], true=IMAGES[:0])
    broken = IMAGES.astype(float)
    broken[0, 0, 0, 0] = np.nan
    with pytest.raises(NonFiniteError, match="1 values"):
        measure(predicted=broken, true=IMAGES)


def test_images_smaller_than_the_window_are_refused():
    with pytest.raises(ShapeError, match="at least 11 by 11"):
        ssim(predicted=IMAGES[:, :10], true=IMAGES[:, :10])
