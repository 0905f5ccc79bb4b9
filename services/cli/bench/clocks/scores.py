"""Estimated and true times of one take in; errors in milliseconds out."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float64

from services.cli.bench.clocks.scenes import BASE_DELAY_NS, Take

# A fit that looks back only needs some seconds of samples before it can be judged.
WARM_UP_S = 10.0
# After a step of the device's clock, an online fit may be wrong for so long.
RECOVERY_S = 1.2
BOUND_MS = 0.3


@dataclass(frozen=True)
class Score:
    """Errors of one take, the constant path delay taken away.

    Attributes:
        rms_ms: root mean square, of everything that counts.
        p99_ms: 99th percentile of the absolute error.
        recovery_s: how long after the clock's step the error stayed above 0.3 ms (RMS over half
            a second); None in scenes without a step.
    """

    rms_ms: float
    p99_ms: float
    recovery_s: float | None = None


def score(estimate_ns: np.ndarray, take: Take, *, is_online: bool) -> Score:
    """Compare with the truth; online fits are not judged in the warm-up and right after a step."""
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
    """When the last half second above the bound began, counted from the step."""
    after = since_s >= 0
    since_s, squares = since_s[after], error_ms[after] ** 2
    sums = np.concatenate([[0.0], np.cumsum(squares)])
    stops = np.searchsorted(since_s, since_s + run_s)
    means = (sums[stops] - sums[:-1]) / (stops - np.arange(len(squares)))
    # Only what the step did: a minute later nothing of it is left to see.
    bad = np.flatnonzero((means > BOUND_MS**2) & (since_s < 10.0))
    return float(since_s[min(bad[-1] + 1, len(since_s) - 1)]) if len(bad) else 0.0
