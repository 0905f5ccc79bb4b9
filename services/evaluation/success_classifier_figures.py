"""Calibration of a trained success classifier, and its metrics on held-out endings."""

from collections.abc import Sequence
from dataclasses import replace
from itertools import product
from typing import Final

import numpy as np
from jaxtyping import Bool

from services.evaluation.calibration import (
    Calibration,
    Combination,
    Reliability,
    fit_calibration,
    fit_combination,
    sigmoid,
)
from services.evaluation.endings import Ending, EndingEpisode
from services.evaluation.statistics import area_under_roc, balanced_accuracy
from services.evaluation.success_classifier import (
    IMAGINED,
    TRUE,
    SuccessClassifier,
    calibration_name,
    combination_name,
)

# No calibration is fitted with fewer endings of either outcome.
MIN_OUTCOMES: Final = 5
# Milestones with a lower area under the ROC curve are not reported by the probe.
MIN_MILESTONE_AUC: Final = 0.9
Figures = dict[str, float | int]


def fit_calibrations(
    probe: SuccessClassifier, episodes: Sequence[EndingEpisode], *, risk: float
) -> dict[str, Calibration]:
    """Calibration of every task and kind of ending with enough of both outcomes."""
    found: dict[str, Calibration] = {}
    for task in probe.shape.tasks:
        for kind in (TRUE, IMAGINED):
            endings, success = final_endings(episodes, task, kind)
            if min(success.sum(), (~success).sum()) < MIN_OUTCOMES:
                continue
            odds = probe.log_odds(endings)[:, 0]
            found[calibration_name(task, kind)] = fit_calibration(odds, success, risk=risk)
    return found


def fit_combinations(
    probe: SuccessClassifier, episodes: Sequence[EndingEpisode], *, risk: float, margin: float
) -> dict[str, Combination]:
    """Combination of a calibrated probe with the world's own estimates, of every task.

    Only imagined endings count that the world estimates and does not doubt, since it is for these
    that the probe decides. Objects of unusual sizes have a combination of their own: a world is
    right about them less often.
    """
    found: dict[str, Combination] = {}
    for task, unusual_sizes in product(probe.shape.tasks, (False, True)):
        endings, success = final_endings(episodes, task, IMAGINED)
        rows = [
            row
            for row, ending in enumerate(endings)
            if ending.success_probability is not None
            and ending.doubted is None
            and ending.has_unusual_sizes == unusual_sizes
        ]
        outcomes = success[rows]
        if min(outcomes.sum(), (~outcomes).sum()) < MIN_OUTCOMES:
            continue
        mine = [endings[row] for row in rows]
        world = np.array([ending.success_probability for ending in mine], dtype=np.float64)
        name = combination_name(task, unusual_sizes=unusual_sizes)
        found[name] = fit_combination(
            probe.probabilities(mine), world, outcomes, risk=risk, margin=margin
        )
    return found


def milestones_that_can_be_told(
    probe: SuccessClassifier, episodes: Sequence[EndingEpisode]
) -> dict[str, tuple[str, ...]]:
    """Milestones of every task that the probe classifies well on held-out endings."""
    areas = milestone_areas(probe, episodes)
    return {
        task: tuple(n for n in names if areas.get((task, n), 0.0) >= MIN_MILESTONE_AUC)
        for task, names in probe.shape.milestones.items()
    }


def milestone_areas(
    probe: SuccessClassifier, episodes: Sequence[EndingEpisode]
) -> dict[tuple[str, str], float]:
    """Area under the ROC curve of every task and milestone with both outcomes."""
    areas: dict[tuple[str, str], float] = {}
    for task, names in probe.shape.milestones.items():
        mine = [e for e in episodes if e.task == task and e.event_times_s is not None]
        if not mine:
            continue
        odds = probe.log_odds([_as_seen(e.final, TRUE) for e in mine])
        for index, name in enumerate(names):
            outcomes = np.array([bool((e.reached(names, e.last_step) or [])[index]) for e in mine])
            if min(outcomes.sum(), (~outcomes).sum()) >= MIN_OUTCOMES:
                areas[task, name] = area_under_roc(odds[:, 1 + index], outcomes)
    return areas


def held_out_figures(probe: SuccessClassifier, episodes: Sequence[EndingEpisode]) -> Figures:
    """Share of correct decisions over all tasks, and metrics of true and imagined endings by task.

    True endings are given without object poses, which a real robot does not have; `poses` are true
    endings with poses and touch but no image; `imagined` endings are given as they are.

    Raises:
        InvalidInputError: a task has only one outcome.
    """
    figures: Figures = {}
    right: list[bool] = []
    for task in probe.shape.tasks:
        endings, success = final_endings(episodes, task, TRUE)
        right.extend(((probe.probabilities(endings) >= probe.threshold) == success).tolist())
        figures |= _figures(probe, endings, success, f"held_out_{{}}_{task}")
        figures[f"num_held_out_successes_{task}"] = int(success.sum())
        figures[f"num_held_out_failures_{task}"] = int((~success).sum())
        for kind, (others, outcomes) in {
            "poses": _with_poses_only(episodes, task),
            "imagined": final_endings(episodes, task, IMAGINED),
        }.items():
            if min(outcomes.sum(), (~outcomes).sum()) >= MIN_OUTCOMES:
                figures |= _figures(probe, others, outcomes, f"held_out_{kind}_{{}}_{task}")
    for (task, name), area in milestone_areas(probe, episodes).items():
        figures[f"held_out_milestone_auc_{task}_{name}"] = area
    return {"held_out_accuracy": float(np.mean(right)), **figures}


def _figures(
    probe: SuccessClassifier, endings: Sequence[Ending], success: np.ndarray, name: str
) -> Figures:
    verdicts = probe.verdicts(endings)
    probabilities = np.array([v.probability for v in verdicts])
    likely = np.array([v.likely_success for v in verdicts])
    decided = np.array([v.decision != "cannot tell" for v in verdicts])
    before = Reliability.of(sigmoid(probe.log_odds(endings)[:, 0]), success)
    after = Reliability.of(probabilities, success)
    found: Figures = {
        "auc": area_under_roc(probabilities, success),
        "balanced_accuracy": balanced_accuracy(likely, success),
        "ece": after.expected_calibration_error,
        "ece_uncalibrated": before.expected_calibration_error,
        "brier": after.brier,
        "brier_uncalibrated": before.brier,
        "undecided": float(1 - decided.mean()),
    }
    if decided.any():
        found["accuracy_of_decided"] = float((likely == success)[decided].mean())
    return {name.format(key): value for key, value in found.items()}


def final_endings(
    episodes: Sequence[EndingEpisode], task: str, kind: str
) -> tuple[list[Ending], Bool[np.ndarray, " n"]]:
    """Final endings of a task, true or imagined, as a probe gets them, and their outcomes."""
    mine = [e for e in episodes if e.task == task and e.imagined == (kind == IMAGINED)]
    success = np.array([e.success for e in mine], dtype=bool)
    return [_as_seen(e.final, kind) for e in mine], success


def _as_seen(ending: Ending, kind: str) -> Ending:
    return replace(ending, object_poses=None) if kind == TRUE and not ending.imagined else ending


def _with_poses_only(
    episodes: Sequence[EndingEpisode], task: str
) -> tuple[list[Ending], Bool[np.ndarray, " n"]]:
    mine = [
        e
        for e in episodes
        if e.task == task and not e.imagined and e.final.object_poses is not None
    ]
    success = np.array([e.success for e in mine], dtype=bool)
    return [replace(e.final, images=None) for e in mine], success
