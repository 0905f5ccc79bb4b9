"""Errors of estimated sample times of one take, in milliseconds."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float64

from benchmarks.clocks.scenes import BASE_DELAY_NS, Take

# Warm-up time of causal fits.
WARM_UP_S = 10.0
# Time after a clock step that is excluded for online fits.
RECOVERY_S = 1.2
BOUND_MS = 0.3


@dataclass(frozen=True)
class Score:
    """Errors of one take, after subtraction of the constant path delay.

    `recovery_s` is the time after the clock's step until the error falls below 0.3 ms (RMS over
    half a second); None in scenes without a step.
    """

    rms_ms: float
    p99_ms: float
    recovery_s: float | None = None


def score(estimate_ns: np.ndarray, take: Take, *, is_online: bool) -> Score:
    """Compare with the true times; online fits are not scored in the warm-up and after a step."""
    error_ms = (estimate_ns - take.true_ns - BASE_DELAY_NS) * 1e-6
    age_s = (take.true_ns - take.true_ns[0]) * 1e-9
    counts = np.ones(len(take), dtype=bool)
    recovery_s = None
    if is_online:
        counts &= age_s > WARM_UP_S
    if is_online and take.step_true_ns is not None:
        since_s = (take.true_ns - take.step_true_ns) * 1e-9
        counts &= (since_s < 0) | (since_s > RECOVERY_S)
        recovery_s = _recovery_s(error_ms, since_s)
    kept = np.abs(error_ms[counts])
    return Score(float(np.sqrt(np.mean(kept**2))), float(np.percentile(kept, 99)), recovery_s)


def _recovery_s(
    error_ms: Float64[np.ndarray, " n"], since_s: Float64[np.ndarray, " n"], *, run_s: float = 0.5
) -> float:
    """Start of the last half second above the bound, relative to the step."""
    after = since_s >= 0
    since_s, squares = since_s[after], error_ms[after] ** 2
    sums = np.concatenate([[0.0], np.cumsum(squares)])
    stops = np.searchsorted(since_s, since_s + run_s)
    means = (sums[stops] - sums[:-1]) / (stops - np.arange(len(squares)))
    # Limited to a minute after the step, to isolate its effect.
    bad = np.flatnonzero((means > BOUND_MS**2) & (since_s < 10.0))
    return float(since_s[min(bad[-1] + 1, len(since_s) - 1)]) if len(bad) else 0.0
