"""Success rates and classification metrics, their confidence intervals, and draws of both.

A bootstrap of a correlation is biased: noise in the scores of both worlds shrinks it towards zero,
and resampling adds the same noise again. `posterior_scores` models that noise; use it for
intervals (`python -m benchmarks agreement`). `bootstrap_scores` shows how often one is undefined.
"""

import math
from dataclasses import dataclass
from statistics import NormalDist
from typing import Final, NamedTuple

import numpy as np
from jaxtyping import Float64

from dextouch.errors import InvalidInputError
from dextouch.metrics.policy import MIN_POLICIES

# Of all intervals of evaluations; texts and documents say 95 %.
CONFIDENCE: Final = 0.95
Z: Final = NormalDist().inv_cdf((1 + CONFIDENCE) / 2)
Counts = Float64[np.ndarray, "draws starts"]
# Grid of the spread of policies' true scores in each world, and of their correlation; the prior is
# uniform in both spreads and in artanh of the correlation.
_SPREADS: Final = np.array([0.02, 0.04, 0.08, 0.12, 0.17, 0.23, 0.30, 0.40, 0.55])
_CORRELATIONS: Final = np.tanh(np.linspace(-3.0, 3.0, 25))
# Starts at which correlations of the noise count fully; with fewer they are shrunk towards zero.
_SHRINK_STARTS: Final = 4.0
_BATCH: Final = 1000


@dataclass(frozen=True)
class Interval:
    """A confidence interval."""

    low: float
    high: float


def area_under_roc(scores: np.ndarray, success: np.ndarray) -> float:
    """Probability that a success scores above a failure, by scores and outcomes [n].

    Ties count half. Raises InvalidInputError for only successes, or only failures.
    """
    positive, negative = _by_outcome(scores, success)
    return float((np.sign(positive[:, None] - negative[None, :]).mean() + 1) / 2)


def area_interval(area: float, num_successes: int, num_failures: int) -> Interval:
    """95 % score interval of an area under the ROC curve of independent scores.

    Those areas that are within the normal quantile of the measured one, by the spread that scores
    of a logistic distribution would have (Newcombe 2006, Statistics in Medicine 25:559, method 5).
    Unlike a bootstrap interval it has a width where all scores are in order.
    """
    m, n = num_successes, num_failures

    def holds(true: float) -> bool:
        pairs = (1 - true) / (2 - true) + true / (1 + true)
        variance = true * (1 - true) * (1 + ((m + n) / 2 - 1) * pairs) / (m * n)
        return (true - area) ** 2 <= Z * Z * variance

    def bound(outside: float) -> float:
        inside = area
        # Half the width each time, to 1e-9.
        for _ in range(30):
            middle = (inside + outside) / 2
            inside, outside = (middle, outside) if holds(middle) else (inside, middle)
        return inside

    return Interval(bound(0.0), bound(1.0))


def balanced_accuracy(decisions: np.ndarray, success: np.ndarray) -> float:
    """Mean of the shares of successes and of failures that were classified correctly.

    Raises InvalidInputError for only successes, or only failures.
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


def wilson_interval(successes: int | float, trials: int) -> Interval:
    """95 % Wilson score interval of a success rate, inside 0 … 1 (Wilson 1927).

    A trial that was repeated counts as one, with its share of successes. Raises InvalidInputError
    without trials, or for more successes than trials.
    """
    if trials < 1 or not 0 <= successes <= trials:
        raise InvalidInputError(
            f"Wilson interval: got {successes} successes of {trials} trials, "
            "expected at least one trial and 0 … trials successes"
        )
    rate = successes / trials
    spread = Z * math.sqrt(rate * (1 - rate) / trials + Z * Z / (4 * trials * trials))
    shrink = 1 + Z * Z / trials
    centre = rate + Z * Z / (2 * trials)
    return Interval(
        max(0.0, (centre - spread) / shrink) if successes else 0.0,
        min(1.0, (centre + spread) / shrink) if successes < trials else 1.0,
    )


def bootstrap_mean_interval(
    values: np.ndarray, generator: np.random.Generator, *, num_draws: int = 1000
) -> Interval:
    """95 % percentile interval of the mean of independent values [n ≥ 1]."""
    drawn = generator.integers(0, len(values), (num_draws, len(values)))
    return central_interval(values[drawn].mean(axis=1))


def central_interval(draws: np.ndarray) -> Interval:
    """95 % interval between quantiles of draws [n ≥ 1] that leaves equal shares on both sides."""
    low, high = np.quantile(draws, [(1 - CONFIDENCE) / 2, (1 + CONFIDENCE) / 2])
    return Interval(float(low), float(high))


def shortest_interval(draws: np.ndarray, *, confidence: float = CONFIDENCE) -> Interval:
    """The shortest interval that holds a share of draws [n ≥ 1], at least `confidence`."""
    ordered = np.sort(draws)
    held = math.ceil(confidence * len(ordered))
    first = int(np.argmin(ordered[held - 1 :] - ordered[: len(ordered) - held + 1]))
    return Interval(float(ordered[first]), float(ordered[first + held - 1]))


def start_counts(num_starts: int, generator: np.random.Generator, *, num_draws: int) -> Counts:
    """How often each start is drawn, [draws, starts]; every row sums to the number of starts.

    All rollouts of a start are drawn together, since they share its objects and errors.
    """
    drawn = generator.integers(0, num_starts, (num_draws, num_starts))
    return np.array([np.bincount(row, minlength=num_starts) for row in drawn], np.float64)


def pearson_of_draws(real: np.ndarray, imagined: np.ndarray) -> Float64[np.ndarray, " draws"]:
    """Linear correlation of every row [draws, policies]; NaN where it is undefined."""
    if real.shape[1] < MIN_POLICIES:
        return np.full(len(real), np.nan)
    a, b = (x - x.mean(axis=1, keepdims=True) for x in (real, imagined))
    flat = (np.ptp(real, axis=1) == 0) | (np.ptp(imagined, axis=1) == 0)
    size = np.linalg.norm(a, axis=1) * np.linalg.norm(b, axis=1)
    r = np.sum(a * b, axis=1) / np.where(flat, 1.0, size)
    return np.where(flat, np.nan, np.clip(r, -1.0, 1.0))


def mmrv_of_draws(real: np.ndarray, imagined: np.ndarray) -> Float64[np.ndarray, " draws"]:
    """Mean maximum rank violation of every row [draws, policies], ties counted."""
    if real.shape[1] < 2:
        return np.full(len(real), np.nan)
    a, b = real[:, :, None] - real[:, None, :], imagined[:, :, None] - imagined[:, None, :]
    violated = (a > 0) != (b > 0)
    return np.asarray(np.mean(np.max(np.abs(a) * violated, axis=2), axis=1))


def known_mean(scores: np.ndarray, *, axis: int) -> np.ndarray:
    """Mean of the scores that are not NaN; NaN where there are none."""
    known = np.isfinite(scores)
    if known.all():
        return np.asarray(scores.mean(axis=axis))
    count = known.sum(axis=axis)
    total = np.where(known, scores, 0.0).sum(axis=axis)
    return np.where(count > 0, total / np.maximum(count, 1), np.nan)


class MatchedScores(NamedTuple):
    """Scores in 0 … 1 of one task's policies from the same starts in two worlds.

    Success is 0 or 1. An imagined rollout that is NaN is undecided and counts in no mean; every
    policy has one that is not.
    """

    real: Float64[np.ndarray, "policies starts"]
    imagined: Float64[np.ndarray, "policies starts"]


class ScoreDraws(NamedTuple):
    """Plausible mean scores [draws, policies] of the same policies in two worlds."""

    real: Float64[np.ndarray, "draws policies"]
    imagined: Float64[np.ndarray, "draws policies"]


def bootstrap_scores(
    scores: MatchedScores, generator: np.random.Generator, *, num_draws: int = 10_000
) -> ScoreDraws:
    """Bootstrap over starts, each drawn for all policies and worlds, which share its objects."""
    num_starts = scores.real.shape[1]
    starts = generator.integers(0, num_starts, (num_draws, num_starts))
    return ScoreDraws(_resampled(scores.real, starts), _resampled(scores.imagined, starts))


def _resampled(scores: np.ndarray, starts: np.ndarray) -> Float64[np.ndarray, "draws policies"]:
    means = [
        known_mean(scores[:, drawn], axis=2).T
        for drawn in np.array_split(starts, -(-len(starts) // _BATCH))
    ]
    return np.concatenate(means)


def posterior_scores(
    scores: MatchedScores, generator: np.random.Generator, *, num_draws: int = 10_000
) -> ScoreDraws:
    """Draws from the posterior of policies' true mean scores in a random-effects model.

    Policies' true scores in the two worlds are drawn from one bivariate normal distribution with
    unknown means, spreads and correlation; the observed mean scores add normal noise, whose
    covariance is estimated from the starts (`noise_covariance`). Means have a flat prior and are
    integrated out; spreads and correlation are integrated over a grid, so nothing is iterated and
    nothing has to converge. Draws are clipped to 0 … 1.

    There are at least two policies and two starts.
    """
    num_policies = len(scores.real)
    rollouts = np.concatenate([scores.real, scores.imagined])
    observed, noise = known_mean(rollouts, axis=1), noise_covariance(rollouts)
    grid = _Grid.of(num_policies, observed, noise)
    counts = generator.multinomial(num_draws, grid.weight)
    drawn = np.empty((num_draws, 2 * num_policies))
    error = generator.standard_normal(drawn.shape) @ np.linalg.cholesky(noise).T
    stop = np.cumsum(counts)
    for index in np.flatnonzero(counts).tolist():
        rows = slice(int(stop[index] - counts[index]), int(stop[index]))
        prior = grid.prior_draws(index, int(counts[index]), generator)
        # Matheron's rule: a draw from the prior, corrected by what was observed.
        gain = np.linalg.solve(grid.covariance(index) + noise, grid.covariance(index))
        drawn[rows] = prior + (observed - prior - error[rows]) @ gain
    drawn = np.clip(drawn[generator.permutation(num_draws)], 0.0, 1.0)
    return ScoreDraws(drawn[:, :num_policies], drawn[:, num_policies:])


def noise_covariance(
    rollouts: Float64[np.ndarray, "series starts"],
) -> Float64[np.ndarray, "series series"]:
    """Covariance of the mean scores of several series of rollouts over the same starts.

    Variances include two additional rollouts, one of score 0 and one of score 1 (the rule of
    Agresti and Coull 1998 for binomial rates), so that ten of ten successes are not certain.
    Correlations are shrunk towards zero; with four starts or fewer they are zero. Scores that are
    NaN are missing: variances are those of the known scores, and two series correlate by the starts
    that both know.
    """
    num_series = len(rollouts)
    known = np.isfinite(rollouts)
    num_starts, scores = known.sum(axis=1), np.where(known, rollouts, 0.0)
    mean = (scores.sum(axis=1) + 1) / (num_starts + 2)
    square = ((scores**2).sum(axis=1) + 1) / (num_starts + 2)
    deviation = np.sqrt((square - mean**2) / num_starts)
    centred = np.where(known, rollouts - known_mean(rollouts, axis=1)[:, None], 0.0)
    size = np.linalg.norm(centred, axis=1)
    varies = size > 1e-9
    unit = np.where(varies[:, None], centred / np.where(varies, size, 1.0)[:, None], 0.0)
    correlation = max(0.0, 1 - _SHRINK_STARTS / num_starts.min()) * (unit @ unit.T)
    correlation[np.arange(num_series), np.arange(num_series)] = 1.0
    # Identical series make the matrix singular; a small diagonal term keeps it invertible.
    correlation += 1e-6 * np.eye(num_series)
    return np.asarray(correlation * np.outer(deviation, deviation))


@dataclass(frozen=True)
class _Grid:
    """Spreads and correlations with their posterior weights, and the posterior of the means.

    `spread` [grid, 2], `correlation` [grid], `weight` [grid]; `mean` [grid, 2] and `mean_factor`
    [grid, 2, 2] describe the normal posterior of the policies' mean score in each world.
    """

    num_policies: int
    spread: Float64[np.ndarray, "grid 2"]
    correlation: Float64[np.ndarray, " grid"]
    weight: Float64[np.ndarray, " grid"]
    mean: Float64[np.ndarray, "grid 2"]
    mean_factor: Float64[np.ndarray, "grid 2 2"]

    @classmethod
    def of(cls, num_policies: int, observed: np.ndarray, noise: np.ndarray) -> "_Grid":
        real, imagined, correlation = (
            axis.ravel() for axis in np.meshgrid(_SPREADS, _SPREADS, _CORRELATIONS, indexing="ij")
        )
        spread = np.stack([real, imagined], axis=1)
        width = np.gradient(_SPREADS)
        prior = np.log(np.outer(width, width)).ravel().repeat(len(_CORRELATIONS))
        parts = [
            _marginal(num_policies, spread[rows], correlation[rows], observed, noise)
            for rows in np.array_split(np.arange(len(spread)), len(_SPREADS))
        ]
        log_likelihood, mean, mean_factor = (
            np.concatenate(part) for part in zip(*parts, strict=True)
        )
        weight = np.exp(log_likelihood + prior - (log_likelihood + prior).max())
        return cls(num_policies, spread, correlation, weight / weight.sum(), mean, mean_factor)

    def covariance(self, index: int) -> Float64[np.ndarray, "series series"]:
        """Covariance of the true scores: all real ones, then all imagined ones."""
        return _true_covariance(
            self.num_policies, self.spread[index][None], self.correlation[index][None]
        )[0]

    def prior_draws(
        self, index: int, num_draws: int, generator: np.random.Generator
    ) -> Float64[np.ndarray, "draws series"]:
        """Draws of the true scores from the prior, not conditioned on the observed scores."""
        mean = (
            self.mean[index] + generator.standard_normal((num_draws, 2)) @ self.mean_factor[index].T
        )
        first, second = generator.standard_normal((2, num_draws, self.num_policies))
        r = self.correlation[index]
        second = r * first + np.sqrt(1 - r * r) * second
        real, imagined = self.spread[index]
        return np.concatenate([mean[:, :1] + real * first, mean[:, 1:] + imagined * second], axis=1)


def _true_covariance(
    num_policies: int, spread: np.ndarray, correlation: np.ndarray
) -> Float64[np.ndarray, "grid series series"]:
    pair = spread[:, :, None] * spread[:, None, :]
    pair[:, [0, 1], [1, 0]] *= correlation[:, None]
    return np.kron(pair, np.eye(num_policies))


def _marginal(
    num_policies: int,
    spread: np.ndarray,
    correlation: np.ndarray,
    observed: np.ndarray,
    noise: np.ndarray,
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Log likelihood with the means integrated out, and the means' posterior (mean, factor)."""
    factor = np.linalg.cholesky(_true_covariance(num_policies, spread, correlation) + noise)
    columns = np.zeros((len(observed), 3))
    columns[:, 0] = observed
    columns[:num_policies, 1] = columns[num_policies:, 2] = 1.0
    white = np.linalg.solve(factor, np.broadcast_to(columns, (len(factor), *columns.shape)))
    seen, design = white[..., :1], white[..., 1:]
    precision = design.transpose(0, 2, 1) @ design
    right = design.transpose(0, 2, 1) @ seen
    mean = np.linalg.solve(precision, right)
    misfit = (seen**2).sum(axis=(1, 2)) - (right * mean).sum(axis=(1, 2))
    log_size = np.log(np.diagonal(factor, axis1=1, axis2=2)).sum(axis=1)
    log_likelihood = -0.5 * misfit - log_size - 0.5 * np.log(np.linalg.det(precision))
    return log_likelihood, mean[..., 0], np.linalg.cholesky(np.linalg.inv(precision))
