"""Catalog of a store: filtered lists of episodes and recordings from cached summaries."""

import os
import re
import threading
import time
from bisect import bisect_left, bisect_right
from collections import defaultdict
from collections.abc import Callable, Mapping
from dataclasses import replace
from datetime import datetime
from functools import partial
from typing import Any, Generic

import structlog

from dextouch.episodes import (
    COMMIT_FILE,
    EpisodeReader,
    EpisodeStore,
    Kind,
    RecordingReader,
    disk_errors,
    has_object_poses,
)
from dextouch.errors import NotFoundError, StorageError
from dextouch.schemas import (
    ID_PATTERN,
    CatalogHours,
    CatalogItems,
    CatalogValues,
    ComparedGroups,
    EpisodeAttributes,
    EpisodeClicks,
    EpisodeList,
    EpisodeSummary,
    HoursByField,
    Lineage,
    RecordingList,
    RecordingSummary,
    Review,
    StoredItem,
)
from services.episode_store.filters import (
    CatalogFilter,
    Entry,
    EpisodeFilter,
    ItemFilter,
    ItemsKind,
    Page,
    S,
    cursor_of,
    place_of,
    sort_key,
)
from services.episode_store.items import (
    HoursField,
    HoursFilter,
    ItemLists,
    hours_by,
    hours_of,
    item_of,
    lineage_of,
)

logger = structlog.get_logger(__name__)

# Stamps of a file system can be this coarse: another change may get the same stamp.
SETTLED_NS = 2_000_000_000
# Listing a bucket takes one request per 1000 objects.
BUCKET_PERIOD_NS = 5_000_000_000
# Stamp and inode of a commit record.
Revision = tuple[int, int]
NO_REVISION = (-1, -1)
FIRST_PAGE = Page()
# Limit of the values of a field in one response.
MAX_VALUES = 500


class _Shelf(Generic[S]):
    """Entries of one kind sorted by id; a single `stat` while nothing changes.

    Commits and deletions rename folders, which updates the parent folder's stamp. In-place changes
    by other programs are noticed only at the next commit or deletion. A bucket is listed at most
    once per BUCKET_PERIOD_NS, by ids only: an id that is deleted and written again in between goes
    unnoticed.
    """

    def __init__(
        self, store: EpisodeStore, kind: Kind, summarize: Callable[[str], Entry[S]]
    ) -> None:
        self._store = store
        self._summarize: Callable[[str], Entry[S]] = summarize
        self._kind: Kind = kind
        self._folder = store.root / f"{kind}s"
        self._listed_ns: int | None = None
        self._stamp_ns: int | None = None
        self._is_settled = False
        self._known: dict[str, tuple[Revision, Entry[S] | None]] = {}
        self._entries: dict[str, Entry[S]] = {}
        self._guard = threading.Lock()

    def __len__(self) -> int:
        """Entries at the last look, without another one."""
        return len(self._entries)

    def entries(self) -> dict[str, Entry[S]]:
        """Current entries by id; the returned dictionary is never modified."""
        with self._guard:
            found = self._look()
            known = None if found is None else {k: self._read(k, now) for k, now in found.items()}
            # The same dictionary while nothing changed: lists that are made of it stay valid.
            if known is not None and known != self._known:
                self._known = known
                rows = ((name, entry) for name, (_, entry) in known.items())
                self._entries = {name: entry for name, entry in rows if entry is not None}
            return self._entries

    def forget(self, item_id: str) -> None:
        """Read an item again at the next look, after a change of what is beside its content."""
        with self._guard:
            self._known.pop(item_id, None)
            self._is_settled, self._listed_ns = False, None

    def _read(self, item_id: str, revision: Revision) -> tuple[Revision, Entry[S] | None]:
        before = self._known.get(item_id)
        if before is not None and before[0] == revision:
            return before
        try:
            return revision, self._summarize(item_id)
        except NotFoundError:
            # Deleted while we were listing; one that comes back is read again.
            return NO_REVISION, None
        except StorageError as error:
            logger.warning(
                "omitted_from_catalog", kind=self._kind, id=item_id, reason=error.message
            )
            return revision, None

    def _look(self) -> dict[str, Revision] | None:
        """Revisions by sorted id; None if nothing changed since the last call."""
        with disk_errors(f"list {self._folder.name}"):
            try:
                stamp_ns = self._folder.stat().st_mtime_ns
            except FileNotFoundError:
                self._stamp_ns = None
                return self._list()
            if self._is_settled and stamp_ns == self._stamp_ns:
                return None
            now_ns = time.time_ns()
            found = self._scan()
        self._stamp_ns, self._is_settled = stamp_ns, now_ns - stamp_ns > SETTLED_NS
        return found

    def _list(self) -> dict[str, Revision] | None:
        # Listing an empty folder is free; a bucket is not listed again at once.
        now_ns = time.monotonic_ns()
        if self._listed_ns is not None and now_ns - self._listed_ns < BUCKET_PERIOD_NS:
            return None
        found = dict.fromkeys(self._store.list(kind=self._kind), (0, 0))
        self._listed_ns = now_ns if found else None
        return found

    def _scan(self) -> dict[str, Revision]:
        found = {}
        # Plain names and one stat per id: thousands of Path objects would slow down a listing.
        for name in sorted(os.listdir(self._folder)):  # noqa: PTH208
            try:
                state = os.stat(f"{self._folder}/{name}/{COMMIT_FILE}")  # noqa: PTH116
            except (FileNotFoundError, NotADirectoryError):
                continue
            except PermissionError:
                # Reading it reports the error; a name that is not an id is not an episode.
                if re.fullmatch(ID_PATTERN, name):
                    found[name] = (0, 0)
                continue
            found[name] = (state.st_mtime_ns, state.st_ino)
        return found


class Catalog:
    """Summaries of all groups of a store, cached since committed groups are immutable.

    A damaged episode is omitted and logged once; `verify` reports the damage.
    """

    def __init__(self, store: EpisodeStore) -> None:
        self._store = store
        self._episodes = _Shelf(store, "episode", self._episode)
        self._recordings = _Shelf(store, "recording", self._recording)
        self._items = ItemLists()

    def warm_up(self) -> None:
        """Read the summaries in advance."""
        self._episodes.entries()
        self._recordings.entries()

    def num_items(self) -> dict[str, Callable[[], int]]:
        """Functions that say how many items of a kind were there when they were last listed."""
        return {
            "recording": partial(len, self._recordings),
            "episode": partial(len, self._episodes),
        }

    def episodes(self, query: EpisodeFilter, *, limit: int, page: Page = FIRST_PAGE) -> EpisodeList:
        """One page of matching episodes in the order of the page."""
        rows, facts = _page(self._episodes.entries(), query, limit, page)
        summaries = tuple(row.summary for row in rows)
        return EpisodeList.model_construct(episodes=summaries, **facts)

    def recordings(
        self, query: CatalogFilter | None = None, *, limit: int, page: Page = FIRST_PAGE
    ) -> RecordingList:
        """One page of matching finished recordings in the order of the page."""
        query = query or CatalogFilter()
        rows, facts = _page(self._recordings.entries(), query, limit, page)
        summaries = tuple(row.summary for row in rows)
        return RecordingList.model_construct(recordings=summaries, **facts)

    def values(self) -> CatalogValues:
        """Tasks, operators and stations that occur, at most MAX_VALUES of each."""
        rows: list[Entry[Any]] = [
            *self._recordings.entries().values(),
            *self._episodes.entries().values(),
        ]
        found: dict[str, tuple[str, ...]] = {}
        for name in ("task", "operator", "station"):
            values = {getattr(row.summary, name) for row in rows} - {None}
            found[f"{name}s"] = tuple(sorted(values)[:MAX_VALUES])
        return CatalogValues(**found)

    def lineage(self, kind: Kind, item_id: str) -> Lineage:
        """Everything that an item was made from and that was made from it; as `lineage_of`."""
        shelves: dict[Kind, _Shelf[Any]]
        shelves = {"recording": self._recordings, "episode": self._episodes}
        entries: dict[tuple[str, str], Entry[Any]] = {
            (each, name): entry
            for each in shelves
            for name, entry in shelves[each].entries().items()
        }
        return lineage_of(entries, (kind, item_id))

    def items(self, query: ItemFilter, *, limit: int, page: Page = FIRST_PAGE) -> CatalogItems:
        """One page of matching recordings, episodes or takes in the order of the page."""
        rows, facts = _page(self._listed(query.kind), query, limit, page)
        return CatalogItems.model_construct(items=tuple(row.item for row in rows), **facts)

    def groups(self) -> ComparedGroups:
        """The groups of items that are compared with each other to find outliers."""
        groups = self._items.groups(self._recordings.entries(), self._episodes.entries())
        return ComparedGroups(groups=groups)

    def review(self, item: StoredItem, review: Review | None) -> None:
        """Keep the review of an item; None removes it.

        Raises:
            NotFoundError: no such item.
        """
        self._store.set_review(item.id, review, kind=item.kind)
        self.forget(item)

    def forget(self, item: StoredItem) -> None:
        """Read an item again, after a change of what is beside its content."""
        (self._episodes if item.kind == "episode" else self._recordings).forget(item.id)

    def clickable(self) -> dict[str, Entry[Any]]:
        """Episodes by id that training would take if their objects were clicked."""
        return {
            one.item.id: one
            for one in self._listed("episode").values()
            if one.is_clickable and not (one.item.review and one.item.review.verdict == "rejected")
        }

    def set_clicks(self, episode_id: str, clicks: EpisodeClicks | None) -> None:
        """Keep the clicks on the objects of an episode; raises as `review`."""
        self._store.set_clicks(episode_id, clicks)
        self._episodes.forget(episode_id)

    def hours(self, query: EpisodeFilter) -> CatalogHours:
        """Total duration of matching episodes by task, domain and origin."""
        return hours_of(_matching(self._episodes.entries(), query).values())

    def hours_by(self, field: HoursField, query: HoursFilter) -> HoursByField:
        """Total duration of matching episodes by the values of a field, and by their reviews."""
        items = [one.item for one in _matching(self._listed("episode"), query).values()]
        return hours_by(field, items, utc_offset_min=query.utc_offset_min)

    def _listed(self, kind: ItemsKind) -> Mapping[str, Entry[Any]]:
        return self._items.entries(kind, self._recordings.entries(), self._episodes.entries())

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
            lineage=attributes.lineage,
            created_at=attributes.created_at,
            **_shared_fields(reader),
        )
        entry = self._entry(reader, summary, attributes.created_at)
        is_judged = attributes.success is not None and not attributes.recovered
        if attributes.origin != "recorded" or not is_judged or has_object_poses(reader):
            return entry
        is_clickable = num_steps > 0 and "camera_head" in reader.streams
        return replace(entry, is_clickable=is_clickable, clicks=self._store.clicks(episode_id))

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
        return self._entry(reader, summary, attributes.started_at)

    def _entry(
        self, reader: EpisodeReader | RecordingReader, summary: S, at: datetime | None
    ) -> Entry[S]:
        about, item_id = reader.attributes, reader.item_id
        kind: Kind = "episode" if isinstance(about, EpisodeAttributes) else "recording"
        item = item_of(reader, summary, self._store.review(item_id, kind=kind))
        parts = (
            item_id,
            about.task,
            about.instruction,
            about.operator,
            about.station,
            about.trace_id,
        )
        text = "\n".join(part or "" for part in parts)
        return Entry(summary, item, dict(about.quality), at, about.lineage, text.casefold())


def _shared_fields(reader: EpisodeReader | RecordingReader) -> dict[str, Any]:
    """The fields that the summaries of both kinds have under one name."""
    names = ("task", "domain", "station", "operator", "success", "recovered")
    fields = {name: getattr(reader.attributes, name) for name in names}
    return fields | {"content_sha256": reader.content_sha256}


def _matching(entries: Mapping[str, Entry[S]], query: CatalogFilter) -> dict[str, Entry[S]]:
    matches = query.matcher()
    return {name: entry for name, entry in entries.items() if matches(entry)}


def _page(
    entries: Mapping[str, Entry[S]], query: CatalogFilter, limit: int, page: Page
) -> tuple[list[Entry[S]], dict[str, Any]]:
    """The rows of a page, and the number of all that match with the cursor to go on after."""
    found = _matching(entries, query)
    places = sorted((sort_key(row.item, page.sort), name) for name, row in found.items())
    first = page.offset
    if page.after is not None:
        after = place_of(page.after)
        left, right = bisect_left(places, after), bisect_right(places, after)
        first += len(places) - left if page.descending else right
    if page.descending:
        places.reverse()
    chosen = places[first : first + limit]
    next_after = None if first + limit >= len(places) else cursor_of(chosen[-1])
    facts = {"num_matching": len(found), "next_after": next_after}
    return [found[name] for _, name in chosen], facts


def _nominal_duration_s(reader: EpisodeReader | RecordingReader) -> float:
    # Counts come from the commit record, so no array is opened.
    rates_hz = {name: stream.nominal_rate_hz for name, stream in reader.streams.items()}
    return max((reader.num_samples(name) / rates_hz[name] for name in rates_hz), default=0.0)
