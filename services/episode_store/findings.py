"""Findings on items: figures beyond limits, and outliers among items of the same task.

The limits are those of live health for the same faults: they need no other items to compare with,
so they hold from the first take of a task on. Outliers have robust z-scores of figures,
0.6745 (x − median) / MAD, above 3.5 (Iglewicz and Hoaglin, How to Detect and Handle Outliers,
1993).
"""

import re
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Final, Literal

import numpy as np
from jaxtyping import Float64

from dextouch.schemas import ClockReport, EpisodeAttributes, Finding, RecordingAttributes
from dextouch.streams import LEAST_SHARE_KEPT, residual_limits_s

# MAD of a normal distribution with standard deviation 1 (Iglewicz and Hoaglin, section 3.3).
MAD_OF_SIGMA: Final = 0.6745
MAX_SCORE: Final = 3.5
# Median and MAD of fewer values say little about what is usual.
MIN_ITEMS: Final = 8


@dataclass(frozen=True)
class Figure:
    """A figure that all items may have.

    `resolution` is the smallest spread that matters: a task whose items hardly differ must not make
    outliers of differences that nobody would look at. `unit` "%" is shown of a share.
    """

    name: str
    label: str
    unit: str
    bad: Literal["high", "low", "both"]
    resolution: float

    def text(self, value: float) -> str:
        """The value as an operator reads it."""
        return f"{100 * value:.1f} %" if self.unit == "%" else f"{value:.3g} {self.unit}".rstrip()


FIGURES: Final = (
    Figure("duration_s", "duration", "s", "both", 0.25),
    Figure("coverage", "share of steps kept", "%", "low", 0.01),
    Figure("clock_residual_ms", "clock residual", "ms", "high", 0.1),
    Figure("num_gaps", "gaps", "", "high", 1.0),
    Figure("largest_gap_s", "largest gap", "s", "high", 0.02),
    Figure("lost_share", "samples lost", "%", "high", 0.002),
    Figure("tip_error_mm", "fingertip error of retargeting", "mm", "high", 0.5),
    Figure("peak_speed_m_s", "peak speed of a wrist", "m/s", "both", 0.1),
    Figure("jerk_p95_m_s3", "jerk of a wrist", "m/s³", "high", 5.0),
    Figure("static_share", "share of time at rest", "%", "both", 0.02),
)
# Figures that are made of those of single streams or hands: their names, and how.
_COLLECTED: Final[Mapping[str, tuple[str, Callable[[Iterable[float]], float]]]] = {
    "num_gaps": (r".+_num_gaps", sum),
    "largest_gap_s": (r".+_largest_gap_s", max),
    "tip_error_mm": (r"retargeting_.+_tip_error_p95_mm", max),
    "peak_speed_m_s": (r"(.+_)?peak_speed_m_s", max),
    "jerk_p95_m_s3": (r"(.+_)?jerk_p95_m_s3", max),
    "static_share": (r"static_share", min),
}


def figures_of(
    attributes: EpisodeAttributes | RecordingAttributes, *, num_steps: int, duration_s: float
) -> dict[str, float]:
    """The figures that an item has; `num_steps` are those of an episode."""
    quality = attributes.quality
    found = {"duration_s": duration_s}
    for name, (pattern, collect) in _COLLECTED.items():
        values = [value for key, value in quality.items() if re.fullmatch(pattern, key)]
        if values:
            found[name] = float(collect(values))
    if "coverage" in quality:
        found["coverage"] = quality["coverage"]
    elif num_steps and "num_steps_refused" in quality:
        num_measured = num_steps - quality.get("num_steps_interpolated", 0.0)
        found["coverage"] = num_measured / (num_steps + quality["num_steps_refused"])
    if isinstance(attributes, EpisodeAttributes):
        found |= _clock_figures(attributes.clocks)
    return found


def _clock_figures(clocks: Iterable[ClockReport]) -> dict[str, float]:
    found = {}
    residuals_ms = [one.residual_rms_ms for one in clocks if one.residual_rms_ms is not None]
    if residuals_ms:
        found["clock_residual_ms"] = max(residuals_ms)
    dropped = sum(clock.num_dropped for clock in clocks)
    offered = dropped + sum(clock.num_samples for clock in clocks)
    if offered:
        found["lost_share"] = dropped / offered
    return found


def robust_scores(
    values: Float64[np.ndarray, " n"], *, resolution: float
) -> Float64[np.ndarray, " n"]:
    """Deviations from the median in robust standard deviations, at least `resolution` each."""
    deviations = values - np.median(values)
    sigma = float(np.median(np.abs(deviations))) / MAD_OF_SIGMA
    return deviations / max(sigma, resolution)


def find_outliers(items: Sequence[Mapping[str, float]]) -> list[list[Finding]]:
    """Findings of each item of one task; none where fewer than MIN_ITEMS have a figure."""
    found: list[list[Finding]] = [[] for _ in items]
    for figure in FIGURES:
        owners = [place for place, figures in enumerate(items) if figure.name in figures]
        if len(owners) < MIN_ITEMS:
            continue
        values = np.array([items[place][figure.name] for place in owners])
        scores = robust_scores(values, resolution=figure.resolution)
        for place, value, score in zip(owners, values.tolist(), scores.tolist(), strict=True):
            if _is_outlier(figure, score):
                found[place].append(_finding(figure, value, float(np.median(values)), score))
    return found


def _is_outlier(figure: Figure, score: float) -> bool:
    if figure.bad == "both":
        return abs(score) > MAX_SCORE
    return (score if figure.bad == "high" else -score) > MAX_SCORE


def _finding(figure: Figure, value: float, median: float, score: float) -> Finding:
    text = f"{figure.label} {figure.text(value)}, usually {figure.text(median)}"
    return Finding(
        code="outlier", message=text, figure=figure.name, value=value, median=median, score=score
    )


def beyond_limits(
    attributes: EpisodeAttributes | RecordingAttributes, figures: Mapping[str, float]
) -> tuple[Finding, ...]:
    """Findings of an item with these figures."""
    found = []
    kept = figures.get("coverage", 1.0)
    if kept < LEAST_SHARE_KEPT:
        text = f"share of steps kept {kept:.1%}, expected at least {LEAST_SHARE_KEPT:.0%}"
        found.append(_beyond("coverage", kept, text))
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
            found.append(_beyond("clock_residual_ms", clock.residual_rms_ms, text))
    return found


def _beyond(figure: str, value: float, text: str) -> Finding:
    return Finding(code="beyond_limit", message=text, figure=figure, value=value)
