"""Success rates, classification metrics and agreement figures with confidence intervals."""

import math
from dataclasses import dataclass
from statistics import NormalDist

import numpy as np

from dextouch.errors import InvalidInputError, ShapeError
from services.evaluation.resampling import MEASURES, rates_of_draws, start_counts


@dataclass(frozen=True)
class Interval:
    """A confidence interval."""

    low: float
    high: float


@dataclass(frozen=True)
class AgreementInterval:
    """Confidence interval of an agreement figure.

    `interval` is None if too few draws were defined; `undefined_share` is the share of draws
    without a value (all scores of one side equal).
    """

    interval: Interval | None
    undefined_share: float


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


def wilson_interval(successes: int, trials: int, *, confidence: float = 0.95) -> Interval:
    """Wilson score interval of a success rate, inside 0 … 1 (Wilson 1927).

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
    return _percentiles(checked[drawn].mean(axis=1), confidence)


def bootstrap_agreement(
    *,
    real: np.ndarray,
    imagined: np.ndarray,
    measure: str,
    generator: np.random.Generator,
    num_draws: int = 1000,
) -> AgreementInterval:
    """95 % percentile interval of an agreement figure by resampling the matched starts.

    Args:
        real: scores [policies, starts]; column k of both arrays began from the same start.
        imagined: scores [policies, starts].
        measure: "pearson", or "mmrv" with ties counted, of the policies' means.
        generator: source of the draws; every policy sees the same drawn starts.
        num_draws: number of draws.

    Raises:
        ShapeError: different shapes or not two axes.
        InvalidInputError: unknown measure.
    """
    real, imagined = np.asarray(real, dtype=np.float64), np.asarray(imagined, dtype=np.float64)
    if real.shape != imagined.shape or real.ndim != 2 or real.size == 0:
        raise ShapeError(
            f"agreement: got shapes {real.shape} and {imagined.shape}, "
            "expected the same [policies, starts]"
        )
    if measure not in MEASURES:
        raise InvalidInputError(
            f"agreement measure: got {measure!r}, expected one of {sorted(MEASURES)}"
        )
    counts = start_counts(real.shape[1], generator, num_draws=num_draws)
    figures = MEASURES[measure](rates_of_draws(real, counts), rates_of_draws(imagined, counts))
    return interval_of_draws(figures)


def interval_of_draws(figures: np.ndarray, *, confidence: float = 0.95) -> AgreementInterval:
    """Percentile interval of the figures [draws] of a bootstrap; undefined draws are NaN.

    Raises:
        ShapeError: not one axis with at least one draw.
    """
    _check_confidence(confidence)
    if figures.ndim != 1 or len(figures) == 0:
        raise ShapeError(f"bootstrap: got shape {figures.shape}, expected [draws ≥ 1]")
    num_draws = len(figures)
    defined = figures[np.isfinite(figures)]
    undefined_share = 1 - len(defined) / num_draws
    enough = undefined_share < 0.5
    return AgreementInterval(_percentiles(defined, confidence) if enough else None, undefined_share)


def _percentiles(draws: np.ndarray, confidence: float) -> Interval:
    low, high = np.quantile(draws, [(1 - confidence) / 2, (1 + confidence) / 2])
    return Interval(float(low), float(high))
