"""Resampling of vectors and poses to a common time grid, never across a gap, and what that refuses.

Episodes carry what is left out as `refused_<reason>_<stream>_s`: rows of start and stop (s).
"""

import re
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from typing import Literal, get_args

import numpy as np
from jaxtyping import Bool, Float64, Int64
from pydantic import FiniteFloat

from dextouch.frozen_model import FrozenModel
from dextouch.geometry import bracket, interpolate_linear, interpolate_poses, transform_from_pose
from dextouch.schemas import Matrix, matrix_rows
from dextouch.tactile.layout import Side

# How far beyond its first and last sample a stream may be continued, in nominal periods.
EDGE_PERIODS = 1.5
# A stream that loses one sample has a gap of two periods, and half a period is left for jitter.
MAX_GAP_PERIODS = 2.5
# late_start, early_end: a stream that actions need begins later or ends earlier than the others;
# gap: a stream has no samples there; jump, frozen, limits: it has, but they cannot be true;
# shorter: nothing is wrong but that a longer stretch exists.
RefusedReason = Literal["late_start", "early_end", "gap", "jump", "frozen", "limits", "shorter"]
# Of the steps of an episode at least as many are measured, the others interpolated across gaps.
MIN_MEASURED_SHARE = 0.8
_KEY = re.compile(rf"refused_({'|'.join(get_args(RefusedReason))})(?:_(\w+))?_s")
NS_PER_S = 1e9


@dataclass(frozen=True)
class GridPlacement:
    """Left neighbour and weight of the right one of grid steps; beyond 0 … 1 near the ends."""

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
    """Neighbours and weights of grid times; invalid across `max_gap_ns`, or of one sample."""
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
    # Beyond the ends from the end itself: samples of a burst are closer than they were taken.
    beyond_ns = grid_ns - t_ns[left + (weight == 1)]
    # A stream may be faster than declared.
    least_ns = min(period_ns / 2, float(np.median(np.diff(t_ns))))
    weight = np.where(continued, weight + beyond_ns / np.maximum(span, least_ns), weight)
    return GridPlacement(left, weight, valid | continued)


def vectors_on_grid(values: np.ndarray, at: GridPlacement) -> Float64[np.ndarray, "n ..."]:
    """Values [m, …] at the steps, linearly; meaningless where `at.valid` is False."""
    return interpolate_linear(values, at.left, at.weight)


def poses_on_grid(poses: np.ndarray, at: GridPlacement) -> Float64[np.ndarray, "n 4 4"]:
    """Transforms at the steps from tracker poses [m, 7]: linear translation, SLERP rotation."""
    return interpolate_poses(transform_from_pose(poses), at.left, at.weight)


def runs_of(valid: np.ndarray) -> list[tuple[int, int]]:
    """First and one past the last index of every stretch of True, in order."""
    edges = np.flatnonzero(np.diff(np.pad(np.asarray(valid, dtype=bool), 1)))
    return [(start, stop) for start, stop in edges.reshape(-1, 2).tolist()]


def longest_run(valid: np.ndarray) -> tuple[int, int]:
    """First and one past the last index of the longest stretch of True; (0, 0) if there is none."""
    return max(runs_of(valid), key=lambda run: run[1] - run[0], default=(0, 0))


def bridged_run(valid: np.ndarray, *, max_steps: int) -> tuple[int, int]:
    """The run with the most valid steps whose gaps have at most `max_steps`; (0, 0) if none is.

    Its first and its last step are valid, and four of five are at least; else it is `longest_run`.
    """
    longest = longest_run(valid)
    joined: list[tuple[int, int]] = []
    for start, stop in runs_of(valid):
        if joined and start - joined[-1][1] <= max_steps:
            joined[-1] = (joined[-1][0], stop)
        else:
            joined.append((start, stop))

    def num_valid(run: tuple[int, int]) -> int:
        return int(np.count_nonzero(valid[run[0] : run[1]]))

    fit = [run for run in joined if num_valid(run) >= MIN_MEASURED_SHARE * (run[1] - run[0])]
    best = max(fit, key=num_valid, default=longest)
    return best if num_valid(best) > num_valid(longest) else longest


class RefusedPart(FrozenModel):
    """A stretch of the recording that is not in the episode, in seconds after its start.

    `stream` is the one to blame, None where none is.
    """

    start_s: FiniteFloat
    stop_s: FiniteFloat
    reason: RefusedReason
    stream: str | None = None


def refused_edges(
    first_ns: Mapping[str, int], last_ns: Mapping[str, int], start_ns: int
) -> list[RefusedPart]:
    """Ends of a recording, which began at `start_ns`, that not all of these streams cover."""
    latest = max(first_ns, key=lambda name: first_ns[name])
    earliest = min(last_ns, key=lambda name: last_ns[name])
    return [
        _part(min(first_ns.values()), first_ns[latest], start_ns, "late_start", latest),
        _part(last_ns[earliest], max(last_ns.values()), start_ns, "early_end", earliest),
    ]


def refused_stretches(
    t_ns: np.ndarray, valid: Mapping[str, np.ndarray], taken: tuple[int, int], start_ns: int
) -> list[RefusedPart]:
    """Steps of the grid that are not in the episode, which has the steps `taken`: first, stop.

    `t_ns` are two times or more on the clock of the recording's start, `start_ns`; `valid` says of
    each stream whether it can be read at each step.
    """
    step_ns = int(t_ns[1] - t_ns[0])

    def part(run: tuple[int, int], reason: RefusedReason, stream: str | None) -> RefusedPart:
        stop_ns = int(t_ns[run[1] - 1]) + step_ns
        return _part(int(t_ns[run[0]]), stop_ns, start_ns, reason, stream)

    outside = np.ones(len(t_ns), dtype=bool)
    outside[slice(*taken)] = False
    gaps = [
        part(run, "gap", name) for name, mine in valid.items() for run in runs_of(~mine & outside)
    ]
    good = np.logical_and.reduce(list(valid.values()))
    return gaps + [part(run, "shorter", None) for run in runs_of(good & outside)]


def interpolated_matrices(t_ns: np.ndarray, valid: Mapping[str, np.ndarray]) -> dict[str, Matrix]:
    """Start and stop (s) of the steps at which each stream was missing, as matrices."""
    rows = {name: _rows_s(t_ns, ~mine) for name, mine in valid.items()}
    return {
        f"interpolated_{name}_s": matrix_rows(np.array(runs)) for name, runs in rows.items() if runs
    }


def interpolated_fingers(
    t_ns: np.ndarray, unseen: Mapping[Side, Bool[np.ndarray, "n 5"]]
) -> dict[str, Matrix]:
    """Start, stop (s) and number of fingers that are missing at some, but not all steps."""
    found = {}
    for side, of_hand in unseen.items():
        rows = [
            (*row, float(finger))
            for finger in np.flatnonzero(~of_hand.all(axis=0)).tolist()
            for row in _rows_s(t_ns, of_hand[:, finger])
        ]
        if rows:
            found[f"interpolated_fingers_{side}_s"] = matrix_rows(np.array(rows))
    return found


def _rows_s(t_ns: np.ndarray, steps: np.ndarray) -> list[tuple[float, float]]:
    step_ns = int(t_ns[1] - t_ns[0]) if len(t_ns) > 1 else 0
    return [
        (t_ns[start] / NS_PER_S, (t_ns[stop - 1] + step_ns) / NS_PER_S)
        for start, stop in runs_of(steps)
    ]


def with_causes(
    refused: list[RefusedPart],
    left_out_ns: Mapping[str, Iterable[tuple[int, int, RefusedReason]]],
    start_ns: int,
) -> list[RefusedPart]:
    """The refused parts, with those of samples that cannot be true in place of their gaps."""
    causes = [
        _part(begin_ns, end_ns, start_ns, reason, name)
        for name, mine in left_out_ns.items()
        for begin_ns, end_ns, reason in mine
    ]

    def is_explained(part: RefusedPart) -> bool:
        return part.reason == "gap" and any(
            part.stream == one.stream and part.start_s < one.stop_s and one.start_s < part.stop_s
            for one in causes
        )

    return [*(part for part in refused if not is_explained(part)), *causes]


def refused_matrices(parts: list[RefusedPart]) -> dict[str, Matrix]:
    """The parts as an episode carries them."""
    rows: dict[str, list[tuple[float, float]]] = {}
    for part in parts:
        if part.stop_s > part.start_s:
            middle = part.reason if part.stream is None else f"{part.reason}_{part.stream}"
            rows.setdefault(f"refused_{middle}_s", []).append((part.start_s, part.stop_s))
    return {name: matrix_rows(np.array(stretches)) for name, stretches in rows.items()}


def refused_parts(calibration: Mapping[str, Matrix]) -> tuple[RefusedPart, ...]:
    """The refused parts that an episode carries, in order of time."""
    names = ("start_s", "stop_s", "reason", "stream")
    parts = [
        RefusedPart.model_validate(dict(zip(names, (*row, *match.groups()), strict=True)))
        for name, rows in calibration.items()
        if (match := _KEY.fullmatch(name))
        for row in rows
    ]
    return tuple(sorted(parts, key=lambda part: (part.start_s, part.stop_s, part.stream or "")))


def _part(
    begin_ns: int, end_ns: int, start_ns: int, reason: RefusedReason, stream: str | None
) -> RefusedPart:
    start_s, stop_s = (begin_ns - start_ns) / NS_PER_S, (end_ns - start_ns) / NS_PER_S
    return RefusedPart(start_s=start_s, stop_s=stop_s, reason=reason, stream=stream)
