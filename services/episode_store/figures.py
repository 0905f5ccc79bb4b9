"""Figures of an item's quality by which the items of a task are compared."""

import re
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass
from typing import Final, Literal

from dextouch.schemas import ClockReport, EpisodeAttributes, RecordingAttributes


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
        found["coverage"] = num_steps / (num_steps + quality["num_steps_refused"])
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
