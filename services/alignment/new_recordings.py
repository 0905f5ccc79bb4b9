"""Watcher that submits alignment jobs for recordings as they arrive in the store."""

import asyncio
import re
import time
from collections.abc import Sequence
from contextlib import suppress

import structlog

from dextouch.episodes import EpisodeStore, RecordingReader
from dextouch.errors import (
    DexTouchError,
    InvalidInputError,
    LimitExceededError,
    NotFoundError,
)
from services.alignment.job_runner import JobRunner
from services.alignment.jobs import MAX_STEM
from services.alignment.schemas import AlignmentRequest

logger = structlog.get_logger(__name__)

# Takes of an operator who calibrates a station are measurements, not demonstrations.
CALIBRATION_TASKS = "calibrate-"
# As `episode_id_of` makes them.
EPISODE_ID = re.compile(r"(.+)-[0-9a-f]{12}")
# What cannot be read may be repaired, brought over to this format, or on a disk that comes back;
# a full disk may have space again.
RETRY_S = 60.0


class NewRecordings:
    """Lists a store and submits a job for each recording that has no episode yet, once.

    A recording is skipped when it has a job, in whatever state; when an episode
    made from it is in the store or its trash, under any options; or when it is a calibration take.
    One that cannot be aligned becomes a failed job with the reason; if the disk was full, it is
    submitted again after RETRY_S. One that cannot be read is logged and tried again after RETRY_S.
    One that comes back under the id of another that was deleted while this was watching counts as
    new unless an episode was made from its content.
    """

    def __init__(self, store: EpisodeStore, jobs: JobRunner) -> None:
        self._store, self._jobs = store, jobs
        self._seen: set[str] = set()
        self._deleted: set[str] = set()
        # Why, and when that was found.
        self._unreadable: dict[str, tuple[str, float]] = {}

    async def watch(self, period_s: float) -> None:
        """Look for new recordings until cancelled; the same failure is logged only once."""
        failure = ""
        while True:
            try:
                await self.look()
                failure = ""
            except DexTouchError as error:
                if error.message != failure:
                    logger.warning("new_recordings_not_aligned", reason=error.message)
                failure = error.message
            except Exception as error:
                # Supervisor of the watcher: recordings that arrive later must be aligned, too.
                if repr(error) != failure:
                    logger.exception("watcher_failed")
                failure = repr(error)
            await asyncio.sleep(period_s)

    async def look(self) -> None:
        """Submit new recordings; a recording that finds no room in the queue is left for next time.

        Raises:
            StorageError: the store cannot be listed, or jobs cannot be kept.
        """
        for job in self._jobs.queue.out_of_space(for_s=RETRY_S):
            again = AlignmentRequest(recording_id=job.recording_id, options=job.options)
            with suppress(InvalidInputError, LimitExceededError, NotFoundError):
                await self._jobs.submit(again)
        new = self._new(await asyncio.to_thread(self._store.list, kind="recording"))
        if not new:
            return
        aligned = await asyncio.to_thread(_aligned, self._store)
        with suppress(LimitExceededError):
            for recording_id in new:
                is_old = recording_id not in self._deleted and len(recording_id) <= MAX_STEM
                if (is_old and recording_id in aligned) or await self._ask(
                    recording_id, aligned.get(recording_id, ())
                ):
                    self._seen.add(recording_id)
                    self._deleted.discard(recording_id)

    def _new(self, listed: Sequence[str]) -> list[str]:
        """Recordings neither submitted nor skipped before, nor found unreadable just now."""
        there = set(listed)
        self._deleted |= self._seen - there
        self._seen &= there
        self._seen |= (self._jobs.queue.recording_ids & there) - self._deleted
        self._unreadable = {k: found for k, found in self._unreadable.items() if k in there}
        since_s = time.monotonic() - RETRY_S
        just_now = {k for k, (_, found_s) in self._unreadable.items() if found_s > since_s}
        return [item for item in listed if item not in self._seen | just_now]

    async def _ask(self, recording_id: str, episode_ids: Sequence[str]) -> bool:
        """Submit a recording unless it is to be skipped; False if it cannot be read."""
        try:
            recording = await asyncio.to_thread(self._store.recording, recording_id)
        except DexTouchError as error:
            reason = error.message
            if reason != self._unreadable.get(recording_id, ("",))[0]:
                logger.warning("alignment_failed", recording_id=recording_id, reason=reason)
            self._unreadable[recording_id] = reason, time.monotonic()
            return False
        self._unreadable.pop(recording_id, None)
        if recording.attributes.task.startswith(CALIBRATION_TASKS):
            return True
        if await asyncio.to_thread(_has_episode, self._store, recording, episode_ids):
            return True
        try:
            await self._jobs.submit(AlignmentRequest(recording_id=recording_id))
        except InvalidInputError as error:
            await self._jobs.refuse(recording_id, error)
        except NotFoundError:
            return False  # deleted meanwhile
        return True


def _aligned(store: EpisodeStore) -> dict[str, list[str]]:
    """Ids of episodes by the id of their recording, including episodes in the trash."""
    try:
        # What was deleted must not be made again.
        deleted = [entry.item_id for entry in store.trash_list() if entry.kind == "episode"]
    except InvalidInputError:
        deleted = []  # a store in a bucket has no trash
    found: dict[str, list[str]] = {}
    for episode_id in [*store.list(), *deleted]:
        if match := EPISODE_ID.fullmatch(episode_id):
            found.setdefault(match[1], []).append(episode_id)
    return found


def _has_episode(
    store: EpisodeStore, recording: RecordingReader, episode_ids: Sequence[str]
) -> bool:
    """Whether one of these episodes was made from the content of this recording."""
    for episode_id in episode_ids:
        # Of the trash, or damaged.
        with suppress(DexTouchError):
            lineage = store.open(episode_id).attributes.lineage
            if recording.content_sha256 in {entry.sha256 for entry in lineage}:
                return True
    return False
