"""Agreement of trajectories that may be early or late, by dynamic time warping, in 0 … 1."""

import math

import numpy as np
from jaxtyping import Float64

from dextouch.errors import InvalidInputError, ShapeError

# With fewer points a predicted trajectory counts as lost (WorldArena, Shang et al. 2026).
MIN_FOUND_SHARE = 0.1


def dynamic_time_warping(first: np.ndarray, second: np.ndarray) -> float:
    """Least sum of distances over alignments of [n, d] and [m, d] (Sakoe and Chiba 1978)."""
    distances = np.linalg.norm(first[:, None] - second[None], axis=2)
    cost = np.full((len(first) + 1, len(second) + 1), np.inf)
    cost[0, 0] = 0.0
    for i in range(len(first)):
        for j in range(len(second)):
            before = min(cost[i, j], cost[i, j + 1], cost[i + 1, j])
            cost[i + 1, j + 1] = distances[i, j] + before
    return float(cost[-1, -1])


def trajectory_accuracy(
    *, predicted: np.ndarray, true: Float64[np.ndarray, "steps dims"], tolerance: float
) -> float:
    """exp(-DTW / (steps · tolerance)) in 0 … 1; 1 for equal trajectories [steps, d].

    nDTW of Ilharco et al. 2019 (arXiv:1907.05446). Unlike path length / DTW it is bounded, also for
    perfect predictions. Missing points of the prediction (NaN) are interpolated, and repeated at
    the ends; with fewer than a tenth of the points the accuracy is 0. `tolerance` is the mean
    distance at which the accuracy falls to 1/e, in the unit of the points.

    Raises:
        ShapeError: different shapes.
        InvalidInputError: missing points of the truth, or a tolerance that is not positive.
    """
    a, b = np.asarray(predicted, dtype=np.float64), np.asarray(true, dtype=np.float64)
    if a.shape != b.shape or a.ndim != 2:
        raise ShapeError(f"trajectories: got shapes {a.shape} and {b.shape}, expected the same")
    if not np.isfinite(b).all() or not tolerance > 0:
        raise InvalidInputError(
            f"trajectories: got {np.isnan(b).any(axis=1).sum()} missing true points and tolerance "
            f"{tolerance}, expected none and a positive number"
        )
    found = np.isfinite(a).all(axis=1)
    if found.mean() < MIN_FOUND_SHARE:
        return 0.0
    steps = np.arange(len(a))
    filled = np.column_stack([np.interp(steps, steps[found], column[found]) for column in a.T])
    return math.exp(-dynamic_time_warping(filled, b) / (len(b) * tolerance))
