"""Bootstrap of evaluation figures over matched starts, vectorized over all draws.

A draw resamples the starts with replacement; all rollouts of a start are drawn together, since they
share its objects and errors. Call `start_counts` once and pass its counts to every figure of a
table, so that all figures use the same draws. Figures of single rollouts are in
`services.evaluation.statistics` and `dextouch.metrics.policy`.
"""

import numpy as np
from jaxtyping import Float64

from dextouch.errors import ShapeError
from dextouch.metrics.policy import MIN_POLICIES

Counts = Float64[np.ndarray, "draws starts"]


def start_counts(num_starts: int, generator: np.random.Generator, *, num_draws: int) -> Counts:
    """How often each start is drawn, [draws, starts]; every row sums to the number of starts."""
    if num_starts < 1 or num_draws < 1:
        raise ShapeError(
            f"bootstrap: got {num_starts} starts and {num_draws} draws, expected at least one each"
        )
    drawn = generator.integers(0, num_starts, (num_draws, num_starts))
    counts = np.zeros((num_draws, num_starts))
    np.add.at(counts, (np.arange(num_draws)[:, None], drawn), 1.0)
    return counts


def _weights(counts: Counts, start_index: np.ndarray) -> Float64[np.ndarray, "draws n"]:
    return counts[:, np.asarray(start_index)]


def rates_of_draws(outcomes: np.ndarray, counts: Counts) -> Float64[np.ndarray, "draws policies"]:
    """Mean outcome of every policy in every draw.

    Args:
        outcomes: [policies, starts].
        counts: from `start_counts`.
    """
    return counts @ np.asarray(outcomes, dtype=np.float64).T / counts.sum(axis=1, keepdims=True)


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


def area_under_roc_of_draws(
    scores: np.ndarray, success: np.ndarray, start_index: np.ndarray, counts: Counts
) -> Float64[np.ndarray, " draws"]:
    """Area under the ROC curve of every draw, ties half; NaN where one outcome is missing.

    Args:
        scores: [n], higher for more certain success.
        success: [n] outcomes.
        start_index: [n], start of each rollout.
        counts: from `start_counts`.
    """
    scores, positive = np.asarray(scores), np.asarray(success, dtype=bool)
    weight = _weights(counts, start_index)
    wins, losses = weight[:, positive], weight[:, ~positive]
    ordered = (np.sign(scores[positive][:, None] - scores[~positive][None, :]) + 1) / 2
    pairs = wins.sum(axis=1) * losses.sum(axis=1)
    with np.errstate(invalid="ignore"):
        return np.asarray(np.sum((wins @ ordered) * losses, axis=1) / pairs)


def balanced_accuracy_of_draws(
    decisions: np.ndarray, success: np.ndarray, start_index: np.ndarray, counts: Counts
) -> Float64[np.ndarray, " draws"]:
    """Balanced accuracy of every draw; NaN where one outcome is missing."""
    right = np.asarray(decisions, dtype=bool) == np.asarray(success, dtype=bool)
    positive = np.asarray(success, dtype=bool)
    weight = _weights(counts, start_index)
    with np.errstate(invalid="ignore"):
        shares = [
            (weight[:, of] @ right[of]) / weight[:, of].sum(axis=1) for of in (positive, ~positive)
        ]
    return np.asarray((shares[0] + shares[1]) / 2)


def mean_of_draws(
    values: np.ndarray, start_index: np.ndarray, counts: Counts
) -> Float64[np.ndarray, " draws"]:
    """Mean of values [n] over the rollouts of every draw; NaN for a draw without any."""
    weight = _weights(counts, start_index)
    with np.errstate(invalid="ignore"):
        return np.asarray((weight @ np.asarray(values, dtype=np.float64)) / weight.sum(axis=1))
