"""What a catalog makes of its entries: items in one list, their findings, hours, and lineage.

Items are recordings, episodes, or takes. A take is a recording together with the episodes that were
made from it, or an episode without a stored recording.

Findings are figures beyond limits, and outliers among items of the same task. The limits are those
of live health for the same faults: they need no other items to compare with, so they hold from the
first take of a task on. Outliers have robust z-scores of figures, 0.6745 (x − median) / MAD, above
3.5 (Iglewicz and Hoaglin, How to Detect and Handle Outliers, 1993).
"""

import re
import threading
from collections import defaultdict, deque
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from datetime import timedelta, timezone
from functools import lru_cache
from typing import Any, Final, Literal

import numpy as np
from jaxtyping import Float64
from pydantic import Field

from dextouch.episodes import EpisodeReader, RecordingReader
from dextouch.errors import NotFoundError
from dextouch.schemas import (
    CatalogHours,
    CatalogItem,
    ClockReport,
    ComparedGroup,
    EpisodeAttributes,
    EpisodeSummary,
    Finding,
    HoursByField,
    HoursOf,
    HoursRow,
    Lineage,
    LineageNode,
    RecordingAttributes,
    RecordingSummary,
    Review,
)
from dextouch.streams import LEAST_SHARE_KEPT, residual_limits_s
from services.episode_store.filters import Entry, EpisodeFilter, ItemsKind

AnyEntry = Entry[Any]
Entries = Mapping[str, AnyEntry]
Group = tuple[str, str, str, str]
_SHARED: Final = (
    "task", "instruction", "domain", "station", "operator", "success", "recovered", "trace_id",
    "complete", "incomplete_cause",
)  # fmt: skip
MAX_NODES = 200
# Kind and id of an item.
Name = tuple[str, str]
SECONDS_AN_HOUR = 3600.0
HoursField = Literal["task", "operator", "station", "day"]
# MAD of a normal distribution with standard deviation 1 (Iglewicz and Hoaglin, section 3.3).
MAD_OF_SIGMA: Final = 0.6745
MAX_SCORE: Final = 3.5
# Median and MAD of fewer values say little about what is usual.
MIN_ITEMS: Final = 8


def item_of(
    reader: EpisodeReader | RecordingReader,
    summary: EpisodeSummary | RecordingSummary,
    review: Review | None,
) -> CatalogItem:
    """The row of an item on its own."""
    about = reader.attributes
    fields: dict[str, Any] = {name: getattr(about, name) for name in _SHARED}
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
    return CatalogItem.model_validate(fields | {"review": review})


class ItemLists:
    """The lists of a catalog's items, made anew when its entries have changed."""

    def __init__(self) -> None:
        self._guard = threading.Lock()
        self._made_of: tuple[Entries, Entries] = ({}, {})
        self._lists: dict[ItemsKind, dict[str, AnyEntry]] = {}
        self._groups: tuple[ComparedGroup, ...] = ()

    def entries(self, kind: ItemsKind, recordings: Entries, episodes: Entries) -> Entries:
        """Entries of a list by `ID/KIND`, made from the catalog's own ones by id."""
        with self._guard:
            self._update(recordings, episodes)
            return self._lists[kind]

    def groups(self, recordings: Entries, episodes: Entries) -> tuple[ComparedGroup, ...]:
        """The groups of items that are compared with each other."""
        with self._guard:
            self._update(recordings, episodes)
            return self._groups

    def _update(self, recordings: Entries, episodes: Entries) -> None:
        known = self._made_of
        if self._lists and known[0] is recordings and known[1] is episodes:
            return
        ours = dict(recordings)
        made: defaultdict[str, list[str]] = defaultdict(list)
        theirs = {}
        for name, entry in episodes.items():
            theirs[name] = linked = _linked_episode(entry, recordings, episodes)
            for source in linked.item.recordings if linked.item.origin != "imagined" else ():
                made[source].append(name)
        for name, products in made.items():
            ours[name] = _with(ours[name], episodes=tuple(products))
        compared = [*theirs.values(), *(one for one in ours.values() if not one.item.episodes)]
        found, self._groups = _compare(compared)
        theirs = {name: _with(one, findings=found[name, "episode"]) for name, one in theirs.items()}
        ours = {
            name: _with(one, findings=found.get((name, "recording"), ()))
            for name, one in ours.items()
        }
        takes = {f"{name}/recording": _take(one, theirs) for name, one in ours.items()}
        takes |= {
            f"{name}/episode": one
            for name, one in theirs.items()
            if one.item.origin == "imagined" or not one.item.recordings
        }
        self._lists = {
            "recording": {f"{name}/recording": one for name, one in ours.items()},
            "episode": {f"{name}/episode": one for name, one in theirs.items()},
            "take": takes,
        }
        self._made_of = (recordings, episodes)


def _with(entry: AnyEntry, **changes: object) -> AnyEntry:
    return replace(entry, item=entry.item.model_copy(update=changes))


def _linked_episode(entry: AnyEntry, recordings: Entries, episodes: Entries) -> AnyEntry:
    """An episode with what its stored sources say: consent, incompleteness, rejection."""
    names = [one.id for one in entry.lineage if one.kind == "recording" and one.id in recordings]
    sources = [recordings[name].item for name in names]
    torn = next((one for one in (entry.item, *sources) if not one.complete), entry.item)
    review = entry.item.review
    if review is None:
        sources += [
            episodes[one.id].item
            for one in entry.lineage
            if one.kind == "episode" and one.id in episodes
        ]
        reviews = (one.review for one in sources)
        review = next((one for one in reviews if one and one.verdict == "rejected"), None)
    consent = all(recordings[name].item.consent for name in names) if names else None
    return _with(
        entry,
        recordings=tuple(names),
        consent=consent,
        review=review,
        complete=torn.complete,
        incomplete_cause=torn.incomplete_cause,
    )


def _take(recording: AnyEntry, episodes: Entries) -> AnyEntry:
    """A recording as a take: with the last of its episodes, and what was found in that."""
    item = recording.item
    if not item.episodes:
        return recording
    aligned = episodes[item.episodes[-1]]
    take = _with(
        recording,
        aligned=aligned.item,
        figures=aligned.item.figures,
        time_doubts=aligned.item.time_doubts,
        findings=aligned.item.findings,
        review=aligned.item.review or item.review,
    )
    quality = {**recording.quality, **aligned.quality}
    return replace(take, quality=quality, text=f"{recording.text}\n{aligned.text}")


def _compare(
    entries: list[AnyEntry],
) -> tuple[dict[tuple[str, str], tuple[Finding, ...]], tuple[ComparedGroup, ...]]:
    """Findings by id and kind, and the groups that were compared; rejected items are left out.

    Items come with the findings that need no comparison.
    """
    groups: defaultdict[Group, list[CatalogItem]] = defaultdict(list)
    found: dict[tuple[str, str], tuple[Finding, ...]] = {}
    for entry in entries:
        item = entry.item
        if item.review is not None and item.review.verdict == "rejected":
            found[item.id, item.kind] = ()
        else:
            groups[item.task, item.domain, item.origin, item.kind].append(item)
    rows = []
    for (task, *_), items in sorted(groups.items()):
        outliers = find_outliers([item.figures for item in items])
        for item, own in zip(items, outliers, strict=True):
            found[item.id, item.kind] = _all_findings(item, own)
        row = ComparedGroup(
            kind=items[0].kind,
            task=task,
            domain=items[0].domain,
            origin=items[0].origin,
            num_items=len(items),
            min_items=MIN_ITEMS,
            is_compared=len(items) >= MIN_ITEMS,
        )
        rows.append(row)
    return found, tuple(rows)


def _all_findings(item: CatalogItem, outliers: list[Finding]) -> tuple[Finding, ...]:
    found = [*item.findings, *outliers]
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


def hours_of(entries: Iterable[Entry[EpisodeSummary]]) -> CatalogHours:
    """Total duration of episodes by task, domain and origin."""
    groups: defaultdict[tuple[str, str, str], list[EpisodeSummary]] = defaultdict(list)
    for episode in (entry.summary for entry in entries):
        groups[episode.task, episode.domain, episode.origin].append(episode)
    rows = [
        HoursRow(
            task=task,
            domain=group[0].domain,
            origin=group[0].origin,
            num_episodes=len(group),
            num_successes=sum(episode.success is True for episode in group),
            hours=sum(episode.duration_s for episode in group) / SECONDS_AN_HOUR,
        )
        for (task, *_), group in sorted(groups.items())
    ]
    return CatalogHours(
        rows=tuple(rows),
        num_episodes=sum(row.num_episodes for row in rows),
        hours=sum(row.hours for row in rows),
    )


def hours_by(
    field: HoursField, episodes: Iterable[CatalogItem], *, utc_offset_min: int
) -> HoursByField:
    """Total duration of episodes by the values of a field, in their order, and by their reviews."""
    groups: defaultdict[str | None, list[CatalogItem]] = defaultdict(list)
    for item in episodes:
        groups[_value(field, item, utc_offset_min)].append(item)
    ordered = sorted(groups, key=lambda value: (value is None, value or ""))
    rows = []
    for value in ordered:
        seconds = {"accepted": 0.0, "rejected": 0.0, "not_reviewed": 0.0}
        for item in groups[value]:
            seconds[item.review.verdict if item.review else "not_reviewed"] += item.duration_s
        hours = {f"{name}_h": total_s / SECONDS_AN_HOUR for name, total_s in seconds.items()}
        rows.append(HoursOf(value=value, num_episodes=len(groups[value]), **hours))
    return HoursByField(rows=tuple(rows))


def _value(field: HoursField, item: CatalogItem, utc_offset_min: int) -> str | None:
    if field != "day":
        value: str | None = getattr(item, field)
        return value
    if item.at is None:
        return None
    zone = timezone(timedelta(minutes=utc_offset_min))
    return item.at.astimezone(zone).date().isoformat()


def lineage_of(entries: Mapping[Name, AnyEntry], start: Name) -> Lineage:
    """Everything that an item was made from and that was made from it, nearest first.

    Raises:
        NotFoundError: no such item.
    """
    kind, item_id = start
    if start not in entries:
        raise NotFoundError(f"{kind} {item_id!r}: not in the catalog")
    sources = {
        name: tuple((one.kind, one.id) for one in entry.lineage) for name, entry in entries.items()
    }
    products: defaultdict[Name, list[Name]] = defaultdict(list)
    for name, above in sources.items():
        for one in above:
            products[one].append(name)
    nodes = {start: "self"}
    _walk(nodes, start, lambda name: sources.get(name, ()), "source")
    _walk(nodes, start, lambda name: products[name], "product")
    rows = [
        LineageNode.model_validate(
            {
                "kind": name[0],
                "id": name[1],
                "relation": relation,
                "is_stored": name in entries,
                "made_from": [one for _, one in sources.get(name, ())],
                "summary": _summary(entries[name].item) if name in entries else "",
            }
        )
        for name, relation in nodes.items()
    ]
    return Lineage(nodes=tuple(rows))


def _walk(
    nodes: dict[Name, str], start: Name, neighbours: Callable[[Name], Iterable[Name]], relation: str
) -> None:
    """Add everything that can be reached from an item, breadth first, until MAX_NODES."""
    waiting = deque([start])
    while waiting and len(nodes) < MAX_NODES:
        for name in neighbours(waiting.popleft()):
            if name not in nodes and len(nodes) < MAX_NODES:
                nodes[name] = relation
                waiting.append(name)


def _summary(item: CatalogItem) -> str:
    return f"{item.task}, {item.domain}, {item.origin}, {item.duration_s:.1f} s"


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
        median = float(np.median(values))
        scores = robust_scores(values, resolution=figure.resolution)
        for place, value, score in zip(owners, values.tolist(), scores.tolist(), strict=True):
            if {"both": abs(score), "high": score, "low": -score}[figure.bad] <= MAX_SCORE:
                continue
            one = Finding(
                code="outlier",
                message=f"{figure.label} {figure.text(value)}, usually {figure.text(median)}",
                figure=figure.name,
                value=value,
                median=median,
                score=score,
            )
            found[place].append(one)
    return found


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
