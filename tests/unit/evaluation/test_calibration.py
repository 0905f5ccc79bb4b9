"""Calibration figures by hand, and temperatures that are known because we made the outcomes."""

import numpy as np
import pytest

from dextouch.errors import InvalidInputError
from services.evaluation.calibration import (
    Calibration,
    Reliability,
    brier,
    expected_calibration_error,
    fit_calibration,
    sigmoid,
    undecided_band,
)


def test_expected_calibration_error_by_hand():
    # Bin 0.2 … 0.3: said 0.25 twice, came true once; bin 0.9 … 1: said 0.9 and 1.0, once.
    told, came = np.array([0.25, 0.25, 0.9, 1.0]), np.array([1, 0, 1, 0])
    by_hand = 0.5 * abs(0.25 - 0.5) + 0.5 * abs(0.95 - 0.5)
    assert expected_calibration_error(told, came) == pytest.approx(by_hand)
    assert brier(told, came) == pytest.approx((0.75**2 + 0.25**2 + 0.1**2 + 1) / 4)


def test_errors_in_one_bin_cancel_and_in_two_bins_do_not():
    assert expected_calibration_error(np.array([0.5, 0.5]), np.array([1, 0])) == 0
    assert expected_calibration_error(np.array([0.4, 0.6]), np.array([1, 0])) == pytest.approx(0.6)


def test_a_known_temperature_and_bias_are_found():
    rng = np.random.default_rng(1)
    honest = rng.normal(0.0, 2.0, 20_000)
    came = rng.random(len(honest)) < 1 / (1 + np.exp(-honest))
    # A judge three times too sure, and shifted.
    said = 3.0 * honest + 1.5
    found = fit_calibration(said, came)
    assert found.temperature == pytest.approx(3.0, rel=0.05)
    assert found.bias == pytest.approx(-0.5, abs=0.05)
    before = Reliability.of(sigmoid(said), came)
    after = Reliability.of(found.probabilities(said), came)
    assert before.expected_calibration_error > 0.05
    assert after.expected_calibration_error < 0.015
    assert after.brier < before.brier


def test_separable_endings_stay_finite():
    odds = np.array([-4.0, -3.0, 3.0, 5.0])
    found = fit_calibration(odds, odds > 0)
    assert 0.5 < found.temperature < 4
    told = found.probabilities(odds)
    assert (told > 0).all()
    assert (told < 1).all()


def test_a_judge_that_is_always_wrong_knows_nothing():
    rng = np.random.default_rng(2)
    odds = rng.normal(size=400)
    told = fit_calibration(odds, odds < 0).probabilities(odds)
    assert np.ptp(told) < 0.01
    assert told.mean() == pytest.approx((odds < 0).mean(), abs=0.02)


def test_the_band_leaves_the_allowed_risk():
    # 98 sure endings, all right; four unsure ones, of which two are wrong.
    told = np.array([0.99] * 49 + [0.01] * 49 + [0.52, 0.55, 0.46, 0.45])
    came = np.array([1] * 49 + [0] * 49 + [0, 1, 0, 1])
    # All decided: (2 + 1) / 103. Beyond 0.02: (1 + 1) / 102. Beyond 0.05: (0 + 1) / 99.
    for risk, band in ((0.03, 0.0), (0.02, 0.02), (0.015, 0.05)):
        assert undecided_band(told, came, risk=risk) == pytest.approx(band)


def test_few_endings_promise_nothing():
    assert undecided_band(np.array([0.9, 0.1]), np.array([1, 0]), risk=0.05) == 0.45


def test_one_outcome_is_refused():
    with pytest.raises(InvalidInputError, match="both outcomes"):
        fit_calibration(np.ones(3), np.ones(3))
    with pytest.raises(InvalidInputError, match="at least one"):
        expected_calibration_error(np.array([]), np.array([]))


def test_no_calibration_is_the_plain_sigmoid():
    assert Calibration().probabilities(np.array([0.0, np.log(3)])) == pytest.approx([0.5, 0.75])
