"""Catalog of a store: filtered lists of episodes and recordings from cached summaries."""

import threading
from bisect import bisect_right
from collections import defaultdict
from collections.abc import Callable, Mapping
from typing import Any, Generic

import structlog

from dextouch.episodes import EpisodeReader, EpisodeStore, Kind, RecordingReader
from dextouch.errors import NotFoundError, StorageError
from dextouch.schemas import (
    CatalogHours,
    EpisodeList,
    EpisodeSummary,
    HoursRow,
    RecordingList,
    RecordingSummary,
)
from services.episode_store.changes import FolderChanges, Revision
from services.episode_store.filters import CatalogFilter, Entry, EpisodeFilter, S

__all__ = ["Catalog", "CatalogFilter", "EpisodeFilter"]

logger = structlog.get_logger(__name__)

SECONDS_AN_HOUR = 3600.0


class _Shelf(Generic[S]):
    """Entries of one kind sorted by id, refreshed by `entries`."""

    def __init__(
        self, store: EpisodeStore, kind: Kind, summarize: Callable[[str], Entry[S]]
    ) -> None:
        self._kind: Kind = kind
        self._summarize: Callable[[str], Entry[S]] = summarize
        self._changes = FolderChanges(store, kind)
        self._known: dict[str, tuple[Revision, Entry[S] | None]] = {}
        self._entries: dict[str, Entry[S]] = {}
        self._guard = threading.Lock()

    def entries(self) -> dict[str, Entry[S]]:
        """Current entries by id; the returned dictionary is never modified."""
        with self._guard:
            found = self._changes.look()
            if found is not None:
                self._refresh(found)
            return self._entries

    def _refresh(self, found: Mapping[str, Revision]) -> None:
        known = {}
        for item_id, revision in found.items():
            before = self._known.get(item_id)
            if before is not None and before[0] == revision:
                known[item_id] = before
                continue
            try:
                known[item_id] = (revision, self._summarize(item_id))
            except NotFoundError:
                continue  # deleted while we were listing
            except StorageError as error:
                logger.warning(
                    "omitted_from_catalog", kind=self._kind, id=item_id, reason=error.message
                )
                known[item_id] = (revision, None)
        self._known = known
        self._entries = {name: entry for name, (_, entry) in known.items() if entry is not None}


class Catalog:
    """Summaries of all groups of a store, cached since committed groups are immutable.

    A damaged episode is omitted and logged once; `verify` reports the damage.
    """

    def __init__(self, store: EpisodeStore) -> None:
        self._store = store
        self._episodes = _Shelf(store, "episode", self._episode)
        self._recordings = _Shelf(store, "recording", self._recording)

    def warm_up(self) -> None:
        """Read the summaries in advance."""
        self._episodes.entries()
        self._recordings.entries()

    def episodes(
        self, wanted: EpisodeFilter, *, limit: int, offset: int = 0, after: str | None = None
    ) -> EpisodeList:
        """One page of matching episodes, sorted by id, after the id `after`."""
        found = _matching(self._episodes.entries(), wanted)
        page, next_after = _page(found, limit, offset, after)
        return EpisodeList.model_construct(
            episodes=tuple(page), num_matching=len(found), next_after=next_after
        )

    def recordings(
        self,
        wanted: CatalogFilter | None = None,
        *,
        limit: int,
        offset: int = 0,
        after: str | None = None,
    ) -> RecordingList:
        """One page of matching finished recordings, sorted by id, after the id `after`."""
        found = _matching(self._recordings.entries(), wanted or CatalogFilter())
        page, next_after = _page(found, limit, offset, after)
        return RecordingList.model_construct(
            recordings=tuple(page), num_matching=len(found), next_after=next_after
        )

    def hours(self, wanted: EpisodeFilter) -> CatalogHours:
        """Total duration of matching episodes by task, domain and origin."""
        groups: defaultdict[tuple[str, str, str], list[EpisodeSummary]] = defaultdict(list)
        for episode in _matching(self._episodes.entries(), wanted).values():
            groups[episode.task, episode.domain, episode.origin].append(episode)
        rows = [_hours_row(group) for _, group in sorted(groups.items())]
        return CatalogHours(
            rows=tuple(rows),
            num_episodes=sum(row.num_episodes for row in rows),
            hours=sum(row.hours for row in rows),
        )

    def bytes_by_station(self) -> dict[str, int]:
        """Disk usage of finished recordings by station."""
        totals: defaultdict[str, int] = defaultdict(int)
        for entry in self._recordings.entries().values():
            totals[entry.summary.station] += entry.summary.num_bytes
        return dict(totals)

    def _episode(self, episode_id: str) -> Entry[EpisodeSummary]:
        reader = self._store.open(episode_id)
        attributes, num_steps = reader.attributes, reader.num_steps
        on_grid_s = num_steps / attributes.model_rate_hz
        summary = EpisodeSummary(
            episode_id=episode_id,
            origin=attributes.origin,
            num_steps=num_steps,
            duration_s=on_grid_s or _nominal_duration_s(reader),
            created_at=attributes.created_at,
            **_shared_fields(reader),
        )
        return Entry(summary, dict(attributes.quality), attributes.created_at)

    def _recording(self, recording_id: str) -> Entry[RecordingSummary]:
        reader = self._store.recording(recording_id)
        attributes = reader.attributes
        summary = RecordingSummary(
            recording_id=recording_id,
            consent=attributes.consent,
            num_samples={name: reader.num_samples(name) for name in reader.streams},
            duration_s=_nominal_duration_s(reader),
            num_bytes=self._store.num_bytes(recording_id, kind="recording"),
            started_at=attributes.started_at,
            **_shared_fields(reader),
        )
        return Entry(summary, dict(attributes.quality), attributes.started_at)


def _shared_fields(reader: EpisodeReader | RecordingReader) -> dict[str, Any]:
    """The fields that the summaries of both kinds have under one name."""
    names = ("task", "domain", "station", "operator", "success", "recovered")
    fields = {name: getattr(reader.attributes, name) for name in names}
    return fields | {"content_sha256": reader.content_sha256}


def _matching(entries: Mapping[str, Entry[S]], wanted: CatalogFilter) -> dict[str, S]:
    matches = wanted.matcher()
    return {name: entry.summary for name, entry in entries.items() if matches(entry)}


def _page(
    found: Mapping[str, S], limit: int, offset: int, after: str | None
) -> tuple[list[S], str | None]:
    names = list(found)
    first = offset + (0 if after is None else bisect_right(names, after))
    chosen = names[first : first + limit]
    is_last = first + limit >= len(names)
    return [found[name] for name in chosen], None if is_last else chosen[-1]


def _hours_row(group: list[EpisodeSummary]) -> HoursRow:
    return HoursRow(
        task=group[0].task,
        domain=group[0].domain,
        origin=group[0].origin,
        num_episodes=len(group),
        num_successes=sum(episode.success is True for episode in group),
        hours=sum(episode.duration_s for episode in group) / SECONDS_AN_HOUR,
    )


def _nominal_duration_s(reader: EpisodeReader | RecordingReader) -> float:
    # Counts come from the commit record, so no array is opened.
    return max(
        (
            reader.num_samples(name) / descriptor.nominal_rate_hz
            for name, descriptor in reader.streams.items()
        ),
        default=0.0,
    )
