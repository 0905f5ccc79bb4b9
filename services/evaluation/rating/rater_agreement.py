"""Agreement between raters: Krippendorff's alpha, intraclass correlation, bias of each rater.

Ratings are arrays [rollouts, raters] with NaN where a rater did not rate. Read alpha first: below
0.667 even tentative conclusions are not supported (Krippendorff, Content Analysis, 2004, p. 241).
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final, Literal

import numpy as np
from jaxtyping import Float64

from dextouch.errors import InvalidInputError, ShapeError
from services.evaluation.resampling import start_counts
from services.evaluation.statistics import Interval, central_interval

Level = Literal["nominal", "interval"]
LEAST_ALPHA: Final = 0.667


@dataclass(frozen=True)
class RaterBias:
    """Mean difference of a rater's scores from the mean of the others on the same rollouts."""

    rater: str
    bias: float
    interval: Interval
    num_rollouts: int


def krippendorff_alpha(ratings: Float64[np.ndarray, "_ _"], *, level: Level) -> float:
    """Krippendorff's alpha: 1 for perfect agreement, 0 for that of chance.

    `1 − D_o / D_e` with the observed and expected disagreement of pairs of ratings (Krippendorff,
    "Computing Krippendorff's Alpha-Reliability", 2011). Rollouts with fewer than two ratings do not
    count.

    Args:
        ratings: [rollouts, raters], NaN where missing.
        level: "nominal" for marks that are equal or not; "interval" for scores, whose squared
            difference counts.

    Returns:
        Alpha; NaN where it is undefined: no rollout with two ratings, or all ratings equal.

    Raises:
        InvalidInputError: an infinite rating.
    """
    known = _checked(ratings)
    rows = known.sum(axis=1) >= 2
    values, known = np.where(known, ratings, 0.0)[rows], known[rows]
    pooled = values[known]
    if len(pooled) == 0:
        return math.nan
    observed = sum(
        _disagreement(row[there], level) / (there.sum() - 1)
        for row, there in zip(values, known, strict=True)
    )
    expected = _disagreement(pooled, level) / (len(pooled) - 1)
    return float(1 - observed / expected) if expected > 0 else math.nan


def _disagreement(values: np.ndarray, level: Level) -> float:
    """Sum over ordered pairs of values [n] of their disagreement, divided by one."""
    if level == "interval":
        centred = values - values.mean()
        return float(2 * len(values) * np.sum(centred**2))
    _, counts = np.unique(values, return_counts=True)
    return float(len(values) ** 2 - np.sum(counts**2))


def intraclass_correlation(ratings: Float64[np.ndarray, "_ _"]) -> float:
    """ICC(2,k): reliability of the mean of all raters, each of whom rated every rollout.

    Two-way random effects, absolute agreement (Shrout and Fleiss 1979). Rollouts that a rater did
    not rate do not count.

    Args:
        ratings: [rollouts, raters], NaN where missing.

    Returns:
        The coefficient; NaN for fewer than two raters or two complete rollouts, or without spread.

    Raises:
        InvalidInputError: an infinite rating.
    """
    complete = ratings[_checked(ratings).all(axis=1)]
    num_rollouts, num_raters = complete.shape
    if min(num_rollouts, num_raters) < 2:
        return math.nan
    centred = complete - complete.mean()
    rollouts, raters = centred.mean(axis=1), centred.mean(axis=0)
    error = centred - rollouts[:, None] - raters
    between = num_raters * np.sum(rollouts**2) / (num_rollouts - 1)
    columns = num_rollouts * np.sum(raters**2) / (num_raters - 1)
    residual = np.sum(error**2) / ((num_rollouts - 1) * (num_raters - 1))
    scale = between + (columns - residual) / num_rollouts
    return float((between - residual) / scale) if scale > 0 else math.nan


def rater_biases(
    raters: Sequence[str],
    ratings: Float64[np.ndarray, "_ _"],
    generator: np.random.Generator,
    *,
    num_draws: int = 1000,
) -> list[RaterBias]:
    """Bias of each rater who shares rollouts with others, with a bootstrap over rollouts.

    Raises:
        ShapeError: names and ratings differ in number.
        InvalidInputError: an infinite rating.
    """
    known = _checked(ratings)
    if len(raters) != ratings.shape[1]:
        raise ShapeError(f"ratings: got {len(raters)} names for {ratings.shape[1]} raters")
    found = []
    for column, rater in enumerate(raters):
        others = np.delete(ratings, column, axis=1)
        shared = known[:, column] & np.isfinite(others).any(axis=1)
        if not shared.any():
            continue
        apart = ratings[shared, column] - np.nanmean(others[shared], axis=1)
        counts = start_counts(len(apart), generator, num_draws=num_draws)
        interval = central_interval(counts @ apart / len(apart))
        found.append(RaterBias(rater, float(apart.mean()), interval, len(apart)))
    return found


def _checked(ratings: np.ndarray) -> np.ndarray:
    if np.isinf(ratings).any():
        raise InvalidInputError("ratings: got an infinite rating; expected numbers, NaN if missing")
    return np.isfinite(ratings)
