"""Dynamic time warping against a plain recursion over all alignments, and its normalization."""

import math
from functools import cache

import numpy as np
import pytest

from dextouch.errors import InvalidInputError, ShapeError
from dextouch.metrics.trajectory import dynamic_time_warping, trajectory_accuracy

RNG = np.random.default_rng(0)


def by_recursion(a, b):
    """The definition, from the end: the cheapest of the three ways to have come here."""

    @cache
    def cost(i, j):
        here = math.dist(a[i], b[j])
        if i == 0 and j == 0:
            return here
        ways = [cost(k, m) for k, m in ((i - 1, j), (i, j - 1), (i - 1, j - 1)) if min(k, m) >= 0]
        return here + min(ways)

    return cost(len(a) - 1, len(b) - 1)


@pytest.mark.parametrize(("n", "m"), [(1, 1), (1, 6), (7, 7), (5, 11)])
def test_it_is_the_cheapest_alignment(n, m):
    a, b = RNG.normal(size=(n, 2)), RNG.normal(size=(m, 2))
    assert dynamic_time_warping(a, b) == pytest.approx(by_recursion(a, b))


def test_a_late_trajectory_costs_less_than_a_wrong_one():
    steps = np.arange(20.0)
    true = np.column_stack([steps, np.zeros(20)])
    late = np.column_stack([np.maximum(steps - 2, 0.0), np.zeros(20)])
    wrong = np.column_stack([steps, np.full(20, 2.0)])
    values = [trajectory_accuracy(predicted=p, true=true, tolerance=2.0) for p in (late, wrong)]
    # Two steps late: all but the last two points have an exact partner, which end 1 and 2 away.
    assert values == pytest.approx([math.exp(-3 / 40), math.exp(-1)])
    assert trajectory_accuracy(predicted=true, true=true, tolerance=2.0) == 1.0


def test_missing_points_are_interpolated_and_a_lost_body_counts_as_zero():
    true = np.column_stack([np.arange(12.0), np.zeros(12)])
    gaps = true.copy()
    gaps[3:7] = np.nan
    assert trajectory_accuracy(predicted=gaps, true=true, tolerance=1.0) == pytest.approx(1.0)
    gaps[1:] = np.nan
    assert trajectory_accuracy(predicted=gaps, true=true, tolerance=1.0) == 0.0


def test_what_cannot_be_compared_is_refused():
    true = np.zeros((4, 2))
    with pytest.raises(ShapeError, match=r"got shapes \(3, 2\) and \(4, 2\)"):
        trajectory_accuracy(predicted=true[:3], true=true, tolerance=1.0)
    with pytest.raises(InvalidInputError, match="1 missing true points"):
        trajectory_accuracy(
            predicted=true, true=np.vstack([true[:3], [[np.nan, 0]]]), tolerance=1.0
        )
