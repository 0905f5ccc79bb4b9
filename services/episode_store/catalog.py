"""Filters in, the matching episodes and recordings out; what is committed is read once."""

import threading
from collections.abc import Callable
from dataclasses import dataclass
from typing import TypeVar

import structlog

from dextouch.episodes import EpisodeStore
from dextouch.episodes.format import Kind
from dextouch.errors import NotFoundError, StorageError
from dextouch.schemas.episodes import Domain, EpisodeList, EpisodeSummary, Origin
from dextouch.schemas.recordings import RecordingList, RecordingSummary

logger = structlog.get_logger(__name__)

# An id and the revision under which it was read.
_Key = tuple[str, int]
S = TypeVar("S", EpisodeSummary, RecordingSummary)


@dataclass(frozen=True)
class EpisodeFilter:
    """What an episode must be; None takes any."""

    task: str | None = None
    domain: Domain | None = None
    origin: Origin | None = None
    success: bool | None = None

    def matches(self, episode: EpisodeSummary) -> bool:
        """Whether an episode is what is asked for."""
        wanted = (self.task, self.domain, self.origin, self.success)
        got = (episode.task, episode.domain, episode.origin, episode.success)
        return all(want is None or want == have for want, have in zip(wanted, got, strict=True))


class Catalog:
    """Summaries of all that is in a store, kept in memory since nothing committed ever changes.

    A damaged episode is left out and logged once; `verify` says what is wrong with it.
    """

    def __init__(self, store: EpisodeStore) -> None:
        self._store = store
        self._episodes: dict[_Key, EpisodeSummary | None] = {}
        self._recordings: dict[_Key, RecordingSummary | None] = {}
        self._guard = threading.Lock()

    def episodes(self, wanted: EpisodeFilter, *, limit: int, offset: int = 0) -> EpisodeList:
        """One page of matching episodes in the order of their ids."""
        with self._guard:
            self._episodes = self._refreshed(self._episodes, "episode", self._episode)
            found = [e for e in self._episodes.values() if e is not None and wanted.matches(e)]
        return EpisodeList(episodes=tuple(found[offset : offset + limit]), num_matching=len(found))

    def recordings(self, *, limit: int, offset: int = 0) -> RecordingList:
        """One page of finished recordings in the order of their ids."""
        with self._guard:
            self._recordings = self._refreshed(self._recordings, "recording", self._recording)
            found = [r for r in self._recordings.values() if r is not None]
        return RecordingList(
            recordings=tuple(found[offset : offset + limit]), num_matching=len(found)
        )

    def _refreshed(
        self, known: dict[_Key, S | None], kind: Kind, summarize: Callable[[str], S]
    ) -> dict[_Key, S | None]:
        summaries: dict[_Key, S | None] = {}
        for item_id in self._store.list(kind=kind):
            try:
                key = (item_id, self._store.revision(item_id, kind=kind))
                summaries[key] = known[key] if key in known else summarize(item_id)
            except NotFoundError:
                continue  # deleted while we were listing
            except StorageError as error:
                logger.warning("left_out_of_catalog", kind=kind, id=item_id, reason=error.message)
                summaries[key] = None
        return summaries

    def _episode(self, episode_id: str) -> EpisodeSummary:
        reader = self._store.open(episode_id)
        attributes = reader.attributes
        return EpisodeSummary(
            episode_id=episode_id,
            task=attributes.task,
            domain=attributes.domain,
            origin=attributes.origin,
            success=attributes.success,
            num_steps=reader.num_steps,
            content_sha256=reader.content_sha256,
        )

    def _recording(self, recording_id: str) -> RecordingSummary:
        reader = self._store.recording(recording_id)
        attributes = reader.attributes
        return RecordingSummary(
            recording_id=recording_id,
            task=attributes.task,
            domain=attributes.domain,
            station=attributes.station,
            num_samples={name: reader.num_samples(name) for name in reader.streams},
            content_sha256=reader.content_sha256,
        )
