"""Figures of one task with their bootstrap draws, and their mean over training seeds as lines.

The bootstrap is over matched starts, vectorized over the draws of `start_counts`.
"""

import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any, Final

import numpy as np
from jaxtyping import Float64

from benchmarks.figures import Requirement, Sense
from dextouch.errors import ShapeError
from services.evaluation.classifier_calibration import expected_calibration_error
from services.evaluation.rendering import UNDEFINED
from services.evaluation.scores import undefined_by
from services.evaluation.statistics import Counts, Interval, central_interval, start_counts


def interval_of_draws(figures: np.ndarray) -> Interval | None:
    """95 % percentile interval of figures [draws] of a bootstrap that are defined, thus not NaN.

    Returns None where more than half are undefined. Raises ShapeError for not one axis with at
    least one draw.
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


NUM_DRAWS: Final = 1000
_NUM_CALIBRATION_DRAWS: Final = 200
# First word of the lines that compare policies; their `num` counts policies.
POLICIES: Final = "policies"
Bound = tuple[Sense, float]


@dataclass(frozen=True)
class Line:
    """One line of the table; `value` is None if it is undefined, or nothing was rolled out.

    `value` is the mean over the training seeds, `by_seed` the figure of each; `interval` is the
    95 % bootstrap interval of the mean over the starts.
    """

    task: str
    what: str
    value: float | None
    interval: tuple[float, float] | None
    num: int
    sense: Sense
    bound: float
    unit: str = ""
    by_seed: tuple[float | None, ...] = ()

    def text(self, value: float | None) -> str:
        """A figure of this line, or that it is undefined, with the number of policies if few."""
        if value is not None:
            return f"{value:.3f}"
        return undefined_by(self.num) if self.what.startswith(POLICIES) else UNDEFINED

    def requirement(self) -> Requirement:
        """The line as a requirement."""
        what = f"{self.task}: {self.what}"
        return Requirement(what, self.value, self.sense, self.bound, self.unit)


@dataclass(frozen=True)
class Rolled:
    """One policy from one start, with the kept rows of the rollout by their kind."""

    policy: str
    seed: int
    success: bool
    rows: Mapping[str, Mapping[str, Any]]


@dataclass(frozen=True)
class Drawn:
    """A figure of one training seed, and the same figure in every draw of starts.

    `worst` is the bound of the worst of several training seeds, where there is one.
    """

    what: str
    value: float
    draws: np.ndarray
    num: int
    bound: Bound
    unit: str = ""
    worst: float | None = None

    def less(self, other: "Drawn", what: str, bound: float) -> "Drawn":
        """Difference to another figure, in the same draws."""
        return Drawn(
            what, self.value - other.value, self.draws - other.draws, self.num, ("at least", bound)
        )


class Sampling:
    """Draws of the starts of a task, the same for every figure."""

    def __init__(self, rollouts: Iterable[Rolled]) -> None:
        self.seeds = sorted({one.seed for one in rollouts})
        generator = np.random.default_rng(0)
        self.counts = start_counts(max(1, len(self.seeds)), generator, num_draws=NUM_DRAWS)
        self.own = np.ones((1, max(1, len(self.seeds))))

    def starts(self, rollouts: Iterable[Rolled]) -> np.ndarray:
        """Index of the start of every rollout."""
        return np.array([self.seeds.index(one.seed) for one in rollouts], dtype=int)

    def area(
        self, what: str, kind: str, rollouts: Sequence[Rolled], bound: float, worst: float | None
    ) -> Drawn:
        """Area under the ROC curve of the probabilities in one kind of row."""
        mine, success = having(kind, rollouts)
        pair = (probabilities(mine, kind), success)
        return self.area_of(what, pair, mine, ("at least", bound), worst)

    def area_of(
        self,
        what: str,
        scores_and_positive: tuple[np.ndarray, np.ndarray],
        rollouts: Sequence[Rolled],
        bound: Bound,
        worst: float | None = None,
    ) -> Drawn:
        """Area under the ROC curve of a score of each rollout against a property of it."""
        scores, positive = scores_and_positive
        if positive.all() or not positive.any():
            return undefined(what, bound)
        value, draws = (
            area_under_roc_of_draws(scores, positive, self.starts(rollouts), counts)
            for counts in (self.own, self.counts)
        )
        return Drawn(what, float(value[0]), draws, len(rollouts), bound, worst=worst)

    def balanced(self, what: str, kind: str, rollouts: Sequence[Rolled], bound: float) -> Drawn:
        """Balanced accuracy of the likelier outcomes in one kind of row."""
        mine, success = having(kind, rollouts)
        if success.all() or not success.any():
            return undefined(what, ("at least", bound))
        likely = np.array([one.rows[kind]["likely_success"] for one in mine], dtype=bool)
        starts = self.starts(mine)
        value, draws = (
            balanced_accuracy_of_draws(likely, success, starts, counts)
            for counts in (self.own, self.counts)
        )
        return Drawn(what, float(value[0]), draws, len(mine), ("at least", bound))

    def calibration(self, what: str, kind: str, rollouts: Sequence[Rolled], bound: float) -> Drawn:
        """Expected calibration error of the probabilities in one kind of row."""
        mine, success = having(kind, rollouts)
        if not mine:
            return undefined(what, ("at most", bound))
        estimates, starts = probabilities(mine, kind), self.starts(mine)
        draws = []
        for row in self.counts[:_NUM_CALIBRATION_DRAWS]:
            chosen = np.repeat(np.arange(len(estimates)), row[starts].astype(int))
            some = len(chosen) > 0
            draws.append(
                expected_calibration_error(estimates[chosen], success[chosen]) if some else math.nan
            )
        value = expected_calibration_error(estimates, success)
        return Drawn(what, value, np.array(draws), len(estimates), ("at most", bound))

    def mean(
        self, what: str, values: np.ndarray, rollouts: Sequence[Rolled], bound: Bound
    ) -> Drawn:
        """Mean of one value for each rollout."""
        if len(values) == 0:
            return undefined(what, bound)
        draws = mean_of_draws(values, self.starts(rollouts), self.counts)
        return Drawn(what, float(np.mean(values)), draws, len(values), bound)

    def sums(self, values: np.ndarray, rollouts: Sequence[Rolled]) -> tuple[np.ndarray, np.ndarray]:
        """Sums of values [rollouts, ...] over the rollouts, [...] and [draws, ...]."""
        drawn = np.tensordot(self.counts[:, self.starts(rollouts)], values, axes=1)
        return values.sum(axis=0), drawn


def undefined(what: str, bound: Bound) -> Drawn:
    """A figure without rollouts."""
    return Drawn(what, math.nan, np.array([math.nan]), 0, bound)


def having(kind: str, rollouts: Iterable[Rolled]) -> tuple[list[Rolled], np.ndarray]:
    """The rollouts that have a kind of row, and their outcomes."""
    mine = [one for one in rollouts if kind in one.rows]
    return mine, np.array([one.success for one in mine], dtype=bool)


def probabilities(rollouts: Iterable[Rolled], kind: str) -> np.ndarray:
    """Probabilities of success in one kind of row."""
    return np.array([one.rows[kind]["probability"] for one in rollouts], dtype=float)


def lines_over_seeds(task: str, by_seed: Sequence[Sequence[Drawn]]) -> list[Line]:
    """The mean of every figure over the training seeds, and the worst seed where it has a bound."""
    lines = []
    for same in zip(*by_seed, strict=True):
        values = [one.value for one in same]
        known = tuple(value if math.isfinite(value) else None for value in values)
        draws = np.stack(np.broadcast_arrays(*(one.draws for one in same))).mean(axis=0)
        lines.append(_line(task, same[0], (float(np.mean(values)), draws), known))
        if same[0].worst is not None and len(same) > 1 and np.isfinite(values).all():
            least = same[0].bound[0] == "at least"
            one = same[int(np.argmin(values) if least else np.argmax(values))]
            about = replace(
                one, what=f"{one.what}, worst training seed", bound=(one.bound[0], same[0].worst)
            )
            lines.append(_line(task, about, (one.value, one.draws), known))
    return lines


def _line(
    task: str,
    about: Drawn,
    figure: tuple[float, np.ndarray],
    by_seed: tuple[float | None, ...],
) -> Line:
    value, draws = figure
    found = interval_of_draws(draws) if about.num and math.isfinite(value) else None
    interval = None if found is None else (found.low, found.high)
    return Line(
        task,
        about.what,
        value if math.isfinite(value) else None,
        interval,
        about.num,
        *about.bound,
        about.unit,
        by_seed,
    )
