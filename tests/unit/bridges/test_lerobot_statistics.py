"""Statistics of a dataset against the plain computation with numpy."""

from types import SimpleNamespace

import numpy as np
import pytest

from dextouch.bridges.lerobot.layout import (
    QUANTILES,
    SAMPLED_SIDE_PX,
    combine,
    image_statistics,
    sampled_images,
    value_statistics,
)

PLAIN = {"min": np.min, "max": np.max, "mean": np.mean, "std": np.std}


def test_values_are_those_of_numpy():
    values = np.random.default_rng(1).normal(size=(40, 6)).astype(np.float32)
    got = value_statistics(values)
    for name, plain in PLAIN.items():
        np.testing.assert_allclose(got[name], plain(values.astype(float), axis=0))
    for name, q in QUANTILES.items():
        np.testing.assert_allclose(got[name], np.quantile(values.astype(float), q, axis=0))
    assert got["count"].tolist() == [40]


def test_leading_axes_are_pooled_and_single_numbers_have_one():
    values = np.random.default_rng(2).normal(size=(10, 2, 5))
    pooled = value_statistics(values)
    np.testing.assert_allclose(pooled["mean"], values.reshape(-1, 5).mean(axis=0))
    assert pooled["count"].tolist() == [10]
    assert value_statistics(np.arange(7))["max"].tolist() == [6.0]
    assert value_statistics(np.array([[True, False], [True, True]]))["mean"].tolist() == [1.0, 0.5]


def test_images_are_those_of_numpy():
    rng = np.random.default_rng(3)
    images = rng.integers(10, 200, size=(5, 12, 14, 3), dtype=np.uint8)
    got = image_statistics(images)
    pixels = images.reshape(-1, 3) / 255
    for name, plain in PLAIN.items():
        np.testing.assert_allclose(got[name][:, 0, 0], plain(pixels, axis=0), atol=1e-12)
    for name, q in QUANTILES.items():
        plain = np.quantile(pixels, q, axis=0, method="inverted_cdf")
        np.testing.assert_allclose(got[name][:, 0, 0], plain)
    assert got["mean"].shape == (3, 1, 1)
    assert got["count"].tolist() == [5]


def test_large_images_are_thinned_out():
    image = np.zeros((2, 2 * SAMPLED_SIDE_PX, 3), dtype=np.uint8)
    image[:, 1::2] = 255
    image[1] = 255
    assert image_statistics([image])["max"].max() == 0


@pytest.mark.parametrize("parts", [(10, 30), (1, 5), (7, 7)])
def test_two_parts_together_are_the_whole(parts):
    rng = np.random.default_rng(4)
    first, second = (rng.normal(k, 1 + k, size=(n, 4)) for k, n in enumerate(parts))
    got = combine(combine(None, value_statistics(first)), value_statistics(second))
    whole = np.concatenate([first, second])
    for name, plain in PLAIN.items():
        np.testing.assert_allclose(got[name], plain(whole, axis=0), atol=1e-12)
    assert got["count"].tolist() == [sum(parts)]
    weights = np.array(parts) / sum(parts)
    for name, q in QUANTILES.items():
        each = [np.quantile(part, q, axis=0) for part in (first, second)]
        np.testing.assert_allclose(got[name], weights @ np.stack(each))


class Camera:
    """Reader whose image k holds the number k."""

    def __init__(self, unit):
        self.streams = {"camera": SimpleNamespace(unit=unit)}

    def images_at(self, name, indices):
        return np.asarray(indices)[:, None]


@pytest.mark.parametrize(
    ("unit", "indices", "expected"),
    [
        ("jpeg", range(3), [0, 1, 2]),
        ("rgb8", [4, 4, 5], [4, 5]),
        ("h264", range(3, 30), [3, 8, 16, 24]),
    ],
)
def test_sampled_images_are_spread_over_all(unit, indices, expected):
    found = sampled_images.__wrapped__(Camera(unit), "camera", np.array(indices))
    assert [int(image[0]) for image in found] == expected
    many = list(sampled_images.__wrapped__(Camera("jpeg"), "camera", np.arange(1000)))
    assert (len(many), int(many[-1][0])) == (100, 999)
