"""AbsRel against a plain double loop, and its alignment of the scale."""

import numpy as np
import pytest

from dextouch.errors import InvalidInputError
from dextouch.metrics.image import depth_error

RNG = np.random.default_rng(0)


def test_it_is_the_mean_relative_error_after_one_scale():
    true = RNG.uniform(0.3, 2.0, size=(3, 5, 7))
    predicted = true * 1.7 + RNG.normal(scale=0.05, size=true.shape)
    true[0, 0, 0], predicted[1, 2, 3] = np.inf, np.inf
    pairs = [
        (p, t)
        for p, t in zip(predicted.flat, true.flat, strict=True)
        if p < float("inf") and t < float("inf")
    ]
    ordered = [sorted(side) for side in zip(*pairs, strict=True)]
    middle = [
        (side[51] + side[50]) / 2 if len(side) % 2 == 0 else side[len(side) // 2]
        for side in ordered
    ]
    scale = middle[1] / middle[0]
    expected = sum(abs(scale * p - t) / t for p, t in pairs) / len(pairs)
    assert len(pairs) == 103
    assert depth_error(predicted_m=predicted, true_m=true) == pytest.approx(expected)


def test_a_wrong_scale_alone_is_no_error():
    true = RNG.uniform(0.3, 2.0, size=(4, 4))
    assert depth_error(predicted_m=3.0 * true, true_m=true) == pytest.approx(0.0, abs=1e-12)


def test_depths_that_cannot_be_compared_are_refused():
    far = np.full((2, 2), np.inf)
    with pytest.raises(InvalidInputError, match="at least one pixel"):
        depth_error(predicted_m=far, true_m=np.ones((2, 2)))
    with pytest.raises(InvalidInputError, match="positive depths"):
        depth_error(predicted_m=np.zeros((2, 2)), true_m=np.ones((2, 2)))
