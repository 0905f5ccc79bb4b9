"""What a catalog says of an item: its figures, what its sources add, and findings.

Items are recordings, episodes, or takes. A take is a recording together with the episodes that were
made from it, or an episode without a stored recording.

Findings are figures beyond limits, and outliers among items of the same task. The limits are those
of live health for the same faults: they need no other items to compare with, so they hold from the
first take of a task on. Outliers have robust z-scores of figures, 0.6745 (x − median) / MAD, above
3.5 (Iglewicz and Hoaglin, How to Detect and Handle Outliers, 1993).
"""

import re
from collections import defaultdict
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from functools import lru_cache
from typing import Any, Final, Literal

import numpy as np
from jaxtyping import Float64
from pydantic import Field

from dextouch.episodes import EpisodeReader, RecordingReader
from dextouch.schemas import (
    SHARED_ATTRIBUTES,
    CatalogItem,
    ClockReport,
    EpisodeAttributes,
    EpisodeSummary,
    Finding,
    RecordingAttributes,
    RecordingSummary,
    Review,
)
from dextouch.streams import LEAST_SHARE_KEPT, residual_limits_s
from services.episode_store.filters import EpisodeFilter

# Median and scale of each figure among the items of a group.
Spread = Float64[np.ndarray, "2 figures"]
HoursField = Literal["task", "operator", "station", "day"]
# MAD of a normal distribution with standard deviation 1 (Iglewicz and Hoaglin, section 3.3).
MAD_OF_SIGMA: Final = 0.6745
MAX_SCORE: Final = 3.5
# Median and MAD of fewer values say little about what is usual.
MIN_ITEMS: Final = 8


def item_of(
    reader: EpisodeReader | RecordingReader, summary: EpisodeSummary | RecordingSummary
) -> CatalogItem:
    """The row of an item on its own."""
    about = reader.attributes
    fields: dict[str, Any] = {name: getattr(about, name) for name in SHARED_ATTRIBUTES}
    if isinstance(summary, EpisodeSummary):
        fields |= {"kind": "episode", "origin": summary.origin, "at": summary.created_at}
        num_steps = summary.num_steps
    else:
        fields |= {"kind": "recording", "origin": "recorded", "at": summary.started_at}
        fields |= {"consent": summary.consent}
        num_steps = 0
    if isinstance(about, EpisodeAttributes):
        fields["time_doubts"] = [one.stream for one in about.clocks if one.warnings]
    duration_s = summary.duration_s
    figures = figures_of(about, num_steps=num_steps, duration_s=duration_s)
    fields |= {"id": reader.item_id, "duration_s": duration_s, "figures": figures}
    fields["findings"] = beyond_limits(about, figures)
    return CatalogItem.model_validate(fields)


@dataclass(frozen=True)
class Source:
    """A stored item that another one was made from."""

    kind: str
    id: str
    consent: bool | None
    complete: bool
    incomplete_cause: str
    review: Review | None


def linked_episode(item: CatalogItem, sources: Sequence[Source]) -> CatalogItem:
    """An episode with what its stored sources say: consent, incompleteness, rejection."""
    recordings = [one for one in sources if one.kind == "recording"]
    parts: list[CatalogItem | Source] = [item, *recordings]
    torn = next((one for one in parts if not one.complete), item)
    review = item.review
    if review is None:
        others = [one for one in sources if one.kind == "episode"]
        reviews = (one.review for one in (*recordings, *others))
        review = next((one for one in reviews if one and one.spreads), None)
    changes = {
        "recordings": tuple(one.id for one in recordings),
        "consent": all(one.consent for one in recordings) if recordings else None,
        "review": review,
        "complete": torn.complete,
        "incomplete_cause": torn.incomplete_cause,
    }
    return item.model_copy(update=changes)


def take_of(recording: CatalogItem, aligned: CatalogItem) -> CatalogItem:
    """A recording as a take: with the last of its episodes, and what was found in that."""
    changes = {
        "aligned": aligned,
        "figures": aligned.figures,
        "time_doubts": aligned.time_doubts,
        "findings": aligned.findings,
        "review": aligned.review or recording.review,
    }
    return recording.model_copy(update=changes)


def all_findings(item: CatalogItem, spread: Spread | None) -> tuple[Finding, ...]:
    """Findings of a linked item that is compared; `item` has those that need no comparison."""
    found = [*item.findings, *outliers_of(item.figures, spread)]
    if not item.complete:
        text = f"incomplete: {item.incomplete_cause or 'no cause noted'}"
        found.insert(0, Finding(code="incomplete", message=text))
    if item.time_doubts:
        text = f"times in doubt: {', '.join(item.time_doubts)}"
        found.append(Finding(code="doubtful_clock", message=text))
    if item.recovered:
        text = "cut short: the program that wrote it ended before the take did"
        found.append(Finding(code="recovered", message=text))
    if item.success is None and item.origin == "recorded":
        found.append(Finding(code="not_judged", message="outcome not judged"))
    return tuple(found)


class HoursFilter(EpisodeFilter):
    """Filter of episodes; days begin at midnight of the zone `utc_offset_min` ahead of UTC."""

    utc_offset_min: int = Field(default=0, ge=-14 * 60, le=14 * 60)


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
_SIGNS: Final = np.array([{"high": 1, "low": -1, "both": 0}[figure.bad] for figure in FIGURES])
# Figures that are made of those of single streams or hands: their names, and how.
_COLLECTED: Final[Mapping[str, tuple[str, Callable[[Iterable[float]], float]]]] = {
    "num_gaps": (r".+_num_gaps", sum),
    "largest_gap_s": (r".+_largest_gap_s", max),
    "tip_error_mm": (r"retargeting_.+_tip_error_p95_mm", max),
    "peak_speed_m_s": (r"(.+_)?peak_speed_m_s", max),
    "jerk_p95_m_s3": (r"(.+_)?jerk_p95_m_s3", max),
    "static_share": (r"static_share", min),
}


# More than the streams and hands of all stations have.
@lru_cache(maxsize=1 << 14)
def _collected_into(key: str) -> tuple[str, ...]:
    """The figures that are made of a figure of quality."""
    return tuple(name for name, (form, _) in _COLLECTED.items() if re.fullmatch(form, key))


def figures_of(
    attributes: EpisodeAttributes | RecordingAttributes, *, num_steps: int, duration_s: float
) -> dict[str, float]:
    """The figures that an item has; `num_steps` are those of an episode."""
    quality = attributes.quality
    found = {"duration_s": duration_s}
    values: defaultdict[str, list[float]] = defaultdict(list)
    for key, value in quality.items():
        for name in _collected_into(key):
            values[name].append(value)
    found |= {name: float(_COLLECTED[name][1](some)) for name, some in values.items()}
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


def spread_of(values: Float64[np.ndarray, "items figures"]) -> Spread:
    """Median and scale of each figure: robust standard deviation, at least its resolution.

    NaN of figures that fewer than MIN_ITEMS have; items without a figure have NaN.
    """
    spread = np.full((2, values.shape[1]), np.nan)
    for column, figure in enumerate(FIGURES):
        known = values[:, column][~np.isnan(values[:, column])]
        if len(known) >= MIN_ITEMS:
            median = np.median(known)
            sigma = float(np.median(np.abs(known - median))) / MAD_OF_SIGMA
            spread[:, column] = median, max(sigma, figure.resolution)
    return spread


def outlier_scores(
    values: Float64[np.ndarray, "items figures"], spread: Spread
) -> Float64[np.ndarray, "items figures"]:
    """Absolute deviations in scales where they are findings, 0 elsewhere."""
    scores = (values - spread[0]) / spread[1]
    bad = np.where(_SIGNS == 0, np.abs(scores), _SIGNS * scores)
    return np.where(bad > MAX_SCORE, bad, 0.0)


def outliers_of(figures: Mapping[str, float], spread: Spread | None) -> list[Finding]:
    """Findings of an item of a group with this spread; none where it has too few items."""
    found: list[Finding] = []
    if spread is None:
        return found
    values = figure_row(figures)
    for column in np.flatnonzero(outlier_scores(values[None], spread)[0]):
        figure, value, median = FIGURES[column], float(values[column]), float(spread[0, column])
        one = Finding(
            code="outlier",
            message=f"{figure.label} {figure.text(value)}, usually {figure.text(median)}",
            figure=figure.name,
            value=value,
            median=median,
            score=(value - median) / float(spread[1, column]),
        )
        found.append(one)
    return found


def figure_row(figures: Mapping[str, float]) -> Float64[np.ndarray, " figures"]:
    """Figures in the order of FIGURES; NaN where an item lacks one."""
    return np.array([figures.get(figure.name, np.nan) for figure in FIGURES])


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
