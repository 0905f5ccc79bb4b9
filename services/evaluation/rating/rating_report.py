"""Scores of rated rollouts, and the agreement of raters."""

import math
from collections import defaultdict
from collections.abc import Iterable, Mapping
from typing import Any

import numpy as np

from services.evaluation.rating.marks import FIRST, REPEAT, Mark, StoredMark
from services.evaluation.rating.rater_agreement import (
    LEAST_ALPHA,
    intraclass_correlation,
    krippendorff_alpha,
    rater_biases,
)
from services.evaluation.rating.rubrics import Rubric, rubric_of
from services.evaluation.statistics import bootstrap_mean_interval

UNDEFINED = "undefined"


def rating_report(
    marks: Iterable[StoredMark],
    task_of: Mapping[str, str],
    rubrics: Mapping[str, Rubric],
    state_scores: Mapping[str, float],
) -> dict[str, Any]:
    """Report entries: scores by rollout, and by task alpha, ICC(2,k), biases and consistency.

    Marks of programs are listed separately from those of people.

    Args:
        marks: those that count (`MarkLog.latest`).
        task_of: task of each episode id; marks of others are skipped and counted.
        rubrics: by task.
        state_scores: true scores by episode id, where they are known.
    """
    known = [one.mark for one in marks if one.mark.episode_id in task_of]
    tasks = sorted({task_of[mark.episode_id] for mark in known})
    rollouts = [
        row | {"state_score": state_scores.get(row["episode_id"], UNDEFINED)}
        for row in _rollouts(known, task_of, rubrics)
    ]
    return {
        "rollouts": rollouts,
        "tasks": {
            task: _task(
                [mark for mark in known if task_of[mark.episode_id] == task],
                rubric_of(task, rubrics),
            )
            | {"less_state_score": _less_state([r for r in rollouts if r["task"] == task])}
            for task in tasks
        },
        "cannot_judge": sum(mark.cannot_judge for mark in known),
        "num_marks": len(known),
    }


def _rollouts(
    marks: list[Mark], task_of: Mapping[str, str], rubrics: Mapping[str, Rubric]
) -> list[dict[str, Any]]:
    found: dict[str, dict[str, list[float]]] = defaultdict(lambda: {"human": [], "auto": []})
    for mark in marks:
        if mark.presentation == FIRST and not mark.cannot_judge:
            rubric = rubric_of(task_of[mark.episode_id], rubrics)
            found[mark.episode_id][mark.kind].append(_score(mark, rubric))
    return [
        {"episode_id": episode_id, "task": task_of[episode_id]}
        | {f"{kind}_scores": scores for kind, scores in kinds.items()}
        | {"score": float(np.mean(kinds["human"])) if kinds["human"] else UNDEFINED}
        for episode_id, kinds in sorted(found.items())
    ]


def _less_state(rollouts: list[dict[str, Any]]) -> float | str:
    """Mean of people's scores minus the ground truth, over the rollouts that have both."""
    both = [row for row in rollouts if UNDEFINED not in {row["score"], row["state_score"]}]
    if not both:
        return UNDEFINED
    return float(np.mean([row["score"] - row["state_score"] for row in both]))


def _score(mark: Mark, rubric: Rubric) -> float:
    return rubric.score(mark.holds, is_inconsistent=mark.is_inconsistent)


def _task(marks: list[Mark], rubric: Rubric) -> dict[str, Any]:
    people = [mark for mark in marks if mark.kind == "human" and not mark.cannot_judge]
    first = [mark for mark in people if mark.presentation == FIRST]
    raters = sorted({mark.rater for mark in first})
    rollouts = sorted({mark.episode_id for mark in first})
    scores = np.full((len(rollouts), len(raters)), np.nan)
    holds = {one.name: scores.copy() for one in rubric.criteria}
    for mark in first:
        cell = rollouts.index(mark.episode_id), raters.index(mark.rater)
        scores[cell] = _score(mark, rubric)
        for name, held in mark.holds.items():
            holds[name][cell] = held
    generator = np.random.default_rng(0)
    alpha = krippendorff_alpha(scores, level="interval")
    means = np.array([np.nanmean(row) for row in scores])
    interval = bootstrap_mean_interval(means, generator) if len(means) else None
    return {
        "num_rollouts": len(rollouts),
        "num_raters": len(raters),
        "score": float(means.mean()) if len(means) else UNDEFINED,
        "score_interval": [interval.low, interval.high] if interval else UNDEFINED,
        "alpha": _defined(alpha),
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
        "comment": _comment(alpha),
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


def _comment(alpha: float) -> str:
    if math.isnan(alpha):
        return (
            "Agreement is undefined: no rollout has two ratings, or all ratings are equal, so "
            "nothing shows that raters tell good rollouts from bad ones."
        )
    if alpha < LEAST_ALPHA:
        return (
            f"Raters agree too little (alpha {alpha:.2f}, below {LEAST_ALPHA}) for conclusions "
            "from these scores; discuss the rubric with examples and rate again."
        )
    return f"Raters agree (alpha {alpha:.2f})."


def _defined(value: float) -> float | str:
    return value if math.isfinite(value) else UNDEFINED
