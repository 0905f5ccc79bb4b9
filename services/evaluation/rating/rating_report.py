"""Scores of rated rollouts, and the agreement of raters: Krippendorff's alpha, ICC and biases.

Ratings are arrays [rollouts, raters] with NaN where a rater did not rate. Read alpha first: below
0.667 even tentative conclusions are not supported (Krippendorff, Content Analysis, 2004, p. 241).
"""

import math
from collections import defaultdict
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Final, Literal

import numpy as np
from jaxtyping import Float64

from dextouch.errors import InvalidInputError
from services.evaluation import statistics
from services.evaluation.rating.marks import FIRST, REPEAT, Mark, StoredMark, by_people, vote
from services.evaluation.rating.rubrics import Rubric, rubric_of
from services.evaluation.rendering import UNDEFINED

Level = Literal["nominal", "interval"]
LEAST_ALPHA: Final = 0.667
# Scores in 0 … 1 that differ by rounding alone are equal.
_ROUNDING: Final = 1e-12


@dataclass(frozen=True)
class RaterBias:
    """Mean difference of a rater's scores from the mean of the others on the same rollouts."""

    rater: str
    bias: float
    interval: statistics.Interval
    num_rollouts: int


def krippendorff_alpha(ratings: Float64[np.ndarray, "_ _"], *, level: Level) -> float:
    """Krippendorff's alpha: 1 for perfect agreement, 0 for that of chance.

    `1 − D_o / D_e` with the observed and expected disagreement of pairs of ratings (Krippendorff,
    "Computing Krippendorff's Alpha-Reliability", 2011). Rollouts with fewer than two ratings do not
    count.

    The level is "nominal" for marks that are equal or not, "interval" for scores, whose squared
    difference counts. NaN where it is undefined: no rollout with two ratings, or all equal.
    """
    known = np.isfinite(ratings)
    rows = known.sum(axis=1) >= 2
    values, known = np.where(known, ratings, 0.0)[rows], known[rows]
    pooled = values[known]
    if len(pooled) == 0 or np.ptp(pooled) < _ROUNDING:
        return math.nan
    observed = sum(
        _disagreement(row[there], level) / (there.sum() - 1)
        for row, there in zip(values, known, strict=True)
    )
    expected = _disagreement(pooled, level) / (len(pooled) - 1)
    return float(1 - observed / expected)


def alpha_interval(
    ratings: Float64[np.ndarray, "_ _"], generator: np.random.Generator, *, num_draws: int = 1000
) -> statistics.Interval | None:
    """95 % bootstrap interval of alpha of scores: rollouts are drawn, with all of their ratings.

    None if alpha is undefined, or is in more than one of twenty draws, as for very few rollouts.
    """
    rated = ratings[np.isfinite(ratings).sum(axis=1) >= 2]
    if len(rated) < 2:
        return None
    num = np.isfinite(rated).sum(axis=1).astype(np.float64)
    # Sums of one rollout each, of which those of a draw are sums; centred, so that none cancels.
    centred = np.nan_to_num(rated - np.nanmean(rated))
    total, square = centred.sum(axis=1), (centred**2).sum(axis=1)
    observed = 2 * (num * square - total**2) / (num - 1)
    counts = statistics.start_counts(len(rated), generator, num_draws=num_draws)
    all_num, all_total, all_square = (counts @ one for one in (num, total, square))
    expected = 2 * (all_num * all_square - all_total**2) / (all_num - 1)
    spread = expected > 1e-9 * all_num
    draws = 1 - (counts @ observed)[spread] / expected[spread]
    return statistics.central_interval(draws) if len(draws) > 0.95 * num_draws else None


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
    not rate do not count. NaN for fewer than two raters or complete rollouts, or without spread.
    """
    complete = ratings[np.isfinite(ratings).all(axis=1)]
    num_rollouts, num_raters = complete.shape
    if min(num_rollouts, num_raters) < 2 or np.ptp(complete) < _ROUNDING:
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
    raters: Sequence[str], ratings: Float64[np.ndarray, "_ _"], generator: np.random.Generator
) -> list[RaterBias]:
    """Bias of each rater who shares two rollouts with others, with a bootstrap over rollouts."""
    known = np.isfinite(ratings)
    found = []
    for column, rater in enumerate(raters):
        others = np.delete(ratings, column, axis=1)
        shared = known[:, column] & np.isfinite(others).any(axis=1)
        if shared.sum() < 2:
            continue
        differences = ratings[shared, column] - np.nanmean(others[shared], axis=1)
        counts = statistics.start_counts(len(differences), generator, num_draws=1000)
        interval = statistics.central_interval(counts @ differences / len(differences))
        found.append(RaterBias(rater, float(differences.mean()), interval, len(differences)))
    return found


def check_criteria(
    marks: Iterable[StoredMark], task_of: Mapping[str, str], rubrics: Mapping[str, Rubric]
) -> list[Mark]:
    """The marks of episodes that have a task; raises InvalidInputError for one by another rubric.

    Marks are never deleted, so that a rubric whose criteria changed needs a file of its own.
    """
    known = [one.mark for one in marks if one.mark.episode_id in task_of]
    for mark in known:
        task = task_of[mark.episode_id]
        names = [one.name for one in rubric_of(task, rubrics).criteria]
        if not mark.cannot_judge and mark.holds.keys() != set(names):
            raise InvalidInputError(
                f"mark of {mark.rater!r} for {mark.episode_id!r}: got the criteria "
                f"{', '.join(mark.holds)}, expected {', '.join(names)} of {task!r}; take the "
                "rubrics that raters saw, and collect marks by others in another file (--marks)"
            )
    return known


def rating_report(
    marks: Iterable[StoredMark],
    task_of: Mapping[str, str],
    rubrics: Mapping[str, Rubric],
    state_scores: Mapping[str, float],
    *,
    raters_per_rollout: int = 1,
) -> dict[str, Any]:
    """Report entries: scores by rollout, and by task alpha, ICC(2,k), biases and consistency.

    Of the marks that count (`MarkLog.latest`), those of programs are listed separately, and those
    of episodes without a task are skipped. `state_scores` are true scores by episode id, where they
    are known; with fewer than `raters_per_rollout` marks nothing is tied yet. Raises as
    `check_criteria`.
    """
    known = check_criteria(marks, task_of, rubrics)
    by_episode: dict[str, list[Mark]] = defaultdict(list)
    for mark in known:
        by_episode[mark.episode_id].append(mark)
    rows = [
        {"episode_id": name, "task": task_of[name]}
        | _rollout(given, rubric_of(task_of[name], rubrics), raters_per_rollout)
        | {"state_score": state_scores.get(name, UNDEFINED)}
        for name, given in sorted(by_episode.items())
    ]
    return {
        "rollouts": [row for row in rows if row["human_scores"] or row["auto_scores"]],
        "tasks": {
            task: _task(
                [mark for mark in known if task_of[mark.episode_id] == task],
                rubric_of(task, rubrics),
            )
            | _majorities([row for row in rows if row["task"] == task])
            for task in sorted({row["task"] for row in rows})
        },
        "cannot_judge": sum(mark.cannot_judge for mark in known),
        "num_marks": len(known),
    }


def _rollout(marks: list[Mark], rubric: Rubric, raters_per_rollout: int) -> dict[str, Any]:
    """Scores of one rollout, that of the majority of people, and what they are tied on."""
    judged = [mark for mark in marks if mark.presentation == FIRST and not mark.cannot_judge]
    scores = {
        kind: [_score(mark, rubric) for mark in judged if mark.kind == kind]
        for kind in ("human", "auto")
    }
    given = [mark for people in by_people(marks).values() for mark in people]
    first = [mark for mark in given if mark.presentation == FIRST]
    most, is_complete = vote(given), len(first) >= raters_per_rollout
    decided: float | str = UNDEFINED
    if most.holds and not most.tied:
        decided = rubric.score(most.holds, is_inconsistent=most.is_inconsistent)
    return {f"{kind}_scores": found for kind, found in scores.items()} | {
        "score": float(np.mean(scores["human"])) if scores["human"] else UNDEFINED,
        "decided_score": decided,
        "tied": list(most.tied) if is_complete else [],
        "was_tied": is_complete and bool(vote(first).tied) and len(given) > 1,
    }


def _majorities(rows: list[dict[str, Any]]) -> dict[str, Any]:
    """Of a task's rollouts: ties, mean score of majorities, and people's minus the true score."""
    decided = [row["decided_score"] for row in rows if row["decided_score"] != UNDEFINED]
    both = [row for row in rows if UNDEFINED not in {row["score"], row["state_score"]}]
    differences = [row["score"] - row["state_score"] for row in both]
    return {
        "conflicts": {
            "open": sum(bool(row["tied"]) for row in rows),
            "settled": sum(row["was_tied"] and not row["tied"] for row in rows),
        },
        "decided_score": float(np.mean(decided)) if decided else UNDEFINED,
        "less_state_score": float(np.mean(differences)) if differences else UNDEFINED,
    }


def _score(mark: Mark, rubric: Rubric) -> float:
    return rubric.score(mark.holds, is_inconsistent=mark.is_inconsistent)


def _task(marks: list[Mark], rubric: Rubric) -> dict[str, Any]:
    people = [mark for mark in marks if mark.kind == "human" and not mark.cannot_judge]
    first = [mark for mark in people if mark.presentation == FIRST]
    raters = sorted({mark.rater for mark in first})
    rollouts = sorted({mark.episode_id for mark in first})
    scores = np.full((len(rollouts), len(raters)), np.nan)
    holds = {one.name: scores.copy() for one in rubric.criteria}
    row_of, column_of = ({name: i for i, name in enumerate(all_)} for all_ in (rollouts, raters))
    for mark in first:
        cell = row_of[mark.episode_id], column_of[mark.rater]
        scores[cell] = _score(mark, rubric)
        for name, held in mark.holds.items():
            holds[name][cell] = held
    generator = np.random.default_rng(0)
    alpha = krippendorff_alpha(scores, level="interval")
    between = alpha_interval(scores, generator)
    means = np.array([np.nanmean(row) for row in scores])
    interval = statistics.bootstrap_mean_interval(means, generator) if len(means) > 1 else None
    return {
        "num_rollouts": len(rollouts),
        "num_raters": len(raters),
        "marks": dict(zip(raters, np.isfinite(scores).sum(axis=0).tolist(), strict=True)),
        "score": float(means.mean()) if len(means) else UNDEFINED,
        "score_interval": [interval.low, interval.high] if interval else UNDEFINED,
        "alpha": _defined(alpha),
        "alpha_interval": [between.low, between.high] if between else UNDEFINED,
        "alpha_by_criterion": {
            name: _defined(krippendorff_alpha(values, level="nominal"))
            for name, values in holds.items()
        },
        "icc_2k": _defined(intraclass_correlation(scores)),
        "raters": [
            {"rater": one.rater, "bias": one.bias, "num_rollouts": one.num_rollouts}
            | {"bias_interval": [one.interval.low, one.interval.high]}
            for one in rater_biases(raters, scores, generator)
        ],
        "repeats": _repeats(people, rubric),
        "comment": _comment(alpha, between),
    }


def _repeats(people: list[Mark], rubric: Rubric) -> dict[str, Any]:
    """How often raters gave a rollout the same score when they saw it again."""
    first = {(m.rater, m.episode_id): m for m in people if m.presentation == FIRST}
    pairs = [
        (first[m.rater, m.episode_id], m)
        for m in people
        if m.presentation == REPEAT and (m.rater, m.episode_id) in first
    ]
    same = [math.isclose(_score(a, rubric), _score(b, rubric)) for a, b in pairs]
    return {"num": len(pairs), "same_score": float(np.mean(same)) if same else UNDEFINED}


def _comment(alpha: float, between: statistics.Interval | None) -> str:
    if math.isnan(alpha):
        return (
            "Agreement is undefined: no rollout has two ratings, or all ratings are equal, so "
            "nothing shows that raters tell good rollouts from bad ones."
        )
    known = f"alpha {alpha:.2f}"
    if between is not None:
        known += f", 95 % interval {between.low:.2f} to {between.high:.2f}"
    if alpha < LEAST_ALPHA:
        return (
            f"Raters agree too little ({known}, below {LEAST_ALPHA}) for conclusions "
            "from these scores; discuss the rubric with examples and rate again."
        )
    if between is None or between.low < LEAST_ALPHA:
        return f"Raters agree so far ({known}); rate more rollouts to be sure of it."
    return f"Raters agree ({known})."


def _defined(value: float) -> float | str:
    return value if math.isfinite(value) else UNDEFINED
