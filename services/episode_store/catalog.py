"""Catalog of a store: filtered lists of episodes and recordings from cached summaries."""

import math
import os
import re
import threading
import time
from bisect import bisect_right
from collections import defaultdict
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from datetime import datetime
from operator import attrgetter
from typing import Annotated, Any, Generic, TypeVar

import structlog
from pydantic import AfterValidator, AwareDatetime, Field

from dextouch.episodes import (
    COMMIT_FILE,
    EpisodeReader,
    EpisodeStore,
    Kind,
    RecordingReader,
    disk_errors,
)
from dextouch.errors import LimitExceededError, NotFoundError, StorageError
from dextouch.frozen_model import FrozenModel
from dextouch.schemas import (
    ID_PATTERN,
    CatalogHours,
    Domain,
    EpisodeList,
    EpisodeSummary,
    HoursRow,
    Origin,
    RecordingList,
    RecordingSummary,
)

logger = structlog.get_logger(__name__)

SECONDS_AN_HOUR = 3600.0
# Stamps of a file system can be this coarse: another change may get the same stamp.
SETTLED_NS = 2_000_000_000
# Listing a bucket takes one request per 1000 objects.
BUCKET_PERIOD_NS = 5_000_000_000
# Stamp and inode of a commit record.
Revision = tuple[int, int]
NO_REVISION = (-1, -1)
S = TypeVar("S", EpisodeSummary, RecordingSummary)
_COMPARED = ("task", "operator", "station", "domain", "success", "recovered", "origin")


@dataclass(frozen=True, slots=True)
class Entry(Generic[S]):
    """A row of the catalog, with further properties to filter by."""

    summary: S
    quality: Mapping[str, float]
    created_at: datetime | None


def quality_bound(text: str) -> tuple[str, float]:
    """Parse `NAME:NUMBER` to a figure's name and lower bound.

    Raises:
        ValueError: anything else, and NaN.
    """
    name, colon, figure = text.rpartition(":")
    try:
        least = float(figure)
    except ValueError:
        least = math.nan
    if not (name and colon) or math.isnan(least):
        raise ValueError(f"got {text!r}, expected NAME:NUMBER such as coverage:0.95")
    return name, least


class CatalogFilter(FrozenModel):
    """Filter of episodes or recordings; omitted fields match anything.

    `min_quality` are bounds `NAME:NUMBER` that must all hold; an item without the figure does not
    match. Times are created_after ≤ t < created_before; an item without a time does not match.
    """

    task: str | None = None
    operator: str | None = None
    station: str | None = None
    domain: Domain | None = None
    success: bool | None = None
    recovered: bool | None = None
    min_quality: tuple[
        Annotated[str, AfterValidator(lambda text: quality_bound(text) and text)], ...
    ] = ()
    created_after: AwareDatetime | None = None
    created_before: AwareDatetime | None = None

    def matcher(self) -> Callable[[Entry[S]], bool]:
        """Compile the filter to a fast predicate."""
        fields = [name for name in _COMPARED if getattr(self, name, None) is not None]
        get = attrgetter(*fields) if fields else None
        expected = get(self) if get else None
        bounds = [quality_bound(text) for text in self.min_quality]
        after, before = self.created_after, self.created_before

        def matches(entry: Entry[S]) -> bool:
            if get is not None and get(entry.summary) != expected:
                return False
            if any(not entry.quality.get(name, -math.inf) >= least for name, least in bounds):
                return False
            if after is None and before is None:
                return True
            at = entry.created_at
            return (
                at is not None
                and (after is None or after <= at)
                and (before is None or at < before)
            )

        return matches


class EpisodeFilter(CatalogFilter):
    """Filter of episodes."""

    origin: Origin | None = None


class Page(FrozenModel):
    """Page of a list: after an id, or from an offset."""

    limit: int | None = Field(default=None, ge=1)
    offset: int = Field(default=0, ge=0)
    after: str | None = Field(default=None, description="only ids after this one")

    def num_rows(self, max_page: int) -> int:
        """Number of rows of the page; the maximum by default.

        Raises:
            LimitExceededError: above the maximum.
        """
        if self.limit is not None and self.limit > max_page:
            raise LimitExceededError(
                f"limit: got {self.limit}, expected at most {max_page}; "
                "ask for the next page with after=NEXT_AFTER",
                got=self.limit,
                expected=max_page,
            )
        return self.limit or max_page


class EpisodeQuery(EpisodeFilter, Page):
    """Filter and page of episodes."""


class RecordingQuery(CatalogFilter, Page):
    """Filter and page of recordings."""


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
        self._kind: Kind = kind
        self._summarize: Callable[[str], Entry[S]] = summarize
        self._folder = store.root / f"{kind}s"
        self._listed_ns: int | None = None
        self._stamp_ns: int | None = None
        self._is_settled = False
        self._known: dict[str, tuple[Revision, Entry[S] | None]] = {}
        self._entries: dict[str, Entry[S]] = {}
        self._guard = threading.Lock()

    def entries(self) -> dict[str, Entry[S]]:
        """Current entries by id; the returned dictionary is never modified."""
        with self._guard:
            found = self._look()
            if found is not None:
                self._known = {name: self._read(name, now) for name, now in found.items()}
                known = ((name, entry) for name, (_, entry) in self._known.items())
                self._entries = {name: entry for name, entry in known if entry is not None}
            return self._entries

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

    def warm_up(self) -> None:
        """Read the summaries in advance."""
        self._episodes.entries()
        self._recordings.entries()

    def episodes(
        self, wanted: EpisodeFilter, *, limit: int, offset: int = 0, after: str | None = None
    ) -> EpisodeList:
        """One page of matching episodes, sorted by id, after the id `after`."""
        page, facts = _page(self._episodes.entries(), wanted, limit, offset, after)
        return EpisodeList.model_construct(episodes=page, **facts)

    def recordings(
        self,
        wanted: CatalogFilter | None = None,
        *,
        limit: int,
        offset: int = 0,
        after: str | None = None,
    ) -> RecordingList:
        """One page of matching finished recordings, sorted by id, after the id `after`."""
        wanted = wanted or CatalogFilter()
        page, facts = _page(self._recordings.entries(), wanted, limit, offset, after)
        return RecordingList.model_construct(recordings=page, **facts)

    def hours(self, wanted: EpisodeFilter) -> CatalogHours:
        """Total duration of matching episodes by task, domain and origin."""
        groups: defaultdict[tuple[str, str, str], list[EpisodeSummary]] = defaultdict(list)
        for episode in _matching(self._episodes.entries(), wanted).values():
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
    entries: Mapping[str, Entry[S]],
    wanted: CatalogFilter,
    limit: int,
    offset: int,
    after: str | None,
) -> tuple[tuple[S, ...], dict[str, Any]]:
    """The summaries of a page, and the number of all that match with the id to go on after."""
    found = _matching(entries, wanted)
    names = list(found)
    first = offset + (0 if after is None else bisect_right(names, after))
    chosen = names[first : first + limit]
    next_after = None if first + limit >= len(names) else chosen[-1]
    facts = {"num_matching": len(found), "next_after": next_after}
    return tuple(found[name] for name in chosen), facts


def _nominal_duration_s(reader: EpisodeReader | RecordingReader) -> float:
    # Counts come from the commit record, so no array is opened.
    return max(
        (
            reader.num_samples(name) / descriptor.nominal_rate_hz
            for name, descriptor in reader.streams.items()
        ),
        default=0.0,
    )
