"""Runs the alignment jobs of a service in worker processes, and submits those of new recordings."""

import asyncio
import re
import time
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import suppress
from functools import partial
from pathlib import Path
from typing import Final, get_args

import structlog
from prometheus_client import CollectorRegistry, Counter, Gauge, Histogram

from dextouch.episodes import EpisodeStore, RecordingReader
from dextouch.errors import (
    ConflictError,
    DexTouchError,
    InvalidInputError,
    LimitExceededError,
    NotFoundError,
    StorageError,
    UnavailableError,
)
from services.alignment.job_queue import RETRY_AFTER_S, JobQueue
from services.alignment.jobs import MAX_STEM, AlignmentWorker, check_recordings, episode_id_of
from services.alignment.schemas import ENDED, AlignmentJob, AlignmentRequest, JobState
from services.alignment.settings import AlignmentSettings
from services.alignment.synchronization import Progress

logger = structlog.get_logger(__name__)

# Of the histogram of durations.
SECONDS: Final = (1.0, 2.0, 5.0, 10.0, 20.0, 60.0, 120.0, 300.0, 600.0, 1800.0, 3600.0)
JOBS_FOLDER = ".alignments"
STOP_PERIOD_S = 0.05
# Takes of an operator who calibrates a station are measurements, not demonstrations.
CALIBRATION_TASKS = "calibrate-"
# As `episode_id_of` makes them.
EPISODE_ID = re.compile(r"(.+)-[0-9a-f]{12}")
# What cannot be read may be repaired, brought over to this format, or on a disk that comes back;
# a full disk may have space again.
RETRY_S = 60.0


class AlignmentMetrics:
    """Shows a queue in a `registry`, and counts the alignments that ended since the start."""

    def __init__(self, queue: JobQueue) -> None:
        registry = self.registry = CollectorRegistry()
        text = "Alignments that the service remembers, by state."
        jobs = Gauge("dextouch_alignment_jobs", text, ("state",), registry=registry)
        for state in get_args(JobState):
            jobs.labels(state).set_function(partial(queue.num_jobs, state))
        text = "Alignments that may wait or run; more are refused."
        limit = Gauge("dextouch_alignment_open_jobs_limit", text, registry=registry)
        limit.set(queue.max_open)
        text = "For how long the oldest waiting alignment has waited; 0 without one."
        oldest = Gauge("dextouch_alignment_oldest_waiting_seconds", text, registry=registry)
        oldest.set_function(queue.oldest_waiting_s)
        text = "Alignments that ended."
        self._ended = Counter("dextouch_alignments_ended", text, ("state",), registry=registry)
        name = "dextouch_alignment_seconds"
        text = "Duration of the last attempt of a done alignment."
        self._seconds = Histogram(name, text, buckets=SECONDS, registry=registry)
        for state in ENDED:
            self._ended.labels(state)

    def count(self, job: AlignmentJob) -> None:
        """Count a job that has just ended."""
        self._ended.labels(job.state).inc()
        if job.state == "done" and job.started_at is not None and job.ended_at is not None:
            self._seconds.observe((job.ended_at - job.started_at).total_seconds())


class JobRunner:
    """The alignments of a store between `start` and `close`; jobs in `jobs_folder` resume."""

    def __init__(self, store: EpisodeStore, settings: AlignmentSettings) -> None:
        self._store, self._settings = store, settings
        self.jobs_folder = settings.jobs_folder or Path(store.root) / JOBS_FOLDER
        max_open = settings.num_workers + settings.max_waiting
        self.queue = JobQueue(max_open=max_open, max_kept=settings.max_kept)
        self._options = settings.wanted_options
        self.metrics = AlignmentMetrics(self.queue)
        self._changed = asyncio.Condition(self.queue.lock)
        self._workers = [
            AlignmentWorker(settings.store_url, settings.log_level)
            for _ in range(settings.num_workers)
        ]
        self._threads = ThreadPoolExecutor(settings.num_workers, thread_name_prefix="align")
        self._at_work: dict[str, AlignmentWorker] = {}
        self._tasks: list[asyncio.Task[None]] = []
        self.is_warm = False

    async def start(self) -> None:
        """Load the jobs on disk, every few seconds until they open, and work on them."""
        is_open = await self._open_queue()
        await self._sweep()
        work = [self._warm_up(), *(self._work(worker) for worker in self._workers)]
        if not is_open:
            work.append(self._open_later())
        self._tasks = [asyncio.create_task(one) for one in work]

    async def _open_queue(self) -> bool:
        """Load the jobs on disk, and put running ones back; whether it worked."""
        before = self.queue.problem
        async with self._changed:
            try:
                running = await self.queue.open(self.jobs_folder)
            except (ConflictError, StorageError) as error:
                if error.message != before:
                    logger.error("jobs_not_opened", reason=error.message)  # noqa: TRY400
                return False
            for job in running:
                resumed = job.crashed(max_attempts=self._settings.max_attempts)
                await self.queue.save_if_possible(resumed)
            self._changed.notify_all()
        if before is not None:
            logger.info("jobs_opened", folder=str(self.jobs_folder))
        return True

    async def _open_later(self) -> None:
        is_open = False
        while not is_open:
            await asyncio.sleep(RETRY_AFTER_S)
            is_open = await self._open_queue()

    async def close(self) -> None:
        """Stop at once; unfinished jobs continue when a service starts again."""
        for task in self._tasks:
            task.cancel()
        at_work = list(self._at_work)
        await asyncio.to_thread(self._stop_workers)
        await asyncio.gather(*self._tasks, return_exceptions=True)
        async with self.queue.lock:
            for job in map(self.queue.get, at_work):
                if job.state == "running":
                    # An attempt that the service itself ends does not count.
                    again = job.waiting(attempts=job.attempts - 1)
                    await self.queue.save_if_possible(again)
        ended = asyncio.create_task(asyncio.to_thread(self._threads.shutdown))
        while not ended.done():
            # Repeated: a worker may have been about to start when it was stopped.
            await asyncio.to_thread(self._stop_workers)
            await asyncio.wait([ended], timeout=STOP_PERIOD_S)
        self.queue.close()

    async def submit(self, request: AlignmentRequest) -> tuple[AlignmentJob, ...]:
        """Submit alignments, or find those that run or are done; failed ones are submitted again.

        All are accepted or none. Raises NotFoundError: no such recording; InvalidInputError: it
        lacks what every episode needs; LimitExceededError: too many are waiting.
        """
        options = request.options or self._options
        if options.objects is None:
            options = options.model_copy(update={"objects": self._options.objects})
        ids = await asyncio.to_thread(check_recordings, self._store, request.wanted, options)
        jobs = [
            AlignmentJob.new(alignment_id, recording_id, options)
            for recording_id, alignment_id in ids.items()
        ]
        async with self._changed:
            await self.queue.add(jobs)
            self._changed.notify_all()
        return tuple(self.queue.get(alignment_id) for alignment_id in ids.values())

    async def refuse(self, recording_id: str, error: InvalidInputError) -> None:
        """Keep a failed job with its reason; raises NotFoundError or LimitExceededError."""
        recording = await asyncio.to_thread(self._store.recording, recording_id)
        alignment_id = episode_id_of(recording, self._options)
        job = AlignmentJob.new(alignment_id, recording_id, self._options)
        failed = job.ended("failed", error=error)
        async with self.queue.lock:
            await self.queue.add([failed])
        self.metrics.count(failed)
        logger.warning("alignment_failed", recording_id=recording_id, reason=error.message)

    async def wait(self, alignment_id: str) -> AlignmentJob:
        """The job once it has ended."""
        async with self._changed:
            await self._changed.wait_for(lambda: self.queue.get(alignment_id).state in ENDED)
        return self.queue.get(alignment_id)

    async def cancel(self, alignment_id: str) -> AlignmentJob:
        """Cancel a job that waits or runs; raises NotFoundError, or ConflictError if done."""
        async with self._changed:
            job = self.queue.get(alignment_id)
            if job.state in {"done", "failed"}:
                raise ConflictError(
                    f"alignment {alignment_id!r}: is {job.state}, expected one that waits or runs"
                )
            if job.state != "cancelled":
                cancelled = job.ended("cancelled")
                await self.queue.save(cancelled)
                self.metrics.count(cancelled)
            worker = self._at_work.get(alignment_id)
            if worker is not None:
                # While holding the lock: otherwise the worker could have started the next job.
                await asyncio.to_thread(worker.stop)
            self._changed.notify_all()
        return self.queue.get(alignment_id)

    async def _warm_up(self) -> None:
        """Start the first worker early, because compiling its solver takes long."""
        loop = asyncio.get_running_loop()
        try:
            await loop.run_in_executor(self._threads, self._workers[0].start)
        except UnavailableError as error:
            logger.warning("worker_not_started", reason=error.message)
            return
        self.is_warm = True

    async def _work(self, worker: AlignmentWorker) -> None:
        while True:
            try:
                job = await self._take(worker)
            except StorageError as error:
                logger.warning("job_not_started", reason=error.message)
                await asyncio.sleep(RETRY_AFTER_S)
                continue
            try:
                await self._carry_out(job, worker)
            finally:
                if self._at_work.get(job.alignment_id) is worker:
                    del self._at_work[job.alignment_id]

    async def _take(self, worker: AlignmentWorker) -> AlignmentJob:
        async with self._changed:
            waiting = await self._changed.wait_for(self.queue.next)
            assert waiting is not None  # noqa: S101 - what was waited for
            job = waiting.started()
            await self.queue.save(job)
            self._at_work[job.alignment_id] = worker
            return job

    async def _carry_out(self, job: AlignmentJob, worker: AlignmentWorker) -> None:
        loop = asyncio.get_running_loop()

        def on_progress(progress: Progress) -> None:
            loop.call_soon_threadsafe(self.queue.set_progress, job, progress)

        try:
            report = await loop.run_in_executor(
                self._threads, worker.run, job.recording_id, job.options, on_progress
            )
            ended = job.ended("done", report=report)
        except DexTouchError as error:
            ended = job.ended("failed", error=error)
            if isinstance(error, UnavailableError):
                await self._sweep()
        except Exception:
            # The job's supervisor: one broken recording must not end the service.
            logger.exception("alignment_crashed", recording_id=job.recording_id)
            broken = DexTouchError("unexpected error; see the service's log")
            ended = job.ended("failed", error=broken)
        async with self._changed:
            if not self.queue.is_current(job):
                return
            if ended.problem is not None:
                reason = ended.problem.detail
                logger.warning("alignment_failed", recording_id=job.recording_id, reason=reason)
            await self.queue.save_if_possible(ended)
            self.metrics.count(ended)
            self._changed.notify_all()

    async def _sweep(self) -> None:
        """Remove what processes that died were writing beside the store's episodes."""
        try:
            await asyncio.to_thread(self._store.sweep)
        except StorageError as error:
            logger.warning("sweep_failed", reason=error.message)

    def _stop_workers(self) -> None:
        for worker in self._workers:
            worker.stop()


class NewRecordings:
    """Lists a store and submits a job for each recording that has no episode yet, once.

    A recording is skipped when it has a job; when an episode made from it is in the store or its
    trash, under any options; or when it is a calibration take. One that cannot be aligned becomes a
    failed job with the reason; it is submitted again after RETRY_S if the disk was full, and one
    that cannot be read is tried again. One that comes back under the id of a deleted one is new
    unless an episode was made from its content.
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
        """Submit new recordings as far as the queue has room; raises StorageError."""
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
        listed_ids = set(listed)
        self._deleted |= self._seen - listed_ids
        self._seen &= listed_ids
        self._seen |= (self._jobs.queue.recording_ids & listed_ids) - self._deleted
        self._unreadable = {k: found for k, found in self._unreadable.items() if k in listed_ids}
        since_s = time.monotonic() - RETRY_S
        unreadable = {k for k, (_, found_s) in self._unreadable.items() if found_s > since_s}
        return [item for item in listed if item not in self._seen | unreadable]

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
    for episode_id in episode_ids:
        # Of the trash, or damaged.
        with suppress(DexTouchError):
            lineage = store.open(episode_id).attributes.lineage
            if recording.content_sha256 in {entry.sha256 for entry in lineage}:
                return True
    return False
