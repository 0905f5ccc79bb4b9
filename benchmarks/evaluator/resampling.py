"""Bootstrap of judges' figures over matched starts, vectorized over the draws of `start_counts`."""

import numpy as np
from jaxtyping import Float64

from dextouch.errors import ShapeError
from services.evaluation.statistics import Counts, Interval, central_interval


def interval_of_draws(figures: np.ndarray) -> Interval | None:
    """95 % percentile interval of figures [draws] of a bootstrap that are defined, thus not NaN.

    Returns None where more than half are undefined.

    Raises:
        ShapeError: not one axis with at least one draw.
    """
    if figures.ndim != 1 or len(figures) == 0:
        raise ShapeError(f"bootstrap: got shape {figures.shape}, expected [draws ≥ 1]")
    defined = figures[np.isfinite(figures)]
    enough = 2 * len(defined) > len(figures)
    return central_interval(defined) if enough else None


def rates_of_draws(
    outcomes: np.ndarray, played: np.ndarray, counts: Counts
) -> Float64[np.ndarray, "draws policies"]:
    """Mean outcome of every policy in every draw; NaN where a draw lacks all of its starts.

    From sums of outcomes and numbers of rollouts, both [policies, starts].
    """
    with np.errstate(invalid="ignore"):
        return np.asarray((counts @ outcomes.T) / (counts @ played.T))


def area_under_roc_of_draws(
    scores: np.ndarray, success: np.ndarray, start_index: np.ndarray, counts: Counts
) -> Float64[np.ndarray, " draws"]:
    """Area under the ROC curve of every draw, ties half; NaN where one outcome is missing.

    Scores [n] are higher for more certain success; each rollout has the index of its start.
    """
    positive = np.asarray(success, dtype=bool)
    weight = counts[:, start_index]
    wins, losses = weight[:, positive], weight[:, ~positive]
    ordered = (np.sign(scores[positive][:, None] - scores[~positive][None, :]) + 1) / 2
    pairs = wins.sum(axis=1) * losses.sum(axis=1)
    with np.errstate(invalid="ignore"):
        return np.asarray(np.sum((wins @ ordered) * losses, axis=1) / pairs)


def balanced_accuracy_of_draws(
    decisions: np.ndarray, success: np.ndarray, start_index: np.ndarray, counts: Counts
) -> Float64[np.ndarray, " draws"]:
    """Balanced accuracy of every draw; NaN where one outcome is missing."""
    positive = np.asarray(success, dtype=bool)
    right = np.asarray(decisions, dtype=bool) == positive
    weight = counts[:, start_index]
    with np.errstate(invalid="ignore"):
        shares = [
            (weight[:, of] @ right[of]) / weight[:, of].sum(axis=1) for of in (positive, ~positive)
        ]
    return np.asarray((shares[0] + shares[1]) / 2)


def mean_of_draws(
    values: np.ndarray, start_index: np.ndarray, counts: Counts
) -> Float64[np.ndarray, " draws"]:
    """Mean of values [n] over the rollouts of every draw; NaN for a draw without any."""
    weight = counts[:, start_index]
    with np.errstate(invalid="ignore"):
        return np.asarray((weight @ values) / weight.sum(axis=1))
