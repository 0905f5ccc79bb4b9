"""Findings of a single item: figures beyond the limits that live health has for the same faults.

They need no other items to compare with, so they hold from the first take of a task on.
"""

from collections.abc import Mapping

from dextouch.schemas import EpisodeAttributes, Finding, RecordingAttributes
from dextouch.streams import LEAST_SHARE_KEPT, residual_limits_s


def beyond_limits(
    attributes: EpisodeAttributes | RecordingAttributes, figures: Mapping[str, float]
) -> tuple[Finding, ...]:
    """Findings of an item with these figures."""
    found = []
    kept = figures.get("coverage", 1.0)
    if kept < LEAST_SHARE_KEPT:
        text = f"share of steps kept {kept:.1%}, expected at least {LEAST_SHARE_KEPT:.0%}"
        found.append(Finding(code="beyond_limit", message=text, figure="coverage", value=kept))
    if isinstance(attributes, EpisodeAttributes):
        found += _scattered(attributes)
    return tuple(found)


def _scattered(attributes: EpisodeAttributes) -> list[Finding]:
    rates_hz = {stream.name: stream.nominal_rate_hz for stream in attributes.streams}
    found = []
    for clock in attributes.clocks:
        if clock.residual_rms_ms is None:
            continue
        rate_hz = rates_hz.get(clock.stream) if clock.method == "counting" else None
        _, limit_s = residual_limits_s(None if rate_hz is None else 1.0 / rate_hz)
        limit_ms = 1e3 * limit_s
        if clock.residual_rms_ms >= limit_ms:
            text = (
                f"{clock.stream}: arrivals scatter by {clock.residual_rms_ms:.1f} ms about its "
                f"clock, expected less than {limit_ms:.3g} ms"
            )
            found.append(
                Finding(
                    code="beyond_limit",
                    message=text,
                    figure="clock_residual_ms",
                    value=clock.residual_rms_ms,
                )
            )
    return found
