"""Agreement between policy scores in reality and in imagination; NaN where undefined."""

from typing import Final

import numpy as np

from dextouch.errors import UnknownNameError
from dextouch.metrics.image import checked_pair

TIE_RULES = ("paper", "simpler")
# Two points always lie on a line, and two ranks always agree or are reversed: every correlation
# of two policies is 1 or -1, whatever their scores.
MIN_POLICIES: Final = 3
# Sums of equal shares differ by about 1e-16 in another order; rates of a million starts by 1e-6.
_ROUNDING: Final = 1e-12


def _scores(real: np.ndarray, imagined: np.ndarray, what: str) -> tuple[np.ndarray, np.ndarray]:
    a, b = checked_pair(real, imagined, what=f"{what} of policy scores", tail=(None,))
    return a.ravel(), b.ravel()


def pearson(*, real: np.ndarray, imagined: np.ndarray) -> float:
    """Linear correlation in −1 … 1; NaN for fewer than three policies, or equal scores."""
    a, b = _scores(real, imagined, "Pearson")
    if len(a) < MIN_POLICIES or _all_equal(a) or _all_equal(b):
        return float("nan")
    a, b = a - a.mean(), b - b.mean()
    # Squares of tiny or huge numbers under- or overflow float64.
    a, b = a / np.abs(a).max(), b / np.abs(b).max()
    r = np.dot(a / np.linalg.norm(a), b / np.linalg.norm(b))
    return float(np.clip(r, -1.0, 1.0))


def spearman(*, real: np.ndarray, imagined: np.ndarray) -> float:
    """Pearson correlation of ranks; ties share their mean rank. NaN when undefined."""
    a, b = _scores(real, imagined, "Spearman")
    return pearson(real=_mean_ranks(a), imagined=_mean_ranks(b))


def kendall(*, real: np.ndarray, imagined: np.ndarray) -> float:
    """Kendall's τ-b, corrected for ties; NaN for fewer than three policies, or equal scores."""
    a, b = _scores(real, imagined, "Kendall")
    if len(a) < MIN_POLICIES:
        return float("nan")
    order_a, order_b = _orders(a), _orders(b)
    pairs = np.count_nonzero(order_a) * np.count_nonzero(order_b)
    return float(np.sum(order_a * order_b) / np.sqrt(pairs)) if pairs else float("nan")


def mmrv(*, real: np.ndarray, imagined: np.ndarray, ties: str = "paper") -> float:
    """Mean maximum rank violation of scores [policies]: 0 is best.

    `(1/N) Σ_i max_j |real_i − real_j| · v_ij`, in the unit of the scores; NaN for fewer than two
    policies. Both rules count a pair in opposite order; they differ when one side ties. "paper":
    v_ij = 1 only if the differences have opposite signs, so a tie never counts. "simpler": as in
    SimplerEnv, v_ij = 1 if `imagined_i > imagined_j` and `real_i > real_j` differ, so a tie on the
    imagined side does.

    Raises:
        UnknownNameError: another tie rule.
    """
    a, b = _scores(real, imagined, "MMRV")
    if ties not in TIE_RULES:
        raise UnknownNameError("tie rule", ties, list(TIE_RULES))
    if len(a) < 2:
        return float("nan")
    if ties == "paper":
        violated = _orders(a) * _orders(b) < 0
    else:
        violated = (_orders(a) > 0) != (_orders(b) > 0)
    return float(np.mean(np.max(np.abs(a[:, None] - a[None, :]) * violated, axis=1)))


def bias(*, real: np.ndarray, imagined: np.ndarray) -> float:
    """Mean of imagined − real: positive where imagination overestimates."""
    a, b = _scores(real, imagined, "bias")
    return float(np.mean(b - a))


def mean_absolute_error(*, real: np.ndarray, imagined: np.ndarray) -> float:
    """Mean absolute difference of imagined and real scores, in the unit of the scores."""
    a, b = _scores(real, imagined, "mean absolute error")
    return float(np.mean(np.abs(b - a)))


def _orders(scores: np.ndarray) -> np.ndarray:
    """+1, 0 or −1 for every ordered pair; scores that differ by rounding alone are equal."""
    gaps = scores[:, None] - scores[None, :]
    return np.where(np.abs(gaps) <= _ROUNDING * np.abs(scores).max(), 0.0, np.sign(gaps))


def _all_equal(scores: np.ndarray) -> bool:
    return bool(np.ptp(scores) <= _ROUNDING * np.abs(scores).max())


def _mean_ranks(scores: np.ndarray) -> np.ndarray:
    order = _orders(scores)
    return (order > 0).sum(axis=1) + (order == 0).sum(axis=1) / 2
