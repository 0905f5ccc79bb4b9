"""Resampling of vectors and poses to a common time grid, never across a gap."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float64, Int64

from dextouch.geometry import bracket, interpolate_linear, interpolate_poses, transform_from_pose

# How far beyond its first and last sample a stream may be continued, in nominal periods.
EDGE_PERIODS = 1.5
# A stream that loses one sample has a gap of two periods, and half a period is left for jitter.
MAX_GAP_PERIODS = 2.5


@dataclass(frozen=True)
class GridPlacement:
    """Neighbouring samples and weights of each grid step in one stream.

    `weight` of the right neighbour lies in [0, 1] inside the samples; within `EDGE_PERIODS`
    of the ends it may lie outside (the line through the last two samples goes on).
    """

    left: Int64[np.ndarray, " n"]
    weight: Float64[np.ndarray, " n"]
    valid: Bool[np.ndarray, " n"]


def grid_times_ns(num_steps: int, rate_hz: float) -> Int64[np.ndarray, " n"]:
    """Times of steps 0 … num_steps - 1; step k at k / rate, rounded to the nanosecond."""
    return np.rint(np.arange(num_steps) * (1e9 / rate_hz)).astype(np.int64)


def stream_gap_ns(max_gap_ns: int, period_ns: int) -> int:
    """The longest gap that is interpolated in a stream of a nominal period: it follows its rate."""
    return max(max_gap_ns, round(MAX_GAP_PERIODS * period_ns))


def place_on_grid(
    t_ns: np.ndarray, grid_ns: np.ndarray, *, period_ns: int, max_gap_ns: int
) -> GridPlacement:
    """Neighbours and weights of grid times among samples of a nominal period.

    Sample times are strictly increasing; fewer than two make every step invalid. Two that are
    further apart than `max_gap_ns` are not connected.
    """
    t_ns, grid_ns = np.asarray(t_ns, dtype=np.int64), np.asarray(grid_ns, dtype=np.int64)
    if t_ns.size < 2:
        nowhere = np.zeros(grid_ns.size, dtype=np.int64)
        return GridPlacement(nowhere, nowhere.astype(np.float64), nowhere.astype(bool))
    left, weight, valid = bracket(t_ns, grid_ns, max_gap_ns=max_gap_ns)
    span = t_ns[left + 1] - t_ns[left]
    reach_ns = EDGE_PERIODS * period_ns
    outside = (grid_ns < t_ns[0]) | (grid_ns > t_ns[-1])
    near = (grid_ns >= t_ns[0] - reach_ns) & (grid_ns <= t_ns[-1] + reach_ns)
    continued = outside & near & (span <= max_gap_ns)
    weight = np.where(continued, (grid_ns - t_ns[left]) / span, weight)
    return GridPlacement(left, weight, valid | continued)


def vectors_on_grid(values: np.ndarray, at: GridPlacement) -> Float64[np.ndarray, "n ..."]:
    """Values [m, …] at the steps, linearly; meaningless where `at.valid` is False."""
    return interpolate_linear(values, at.left, at.weight)


def poses_on_grid(poses: np.ndarray, at: GridPlacement) -> Float64[np.ndarray, "n 4 4"]:
    """Transforms at the steps from tracker poses [m, 7]: linear translation, SLERP rotation."""
    return interpolate_poses(transform_from_pose(poses), at.left, at.weight)


def runs_of(valid: np.ndarray) -> list[tuple[int, int]]:
    """First and one past the last index of every stretch of True, in order."""
    edges = np.flatnonzero(
        np.diff(np.concatenate([[False], np.asarray(valid, dtype=bool), [False]]))
    )
    return [(int(start), int(stop)) for start, stop in edges.reshape(-1, 2)]


def longest_run(valid: np.ndarray) -> tuple[int, int]:
    """First and one past the last index of the longest stretch of True; (0, 0) if there is none."""
    return max(runs_of(valid), key=lambda run: run[1] - run[0], default=(0, 0))
