"""Alignment of recordings as they arrive, so that a saved take becomes an episode by itself."""

import asyncio
import re

import structlog

from dextouch.episodes import EpisodeStore
from dextouch.errors import (
    CorruptDataError,
    DexTouchError,
    InvalidInputError,
    LimitExceededError,
    NotFoundError,
)
from services.alignment.job_table import JobTable
from services.alignment.jobs import MAX_STEM
from services.alignment.schemas import AlignmentRequest

logger = structlog.get_logger(__name__)

# Takes of an operator who calibrates a station are measurements, not demonstrations.
CALIBRATION_TASKS = "calibrate-"
# As `episode_id_of` makes them.
EPISODE_ID = re.compile(r"(.+)-[0-9a-f]{12}")


class NewRecordings:
    """Looks into a store and asks the job table for whatever has no episode yet, once each.

    A recording is left alone when there is a job of it, whatever became of that; when an episode
    made from it is in the store or its trash, under any options; or when it is a calibration take.
    One that cannot be aligned becomes a failed job with the reason.

    Args:
        store: of recordings and episodes.
        jobs: where alignments are asked for.
    """

    def __init__(self, store: EpisodeStore, jobs: JobTable) -> None:
        self._store, self._jobs = store, jobs
        self._seen: set[str] = set()

    async def watch(self, period_s: float) -> None:
        """Look again and again, until cancelled; a failure is logged when it is a new one."""
        failure = ""
        while True:
            try:
                await self.look()
                failure = ""
            except DexTouchError as error:
                if error.message != failure:
                    logger.warning("new_recordings_not_aligned", reason=error.message)
                failure = error.message
            except Exception:
                # The watcher's supervisor: alignments that are asked for must still be answered.
                logger.exception("watching_broke")
                return
            await asyncio.sleep(period_s)

    async def look(self) -> None:
        """Ask for what is new; a recording that finds no room in the queue is left for next time.

        Raises:
            StorageError: the store cannot be listed, or jobs cannot be kept.
        """
        known = frozenset(self._seen | self._jobs.book.recording_ids)
        new = await asyncio.to_thread(_not_aligned, self._store, known)
        for recording_id, wanted in new.items():
            if wanted:
                try:
                    await self._ask(recording_id)
                except LimitExceededError:
                    return
                except (CorruptDataError, NotFoundError) as error:
                    reason = error.message
                    logger.warning("alignment_failed", recording_id=recording_id, reason=reason)
            self._seen.add(recording_id)

    async def _ask(self, recording_id: str) -> None:
        recording = await asyncio.to_thread(self._store.recording, recording_id)
        if recording.attributes.task.startswith(CALIBRATION_TASKS):
            return
        try:
            await self._jobs.submit(AlignmentRequest(recording_id=recording_id))
        except InvalidInputError as error:
            await self._jobs.refuse(recording_id, error)


def _not_aligned(store: EpisodeStore, known: frozenset[str]) -> dict[str, bool]:
    """Recordings that are not known yet, and whether each still needs an episode."""
    new = [item for item in store.list(kind="recording") if item not in known]
    if not new:
        return {}
    matches = (EPISODE_ID.fullmatch(episode_id) for episode_id in _episode_ids(store))
    aligned = {match[1] for match in matches if match}
    return {item: len(item) > MAX_STEM or item not in aligned for item in new}


def _episode_ids(store: EpisodeStore) -> list[str]:
    """Of all episodes, and of those that somebody deleted and should not get back."""
    try:
        deleted = [entry.item_id for entry in store.trash_list() if entry.kind == "episode"]
    except InvalidInputError:
        deleted = []  # a store in a bucket has no trash
    return [*store.list(), *deleted]
