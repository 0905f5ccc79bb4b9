"""What a catalog makes of its entries: items in one list, hours of episodes, and lineage.

Items are recordings, episodes, or takes, with the findings of comparisons. A take is a recording
together with the episodes that were made from it, or an episode without a stored recording.
"""

import threading
from collections import defaultdict, deque
from collections.abc import Callable, Iterable, Mapping
from dataclasses import replace
from datetime import timedelta, timezone
from typing import Any, Final, Literal

from pydantic import Field

from dextouch.episodes import EpisodeReader, RecordingReader
from dextouch.errors import NotFoundError
from dextouch.schemas import (
    CatalogHours,
    CatalogItem,
    ComparedGroup,
    EpisodeAttributes,
    EpisodeSummary,
    Finding,
    HoursByField,
    HoursOf,
    HoursRow,
    Lineage,
    LineageNode,
    RecordingSummary,
    Review,
)
from services.episode_store.filters import Entry, EpisodeFilter, ItemsKind
from services.episode_store.findings import MIN_ITEMS, beyond_limits, figures_of, find_outliers

AnyEntry = Entry[Any]
Entries = Mapping[str, AnyEntry]
Group = tuple[str, str, str, str]
_SHARED: Final = (
    "task", "instruction", "domain", "station", "operator", "success", "recovered", "trace_id",
    "complete", "incomplete_cause",
)  # fmt: skip
MAX_NODES = 200
Name = tuple[str, str]
SECONDS_AN_HOUR = 3600.0
HoursField = Literal["task", "operator", "station", "day"]


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
            found[item.id, item.kind] = (*_incomplete(item), *item.findings, *own, *_other(item))
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


def _incomplete(item: CatalogItem) -> list[Finding]:
    if item.complete:
        return []
    text = f"incomplete: {item.incomplete_cause or 'no cause noted'}"
    return [Finding(code="incomplete", message=text)]


def _other(item: CatalogItem) -> list[Finding]:
    found = []
    if item.time_doubts:
        text = f"times in doubt: {', '.join(item.time_doubts)}"
        found.append(Finding(code="doubtful_clock", message=text))
    if item.recovered:
        text = "cut short: the program that wrote it ended before the take did"
        found.append(Finding(code="recovered", message=text))
    if item.success is None and item.origin == "recorded":
        found.append(Finding(code="not_judged", message="outcome not judged"))
    return found


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
    return HoursByField(rows=tuple(_hours(value, groups[value]) for value in ordered))


def _value(field: HoursField, item: CatalogItem, utc_offset_min: int) -> str | None:
    if field != "day":
        value: str | None = getattr(item, field)
        return value
    if item.at is None:
        return None
    zone = timezone(timedelta(minutes=utc_offset_min))
    return item.at.astimezone(zone).date().isoformat()


def _hours(value: str | None, items: list[CatalogItem]) -> HoursOf:
    seconds = {"accepted": 0.0, "rejected": 0.0, "not_reviewed": 0.0}
    for item in items:
        seconds[item.review.verdict if item.review else "not_reviewed"] += item.duration_s
    return HoursOf(
        value=value,
        num_episodes=len(items),
        **{f"{name}_h": total_s / SECONDS_AN_HOUR for name, total_s in seconds.items()},
    )


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
                "summary": _brief(entries[name].item) if name in entries else "",
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


def _brief(item: CatalogItem) -> str:
    return f"{item.task}, {item.domain}, {item.origin}, {item.duration_s:.1f} s"
