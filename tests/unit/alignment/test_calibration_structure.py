"""Structure of residuals against tests of other libraries."""

import numpy as np
import pytest
from scipy.stats import f_oneway, kstest

from services.alignment.calibration.motion import structure


def test_groups_are_told_apart_as_by_the_analysis_of_variance():
    rng = np.random.default_rng(0)
    sizes, means = [7, 5, 9], [0.0, 0.4, -0.3]
    groups = [mean + rng.normal(size=size) for size, mean in zip(sizes, means, strict=True)]
    label = np.repeat(np.arange(3), sizes)
    functions = (label[:, None] == np.arange(3)).astype(float)
    found = structure(np.concatenate(groups), np.ones((len(label), 1)), functions)
    expected = f_oneway(*groups)
    assert found.ratio == pytest.approx(expected.statistic)
    assert found.p_value == pytest.approx(expected.pvalue)
    assert found.freedom == 18


def test_coefficients_are_those_of_least_squares():
    rng = np.random.default_rng(1)
    fitted, functions = rng.normal(size=(40, 3)), rng.normal(size=(40, 2)) * [1e3, 1e-3]
    residuals = functions @ [2e-3, 5e3] + fitted @ [1.0, 2.0, 3.0] + 0.1 * rng.normal(size=40)
    both, squares, *_ = np.linalg.lstsq(np.column_stack([fitted, functions]), residuals, rcond=None)
    found = structure(residuals, fitted, functions)
    np.testing.assert_allclose(found.coefficients, both[3:])
    assert found.rest * found.freedom == pytest.approx(squares[0])


def test_independent_errors_have_uniform_probabilities():
    rng = np.random.default_rng(2)
    chances = [
        structure(rng.normal(size=60), rng.normal(size=(60, 4)), rng.normal(size=(60, 5))).p_value
        for _ in range(400)
    ]
    assert kstest(chances, "uniform").pvalue > 0.01


def test_functions_that_the_fit_has_explained_say_nothing():
    rng = np.random.default_rng(3)
    fitted = rng.normal(size=(30, 2))
    found = structure(rng.normal(size=30), fitted, fitted @ rng.normal(size=(2, 3)))
    assert found.explained == 0
    assert found.p_value == 1
