"""Limits of what a stream may deviate, the same in live health and in the review of takes."""

from typing import Final

# Deviation from the nominal rate, and so the share of a take's steps that may be missing.
RATE_WARN: Final = 0.02
RATE_ERROR: Final = 0.10
LEAST_SHARE_KEPT: Final = 1.0 - RATE_ERROR
# Scatter of arrivals about a device's clock.
RESIDUAL_WARN_S: Final = 4e-3
RESIDUAL_ERROR_S: Final = 10e-3
# Counting tolerates delays of almost a period: of streams without stamps and numbers, shares of it.
RESIDUAL_SHARES: Final = (0.25, 0.5)


def residual_limits_s(counted_period_s: float | None) -> tuple[float, float]:
    """From where on the scatter of arrivals is a warning and an error.

    Args:
        counted_period_s: period of a stream that is dated by counting its samples; None of others.
    """
    warn_s, error_s = RESIDUAL_WARN_S, RESIDUAL_ERROR_S
    if counted_period_s is None:
        return warn_s, error_s
    warn_share, error_share = RESIDUAL_SHARES
    return max(warn_s, warn_share * counted_period_s), max(error_s, error_share * counted_period_s)
