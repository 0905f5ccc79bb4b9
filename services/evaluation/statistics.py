"""Success rates and classification metrics, and confidence intervals."""

import math
from dataclasses import dataclass
from statistics import NormalDist

import numpy as np

from dextouch.errors import InvalidInputError, ShapeError


@dataclass(frozen=True)
class Interval:
    """A confidence interval."""

    low: float
    high: float


def _check_confidence(confidence: float) -> None:
    if not 0 < confidence < 1:
        raise InvalidInputError(f"confidence: got {confidence}, expected between 0 and 1")


def area_under_roc(scores: np.ndarray, success: np.ndarray) -> float:
    """Probability that a success scores above a failure; ties count half.

    Args:
        scores: [n], higher for more certain success.
        success: [n] outcomes.

    Raises:
        InvalidInputError: only successes, or only failures.
    """
    positive, negative = _by_outcome(scores, success)
    return float((np.sign(positive[:, None] - negative[None, :]).mean() + 1) / 2)


def balanced_accuracy(decisions: np.ndarray, success: np.ndarray) -> float:
    """Mean of the shares of successes and of failures that were classified correctly.

    Raises:
        InvalidInputError: only successes, or only failures.
    """
    positive, negative = _by_outcome(np.asarray(decisions, dtype=bool), success)
    return float((positive.mean() + (~negative).mean()) / 2)


def _by_outcome(values: np.ndarray, success: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    values, positive = np.asarray(values), np.asarray(success, dtype=bool)
    if values.shape != positive.shape or values.ndim != 1 or positive.all() or not positive.any():
        raise InvalidInputError(
            f"judging: got {values.shape} scores, {positive.sum()} of {positive.shape} outcomes "
            "are successes; expected one each and both outcomes"
        )
    return values[positive], values[~positive]


def wilson_interval(successes: int | float, trials: int, *, confidence: float = 0.95) -> Interval:
    """Wilson score interval of a success rate, inside 0 … 1 (Wilson 1927).

    A trial that was repeated counts as one, with its share of successes.

    Raises:
        InvalidInputError: no trials, or more successes than trials.
    """
    _check_confidence(confidence)
    if trials < 1 or not 0 <= successes <= trials:
        raise InvalidInputError(
            f"Wilson interval: got {successes} successes of {trials} trials, "
            "expected at least one trial and 0 … trials successes"
        )
    z = NormalDist().inv_cdf(0.5 + confidence / 2)
    rate = successes / trials
    spread = z * math.sqrt(rate * (1 - rate) / trials + z * z / (4 * trials * trials))
    shrink = 1 + z * z / trials
    centre = rate + z * z / (2 * trials)
    return Interval(
        max(0.0, (centre - spread) / shrink) if successes else 0.0,
        min(1.0, (centre + spread) / shrink) if successes < trials else 1.0,
    )


def bootstrap_mean_interval(
    values: np.ndarray,
    generator: np.random.Generator,
    *,
    num_draws: int = 1000,
    confidence: float = 0.95,
) -> Interval:
    """Percentile interval of the mean of independent values [n].

    Raises:
        ShapeError: not one axis with at least one value.
    """
    _check_confidence(confidence)
    checked = np.asarray(values, dtype=np.float64)
    if checked.ndim != 1 or len(checked) == 0:
        raise ShapeError(f"bootstrap: got shape {checked.shape}, expected [n ≥ 1]")
    drawn = generator.integers(0, len(checked), (num_draws, len(checked)))
    return central_interval(checked[drawn].mean(axis=1), confidence=confidence)


def central_interval(draws: np.ndarray, *, confidence: float = 0.95) -> Interval:
    """Interval between quantiles of draws [n ≥ 1] that leaves equal shares on both sides."""
    low, high = np.quantile(draws, [(1 - confidence) / 2, (1 + confidence) / 2])
    return Interval(float(low), float(high))


def shortest_interval(draws: np.ndarray, *, confidence: float = 0.95) -> Interval:
    """The shortest interval that holds a share of draws [n ≥ 1], at least `confidence`."""
    ordered = np.sort(draws)
    held = math.ceil(confidence * len(ordered))
    first = int(np.argmin(ordered[held - 1 :] - ordered[: len(ordered) - held + 1]))
    return Interval(float(ordered[first]), float(ordered[first + held - 1]))


def interval_of_draws(figures: np.ndarray, *, confidence: float = 0.95) -> Interval | None:
    """Percentile interval of the figures [draws] of a bootstrap; undefined draws are NaN.

    Returns:
        The interval of the defined draws; None where more than half are undefined.

    Raises:
        ShapeError: not one axis with at least one draw.
    """
    _check_confidence(confidence)
    if figures.ndim != 1 or len(figures) == 0:
        raise ShapeError(f"bootstrap: got shape {figures.shape}, expected [draws ≥ 1]")
    defined = figures[np.isfinite(figures)]
    enough = 2 * len(defined) > len(figures)
    return central_interval(defined, confidence=confidence) if enough else None
