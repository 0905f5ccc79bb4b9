"""Calibration of a success classifier: maps log odds to probabilities that match frequencies.

Temperature and bias for each task and kind of ending are fitted on episodes that the classifier was
not trained on, together with the band of probabilities in which it should abstain. `Combination`
joins a classifier of imagined endings with the world's own estimate of success.
"""

from dataclasses import dataclass
from typing import Final

import numpy as np
from jaxtyping import Bool, Float64
from pydantic import Field

from dextouch.errors import InvalidInputError
from dextouch.frozen_model import FrozenModel

NUM_BINS: Final = 10
_MAX_NEWTON_STEPS: Final = 50
# Weight of the prior (temperature 1, bias 0) in the fit, in endings.
_PRIOR_ENDINGS: Final = 2.0
# Allowed share of wrong answers among the decided endings. Kinds of mistakes that nothing was
# calibrated on are judged wrongly about twice as often.
UNDECIDED_RISK: Final = 0.05
# Endings that should be decided where classifier and world are good enough.
LEAST_DECIDED: Final = 0.60
# The undecided band of a classifier alone is at most 5 % … 95 %.
_WIDEST_BAND: Final = 0.45
# The band within which everything is undecided.
_WHOLE_BAND: Final = 0.5
# Estimates are counted as at most this sure: the mean over a few members is often 0 or 1.
_LEAST_PROBABILITY: Final = 0.01


class Calibration(FrozenModel):
    """Probability = sigmoid(log odds / temperature + bias); undecided within `band` of 0.5."""

    temperature: float = Field(default=1.0, gt=0)
    bias: float = 0.0
    band: float = Field(default=0.0, ge=0, lt=0.5)

    def probabilities(self, log_odds: np.ndarray) -> Float64[np.ndarray, " n"]:
        """Calibrated probabilities of success."""
        return sigmoid(np.asarray(log_odds, dtype=np.float64) / self.temperature + self.bias)


class Combination(FrozenModel):
    """Joins the calibrated probability of a classifier with the world's own estimate.

    The log odds of the result are the weighted sum of both log odds and `bias`; it is undecided
    within `band` of 0.5. The two contradict each other if they lie on different sides of 0.5, each
    by more than `margin`; with a margin of 0.5 they never do.
    """

    probe_weight: float = Field(default=0.5, ge=0)
    world_weight: float = Field(default=0.5, ge=0)
    bias: float = 0.0
    band: float = Field(default=0.0, ge=0, le=_WHOLE_BAND)
    margin: float = Field(default=0.0, ge=0, le=0.5)

    def probabilities(self, probe: np.ndarray, world: np.ndarray) -> Float64[np.ndarray, " n"]:
        """Joint probabilities of success."""
        odds = self.probe_weight * _log_odds(probe) + self.world_weight * _log_odds(world)
        return sigmoid(odds + self.bias)

    def contradictory(self, probe: np.ndarray, world: np.ndarray) -> Bool[np.ndarray, " n"]:
        """Whether classifier and world contradict each other."""
        low, high = np.minimum(probe, world), np.maximum(probe, world)
        return np.asarray((low < 0.5 - self.margin) & (high > 0.5 + self.margin))


# For probes that were trained before their world estimated success: the mean of both log odds, with
# the band outside of which a tenth of the development kinds of mistakes was judged wrongly.
UNFITTED: Final = Combination(band=0.3)


@dataclass(frozen=True)
class Reliability:
    """Calibration metrics of probabilities; 0 is best for both."""

    expected_calibration_error: float
    brier: float

    @classmethod
    def of(cls, probabilities: np.ndarray, success: np.ndarray) -> "Reliability":
        """Metrics of a set of endings."""
        return cls(
            expected_calibration_error(probabilities, success), brier(probabilities, success)
        )


def sigmoid(log_odds: np.ndarray) -> Float64[np.ndarray, "*n"]:
    """1 / (1 + exp(−x)), without overflow."""
    return np.asarray(np.exp(-np.logaddexp(0.0, -log_odds)))


def expected_calibration_error(
    probabilities: np.ndarray, success: np.ndarray, *, num_bins: int = NUM_BINS
) -> float:
    """Mean distance of predicted and true success rates over bins of equal width (Guo et al. 2017).

    Bins are weighted by their number of endings. Even a perfectly calibrated classifier has an
    error of about √(p(1−p)/n) in a bin of n.

    Raises:
        InvalidInputError: no endings, or arrays of different lengths.
    """
    predicted, outcomes = _pair(probabilities, success)
    bins = np.minimum((predicted * num_bins).astype(int), num_bins - 1)
    gaps = np.bincount(bins, weights=predicted - outcomes, minlength=num_bins)
    return float(np.abs(gaps).sum() / len(predicted))


def brier(probabilities: np.ndarray, success: np.ndarray) -> float:
    """Mean squared difference of probability and outcome (Brier 1950).

    Raises:
        InvalidInputError: no endings, or arrays of different lengths.
    """
    predicted, outcomes = _pair(probabilities, success)
    return float(np.mean((predicted - outcomes) ** 2))


def fit_calibration(
    log_odds: np.ndarray, success: np.ndarray, *, risk: float = UNDECIDED_RISK
) -> Calibration:
    """Fit temperature, bias and undecided band to endings that were not trained on.

    Platt scaling with his targets (n⁺ + 1) / (n⁺ + 2) and 1 / (n⁻ + 2), which keep the fit finite
    for endings that are separated without error (Platt 1999), and a weak prior towards the
    network's own odds for small samples.

    Args:
        log_odds: [n] log odds from the network.
        success: [n] outcomes.
        risk: allowed share of errors among the decided endings.

    Raises:
        InvalidInputError: only one outcome, or a risk outside 0 … 1.
    """
    odds, outcomes = np.asarray(log_odds, dtype=np.float64), np.asarray(success, dtype=bool)
    if odds.shape != outcomes.shape or outcomes.all() or not outcomes.any() or not 0 < risk < 1:
        raise InvalidInputError(
            f"calibration: got {odds.shape} log odds, {outcomes.sum()} successes of "
            f"{outcomes.shape} and risk {risk}; expected one each, both outcomes and "
            "a risk between 0 and 1"
        )
    (slope,), bias = _platt(odds[:, None], outcomes)
    # A classifier that ranks endings backwards is not inverted: it is made uninformative.
    fitted = Calibration(temperature=1 / max(slope, 1e-3), bias=bias)
    return fitted.model_copy(
        update={"band": undecided_band(fitted.probabilities(odds), outcomes, risk=risk)}
    )


def fit_combination(
    probe: np.ndarray,
    world: np.ndarray,
    success: np.ndarray,
    *,
    risk: float = UNDECIDED_RISK,
    margin: float = 0.0,
) -> Combination:
    """Fit the weights and the undecided band to imagined endings that were not trained on.

    Logistic regression as in `fit_calibration`, with a weak prior towards the mean of both log
    odds. An estimate that would count negatively is left out. The band is the narrowest that keeps
    the risk, so it decides as many endings as possible. Where fewer than `LEAST_DECIDED` would be
    decided, twice the risk is allowed; where no band keeps that, nothing is decided.

    Args:
        probe: [n] calibrated probabilities of the classifier.
        world: [n] the world's own probabilities.
        success: [n] outcomes.
        risk: allowed share of errors among the decided endings.
        margin: of `Combination`.

    Raises:
        InvalidInputError: no endings, or arrays of different lengths.
    """
    told, outcomes = _pair(probe, success)
    estimated, _ = _pair(world, success)
    odds, weights = np.stack([_log_odds(told), _log_odds(estimated)], axis=1), np.zeros(2)
    slopes, bias = _platt(odds, outcomes > 0.5)
    if min(slopes) > 0:
        weights[:] = slopes
    else:
        better = int(np.argmax(slopes))
        (slope,), bias = _platt(odds[:, better, None], outcomes > 0.5)
        weights[better] = max(slope, 0.0)
    fitted = Combination(probe_weight=weights[0], world_weight=weights[1], bias=bias, margin=margin)
    agreed = ~fitted.contradictory(told, estimated)
    if not agreed.any():
        return fitted.model_copy(update={"band": _WHOLE_BAND})
    joint = fitted.probabilities(told, estimated)[agreed]
    for allowed in (risk, 2 * risk):
        band = undecided_band(joint, outcomes[agreed], risk=allowed, widest=_WHOLE_BAND)
        if np.mean(np.abs(joint - 0.5) > band) >= LEAST_DECIDED:
            break
    return fitted.model_copy(update={"band": band})


def undecided_band(
    probabilities: np.ndarray, success: np.ndarray, *, risk: float, widest: float = _WIDEST_BAND
) -> float:
    """Smallest half width about 0.5 outside of which at most `risk` of the decisions are wrong.

    One error more than observed is assumed, as in conformal risk control, so that few endings give
    a wide band. The half width is capped at `widest`, even if the risk is then exceeded; with 0.5
    nothing is decided where no band keeps the risk.
    """
    predicted, outcomes = _pair(probabilities, success)
    sureness = np.abs(predicted - 0.5)
    wrong = (predicted >= 0.5) != (outcomes > 0.5)
    # Just below a half width of 0 all are decided; each step excludes the least certain one.
    for width in np.concatenate([[0.0], np.sort(sureness)]):
        decided = sureness > width if width else np.ones(len(predicted), dtype=bool)
        if width >= widest:
            break
        if (wrong[decided].sum() + 1) / (decided.sum() + 1) <= risk:
            return float(width)
    return widest


def _log_odds(probabilities: np.ndarray) -> Float64[np.ndarray, " n"]:
    bounded = np.clip(
        np.asarray(probabilities, np.float64), _LEAST_PROBABILITY, 1 - _LEAST_PROBABILITY
    )
    return np.asarray(np.log(bounded / (1 - bounded)))


def _platt(
    odds: Float64[np.ndarray, "n inputs"], outcomes: np.ndarray
) -> tuple[list[float], float]:
    """Slopes and bias that minimize the cross entropy to Platt's targets (Newton's method)."""
    wins, losses = int(outcomes.sum()), int((~outcomes).sum())
    target = np.where(outcomes, (wins + 1) / (wins + 2), 1 / (losses + 2))
    num_inputs = odds.shape[1]
    design = np.concatenate([odds, np.ones((len(odds), 1))], axis=1)
    # In units of the odds' own spread, so that the prior does not depend on the network's scale.
    pull = np.diag([*np.mean(odds**2, axis=0), 1.0]) * _PRIOR_ENDINGS / 4
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
