"""Bootstrap draws of all figures at once against the plain figures of each draw."""

import numpy as np
import pytest
from scipy.stats import mannwhitneyu

from benchmarks.evaluator.drawn import (
    area_under_roc_of_draws,
    balanced_accuracy_of_draws,
    interval_of_draws,
    mean_of_draws,
    rates_of_draws,
)
from dextouch.errors import ShapeError
from dextouch.metrics.policy import mmrv, pearson
from services.evaluation.statistics import mmrv_of_draws, pearson_of_draws, start_counts


def _drawn_starts(counts: np.ndarray) -> np.ndarray:
    return np.repeat(np.arange(len(counts)), counts.astype(int))


def test_agreement_of_each_draw_is_that_of_the_drawn_starts():
    rng = np.random.default_rng(3)
    real, imagined = (rng.random((2, 5, 8)) < 0.5).astype(float)
    counts = start_counts(8, rng, num_draws=50)
    rates = [rates_of_draws(x, np.ones_like(x), counts) for x in (real, imagined)]
    together = {"pearson": pearson_of_draws(*rates), "mmrv": mmrv_of_draws(*rates)}
    for draw, row in enumerate(counts):
        columns = _drawn_starts(row)
        pair = {"real": real[:, columns].mean(1), "imagined": imagined[:, columns].mean(1)}
        assert together["pearson"][draw] == pytest.approx(pearson(**pair), nan_ok=True)
        assert together["mmrv"][draw] == pytest.approx(mmrv(**pair, ties="simpler"))


def test_judging_of_each_draw_is_that_of_the_drawn_rollouts():
    rng = np.random.default_rng(4)
    start = np.repeat(np.arange(6), 5)
    scores, success = rng.integers(0, 4, 30) / 3, rng.random(30) < 0.5
    counts = start_counts(6, rng, num_draws=40)
    areas = area_under_roc_of_draws(scores, success, start, counts)
    balanced = balanced_accuracy_of_draws(scores > 0.5, success, start, counts)
    means = mean_of_draws(scores, start, counts)
    for draw, row in enumerate(counts):
        rows = np.concatenate([np.flatnonzero(start == s) for s in _drawn_starts(row)])
        wins, losses = scores[rows][success[rows]], scores[rows][~success[rows]]
        area = mannwhitneyu(wins, losses).statistic / (len(wins) * len(losses))
        assert areas[draw] == pytest.approx(area)
        assert balanced[draw] == pytest.approx(((wins > 0.5).mean() + (losses <= 0.5).mean()) / 2)
        assert means[draw] == pytest.approx(scores[rows].mean())


def test_area_under_roc_with_ties_by_hand():
    # Wins 0.9 and 0.5, losses 0.5 and 0.1: pairs count 1, 1, 1/2, 1.
    scores, success = np.array([0.9, 0.5, 0.5, 0.1]), np.array([1, 1, 0, 0])
    area = area_under_roc_of_draws(scores, success, np.zeros(4, int), np.ones((1, 1)))
    assert area == pytest.approx([3.5 / 4])


def test_draws_without_both_outcomes_are_undefined():
    scores, success, start = np.array([0.9, 0.1]), np.array([1, 0]), np.array([0, 1])
    counts = np.array([[2.0, 0.0], [1.0, 1.0]])
    assert np.isnan(area_under_roc_of_draws(scores, success, start, counts)).tolist() == [
        True,
        False,
    ]
    assert np.isnan(balanced_accuracy_of_draws(scores, success, start, counts))[0]
    assert np.isnan(pearson_of_draws(np.ones((1, 3)), np.eye(1, 3))).all()
    assert np.isnan(pearson_of_draws(np.eye(2), np.eye(2))).all()
    assert np.isnan(mmrv_of_draws(np.ones((2, 1)), np.ones((2, 1)))).all()


def test_an_interval_of_mostly_undefined_draws_is_none():
    draws = np.full(10, np.nan)
    draws[:5] = 0.5
    assert interval_of_draws(draws) is None
    draws[5] = 0.5
    assert interval_of_draws(draws) is not None
    with pytest.raises(ShapeError, match="draws"):
        interval_of_draws(np.empty(0))
