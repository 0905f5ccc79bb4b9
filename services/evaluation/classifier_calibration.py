"""Calibration of a success classifier, and its metrics on endings that it was not trained on."""

from collections.abc import Sequence
from dataclasses import replace
from itertools import product
from typing import Final

import numpy as np
from jaxtyping import Bool, Float64

from dextouch.errors import InvalidInputError
from services.evaluation.endings import Ending, EndingEpisode
from services.evaluation.scores import LEAST_DECIDED
from services.evaluation.settings import RISK_OF_DECIDED
from services.evaluation.statistics import area_under_roc, balanced_accuracy
from services.evaluation.success_classifier import (
    DECISION_THRESHOLD,
    IMAGINED,
    TRUE,
    WHOLE_BAND,
    Calibration,
    Combination,
    SuccessClassifier,
    calibration_name,
    combination_name,
    log_odds_of,
    sigmoid,
)

NUM_BINS: Final = 10  # chosen; Guo et al. (2017) take 15
# The undecided band of a classifier alone is at most 5 % … 95 %.
_WIDEST_BAND: Final = 0.45
_MAX_NEWTON_STEPS: Final = 50
# Weight of the prior (temperature 1, bias 0) in the fit, in endings.
_PRIOR_ENDINGS: Final = 2.0
# No calibration is fitted with fewer endings of either outcome.
MIN_OUTCOMES: Final = 5
# Milestones with a lower area under the ROC curve are not reported by the probe.
MIN_MILESTONE_AUC: Final = 0.9
# Kind of true endings that are given poses and touch, but no image.
POSES: Final = "poses"
Figures = dict[str, float | int]


def expected_calibration_error(probabilities: np.ndarray, success: np.ndarray) -> float:
    """Mean distance of predicted and true success rates over bins of equal width (Guo et al. 2017).

    Bins are weighted by their number of endings; even a perfectly calibrated classifier has an
    error of about √(p(1−p)/n) in a bin of n.
    """
    predicted, outcomes = _pair(probabilities, success)
    bins = np.minimum((predicted * NUM_BINS).astype(int), NUM_BINS - 1)
    gaps = np.bincount(bins, weights=predicted - outcomes, minlength=NUM_BINS)
    return float(np.abs(gaps).sum() / len(predicted))


def brier(probabilities: np.ndarray, success: np.ndarray) -> float:
    """Mean squared difference of probability and outcome (Brier 1950)."""
    predicted, outcomes = _pair(probabilities, success)
    return float(np.mean((predicted - outcomes) ** 2))


def fit_calibration(
    log_odds: np.ndarray, success: np.ndarray, *, risk: float = RISK_OF_DECIDED
) -> Calibration:
    """Fit temperature, bias and undecided band to endings that were not trained on.

    Platt scaling with his targets (n⁺ + 1) / (n⁺ + 2) and 1 / (n⁻ + 2), which keep the fit finite
    for endings that are separated without error (Platt 1999), and a weak prior towards the
    network's own odds for small samples. `log_odds` [n] are those of the network, `success` [n] the
    outcomes; `risk` is the allowed share of errors among the decided endings. Raises
    InvalidInputError for only one outcome, or a risk outside 0 … 1.
    """
    odds, outcomes = np.asarray(log_odds, dtype=np.float64), np.asarray(success, dtype=bool)
    if odds.shape != outcomes.shape or outcomes.all() or not outcomes.any() or not 0 < risk < 1:
        raise InvalidInputError(
            f"calibration: got {odds.shape} log odds, {outcomes.sum()} successes of "
            f"{outcomes.shape} and risk {risk}; expected one each, both outcomes and "
            "a risk between 0 and 1"
        )
    slope, bias = _rising(odds, outcomes)
    fitted = Calibration(temperature=1 / max(slope, 1e-3), bias=bias)
    return fitted.model_copy(
        update={"band": undecided_band(fitted.probabilities(odds), outcomes, risk=risk)}
    )


def fit_combination(
    probe: np.ndarray,
    world: np.ndarray,
    success: np.ndarray,
    *,
    risk: float = RISK_OF_DECIDED,
    margin: float = 0.0,
) -> Combination:
    """Fit the weights and the undecided band to imagined endings that were not trained on.

    Logistic regression as in `fit_calibration`, with a weak prior towards the mean of both log
    odds. An estimate that would count negatively is left out. The band is the narrowest that keeps
    the risk, so it decides as many endings as possible. Where fewer than `LEAST_DECIDED` would be
    decided, twice the risk is allowed; where no band keeps that, nothing is decided.

    `probe` [n] are calibrated probabilities of the classifier, `world` [n] the world's own, and
    `success` [n] the outcomes; `risk` is the allowed share of errors among the decided endings.
    """
    of_probe, outcomes = _pair(probe, success)
    estimated, _ = _pair(world, success)
    odds, weights = (np.stack([log_odds_of(of_probe), log_odds_of(estimated)], axis=1), np.zeros(2))
    slopes, bias = _platt(odds, outcomes > 0.5)
    if min(slopes) > 0:
        weights[:] = slopes
    else:
        better = int(np.argmax(slopes))
        weights[better], bias = _rising(odds[:, better], outcomes > 0.5)
    fitted = Combination(probe_weight=weights[0], world_weight=weights[1], bias=bias, margin=margin)
    agreed = ~fitted.contradictory(of_probe, estimated)
    if not agreed.any():
        return fitted.model_copy(update={"band": WHOLE_BAND})
    joint = fitted.probabilities(of_probe, estimated)[agreed]
    for allowed in (risk, 2 * risk):
        band = undecided_band(joint, outcomes[agreed], risk=allowed, widest=WHOLE_BAND)
        if np.mean(np.abs(joint - DECISION_THRESHOLD) > band) >= LEAST_DECIDED:
            break
    return fitted.model_copy(update={"band": band})


def undecided_band(
    probabilities: np.ndarray, success: np.ndarray, *, risk: float, widest: float = _WIDEST_BAND
) -> float:
    """Smallest half width of the band outside of which at most `risk` of the decisions are wrong.

    It lies about `DECISION_THRESHOLD`. One error more than observed is assumed, as in conformal
    risk control, so that few endings give a wide band. The half width is capped at `widest`, even
    if the risk is then exceeded; with 0.5 nothing is decided where no band keeps the risk.
    """
    predicted, outcomes = _pair(probabilities, success)
    sureness = np.abs(predicted - DECISION_THRESHOLD)
    wrong = (predicted >= DECISION_THRESHOLD) != (outcomes > 0.5)
    # Just below a half width of 0 all are decided; each step excludes the least certain one.
    for width in np.concatenate([[0.0], np.sort(sureness)]):
        decided = sureness > width if width else np.ones(len(predicted), dtype=bool)
        if width >= widest:
            break
        if (wrong[decided].sum() + 1) / (decided.sum() + 1) <= risk:
            return float(width)
    return widest


def _rising(odds: Float64[np.ndarray, " n"], outcomes: np.ndarray) -> tuple[float, float]:
    """Slope and bias of one estimate.

    An estimate that ranks endings backwards is not inverted: it is made uninformative, so that the
    bias is that of the base rate.
    """
    (slope,), bias = _platt(odds[:, None], outcomes)
    return (slope, bias) if slope > 0 else (0.0, _platt(0 * odds[:, None], outcomes)[1])


def _platt(
    odds: Float64[np.ndarray, "n inputs"], outcomes: np.ndarray
) -> tuple[list[float], float]:
    """Slopes and bias that minimize the cross entropy to Platt's targets (Newton's method)."""
    wins, losses = int(outcomes.sum()), int((~outcomes).sum())
    target = np.where(outcomes, (wins + 1) / (wins + 2), 1 / (losses + 2))
    num_inputs = odds.shape[1]
    design = np.concatenate([odds, np.ones((len(odds), 1))], axis=1)
    # In units of the odds' own spread, so that the prior does not depend on the network's scale; it
    # alone determines the slope of odds that are all 0.
    pull = np.diag([*np.maximum(np.mean(odds**2, axis=0), 1e-6), 1.0]) * _PRIOR_ENDINGS / 4
    own = np.array([1 / num_inputs] * num_inputs + [0.0])
    fitted = own.copy()
    for _ in range(_MAX_NEWTON_STEPS):
        predicted = sigmoid(design @ fitted)
        gradient = design.T @ (predicted - target) + pull @ (fitted - own)
        curvature = (design * (predicted * (1 - predicted))[:, None]).T @ design + pull
        step = np.linalg.solve(curvature, gradient)
        fitted -= step * min(1.0, 1.0 / max(float(np.abs(step).max()), 1e-12))
        if np.abs(step).max() < 1e-9:
            break
    *slopes, bias = fitted.tolist()
    return slopes, bias


def _pair(probabilities: np.ndarray, success: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    predicted, outcomes = np.asarray(probabilities, np.float64), np.asarray(success, np.float64)
    if predicted.shape != outcomes.shape or predicted.ndim != 1 or len(predicted) == 0:
        raise InvalidInputError(
            f"calibration: got {predicted.shape} probabilities and {outcomes.shape} outcomes, "
            "expected one each, at least one"
        )
    return predicted, outcomes


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

    Only imagined endings count that the world estimates and does not call unreliable, since it is
    for these that the probe decides. Objects of unusual sizes have a combination of their own: a
    world is right about them less often.
    """
    found: dict[str, Combination] = {}
    for task, unusual_sizes in product(probe.shape.tasks, (False, True)):
        endings, success = final_endings(episodes, task, IMAGINED)
        rows = [
            row
            for row, ending in enumerate(endings)
            if ending.success_probability is not None
            and ending.unreliable is None
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


def classifiable_milestones(
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
        mine = [e for e in _seen(episodes, task) if e.event_times_s is not None]
        if not mine:
            continue
        odds = probe.log_odds([_as_seen(e.final) for e in mine])
        for index, name in enumerate(names):
            outcomes = np.array([bool((e.reached(names, e.last_step) or [])[index]) for e in mine])
            if min(outcomes.sum(), (~outcomes).sum()) >= MIN_OUTCOMES:
                areas[task, name] = area_under_roc(odds[:, 1 + index], outcomes)
    return areas


def held_out_figures(probe: SuccessClassifier, episodes: Sequence[EndingEpisode]) -> Figures:
    """Share of correct decisions over all tasks, and metrics of true and imagined endings by task.

    True endings are given without object poses, which a real robot does not have; `poses` are true
    endings with poses and touch but no image; `imagined` endings are given as they are. Raises
    InvalidInputError if a task has only one outcome.
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
            "poses": final_endings(episodes, task, POSES),
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
    before = sigmoid(probe.log_odds(endings)[:, 0])
    found: Figures = {
        "auc": area_under_roc(probabilities, success),
        "balanced_accuracy": balanced_accuracy(likely, success),
        "ece": expected_calibration_error(probabilities, success),
        "ece_uncalibrated": expected_calibration_error(before, success),
        "brier": brier(probabilities, success),
        "brier_uncalibrated": brier(before, success),
        "undecided": float(1 - decided.mean()),
    }
    if decided.any():
        found["accuracy_of_decided"] = float((likely == success)[decided].mean())
    return {name.format(key): value for key, value in found.items()}


def final_endings(
    episodes: Sequence[EndingEpisode], task: str, kind: str
) -> tuple[list[Ending], Bool[np.ndarray, " n"]]:
    """Final endings of a task as a probe gets them, and their outcomes.

    `kind` is true or imagined, or true ones with poses and touch but no image.
    """
    if kind == POSES:
        known = [e for e in episodes if e.task == task and e.final.object_poses is not None]
        mine = [e for e in known if not e.imagined]
        endings = [replace(e.final, images=None) for e in mine]
    else:
        mine = [e for e in _seen(episodes, task) if e.imagined == (kind == IMAGINED)]
        endings = [_as_seen(e.final) for e in mine]
    return endings, np.array([e.success for e in mine], dtype=bool)


def _seen(episodes: Sequence[EndingEpisode], task: str) -> list[EndingEpisode]:
    """Those of a task whose ending a probe sees: true ones without poses, so they need images."""
    mine = [e for e in episodes if e.task == task]
    return [e for e in mine if e.imagined or e.final.images is not None]


def _as_seen(ending: Ending) -> Ending:
    return ending if ending.imagined else replace(ending, object_poses=None)
