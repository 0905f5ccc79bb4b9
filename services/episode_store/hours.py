"""Hours of episodes by task, domain and origin, or by the values of one field and by reviews."""

from collections import defaultdict
from collections.abc import Iterable
from datetime import timedelta, timezone
from typing import Literal

from pydantic import Field

from dextouch.schemas import (
    CatalogHours,
    CatalogItem,
    EpisodeSummary,
    HoursByField,
    HoursOf,
    HoursRow,
)
from services.episode_store.filters import Entry, EpisodeFilter

SECONDS_AN_HOUR = 3600.0
HoursField = Literal["task", "operator", "station", "day"]


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
