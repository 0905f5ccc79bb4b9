"""Intervals against published values, coverage, and the undefined cases."""

import numpy as np
import pytest
from scipy.stats import mannwhitneyu, norm

from dextouch.errors import InvalidInputError
from services.evaluation.statistics import (
    area_interval,
    area_under_roc,
    balanced_accuracy,
    bootstrap_mean_interval,
    shortest_interval,
    wilson_interval,
)


def test_wilson_of_nine_in_ten():
    interval = wilson_interval(9, 10)
    assert (interval.low, interval.high) == pytest.approx((0.596, 0.982), abs=5e-4)


@pytest.mark.parametrize(("successes", "trials"), [(0, 1), (0, 10), (10, 10), (5, 10), (1, 1000)])
def test_wilson_stays_inside_and_around_the_rate(successes, trials):
    interval = wilson_interval(successes, trials)
    assert 0 <= interval.low <= successes / trials <= interval.high <= 1
    mirrored = wilson_interval(trials - successes, trials)
    assert (mirrored.low, mirrored.high) == pytest.approx((1 - interval.high, 1 - interval.low))


def test_wilson_solves_its_equation():
    p, n, z = 0.3, 20, 1.959964
    interval = wilson_interval(6, 20)
    for bound in (interval.low, interval.high):
        assert (bound - p) ** 2 == pytest.approx(z**2 * bound * (1 - bound) / n, rel=1e-5)


@pytest.mark.parametrize("true_area", [0.75, 0.9, 0.97])
@pytest.mark.parametrize(("num_successes", "num_failures"), [(5, 15), (12, 12)])
def test_intervals_of_areas_hold_the_true_one(true_area, num_successes, num_failures):
    """Of normal scores, whose area follows from their distance."""
    draw, distance = np.random.default_rng(0), np.sqrt(2) * norm.ppf(true_area)
    outcome = np.repeat([True, False], [num_successes, num_failures])
    held = 0
    for _ in range(400):
        scores = draw.normal(size=len(outcome)) + distance * outcome
        interval = area_interval(area_under_roc(scores, outcome), num_successes, num_failures)
        held += interval.low <= true_area <= interval.high
    assert 0.92 < held / 400 < 0.99


def test_the_interval_of_a_perfect_area_has_a_width_and_is_mirrored():
    perfect, wrong = area_interval(1.0, 8, 5), area_interval(0.0, 8, 5)
    assert perfect.high == 1.0
    assert 0.6 < perfect.low < 0.8
    assert (wrong.low, wrong.high) == pytest.approx((0.0, 1 - perfect.low), abs=1e-6)


@pytest.mark.parametrize(("successes", "trials"), [(0, 0), (3, 2), (-1, 5)])
def test_impossible_counts_are_refused(successes, trials):
    with pytest.raises(InvalidInputError, match="Wilson"):
        wilson_interval(successes, trials)


def test_bootstrap_of_the_mean_covers():
    rng = np.random.default_rng(1)
    hits = 0
    for _ in range(200):
        interval = bootstrap_mean_interval(rng.normal(3.0, 1.0, 30), rng, num_draws=400)
        hits += interval.low <= 3.0 <= interval.high
    assert 175 <= hits <= 199


def test_bootstrap_of_many_values_is_the_normal_interval():
    # z from a table of the normal distribution; a bootstrap's sigma is that of the drawn values.
    z = 1.960
    values = np.random.default_rng(5).normal(3.0, 2.0, 400)
    interval = bootstrap_mean_interval(values, np.random.default_rng(6), num_draws=20_000)
    sigma = values.std() / 20
    assert interval.low == pytest.approx(values.mean() - z * sigma, abs=0.08 * sigma)
    assert interval.high == pytest.approx(values.mean() + z * sigma, abs=0.08 * sigma)


def test_area_under_roc_against_scipy():
    rng = np.random.default_rng(5)
    for _ in range(20):
        scores, success = rng.integers(0, 6, 30) / 5, rng.random(30) < 0.4
        wins, losses = scores[success], scores[~success]
        area = mannwhitneyu(wins, losses).statistic / (len(wins) * len(losses))
        assert area_under_roc(scores, success) == pytest.approx(area)


def test_balanced_accuracy_by_hand():
    success = np.array([True] * 8 + [False] * 2)
    assert balanced_accuracy(np.ones(10), success) == 0.5
    assert balanced_accuracy(np.array([1] * 6 + [0] * 3 + [1]), success) == 0.625
    for measure in (balanced_accuracy, area_under_roc):
        with pytest.raises(InvalidInputError, match="both outcomes"):
            measure(np.ones(3), np.ones(3))


def test_the_shortest_interval_reaches_the_bound_where_draws_crowd():
    draws = 1 - np.random.default_rng(3).exponential(0.1, 10_000)
    interval = shortest_interval(draws)
    # 95 % of an exponential distribution lie below 3 times its mean.
    assert (interval.low, interval.high) == pytest.approx((0.7, 1.0), abs=0.02)


@pytest.mark.parametrize(
    ("confidence", "high"), [(0.8, 7.0), (0.81, 8.0), (0.9, 8.0), (0.91, 99.0)]
)
def test_the_shortest_interval_holds_at_least_its_share(confidence, high):
    """Of ten draws: eight, nine and all of them."""
    draws = np.array([99.0, 8, 7, 6, 5, 4, 3, 2, 1, 0])
    interval = shortest_interval(draws, confidence=confidence)
    assert (interval.low, interval.high) == (0.0, high)
