"""Runs the alignment jobs of a service in worker processes, and resumes them after a restart."""

import asyncio
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import structlog

from dextouch.episodes import EpisodeStore
from dextouch.errors import (
    ConflictError,
    DexTouchError,
    InvalidInputError,
    StorageError,
    UnavailableError,
)
from services.alignment.job_queue import RETRY_AFTER_S, JobQueue
from services.alignment.jobs import AlignmentWorker, check_recordings, episode_id_of
from services.alignment.metrics import AlignmentMetrics
from services.alignment.schemas import ENDED, AlignmentJob, AlignmentRequest
from services.alignment.settings import AlignmentSettings
from services.alignment.synchronization.progress import Progress

logger = structlog.get_logger(__name__)

JOBS_FOLDER = ".alignments"
STOP_PERIOD_S = 0.05


class JobRunner:
    """The alignments of one store; asking again for the same one gives the same job.

    Runs between `start` and `close`. All methods belong to one event loop. `queue` holds the jobs,
    which are kept in `jobs_folder`; `metrics` shows them.
    """

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
        """Load the jobs on disk and start working on them.

        While they cannot be opened the service runs without them: `queue.problem` says why, and
        they are tried again every few seconds.
        """
        is_open = await self._open_queue()
        await self._sweep()
        work = [self._warm_up(), *(self._work(worker) for worker in self._workers)]
        if not is_open:
            work.append(self._open_later())
        self._tasks = [asyncio.create_task(one) for one in work]

    async def _open_queue(self) -> bool:
        """Load the jobs on disk, and put those back that were running; whether that was possible.

        The same failure is logged only once.
        """
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
        ended = asyncio.ensure_future(asyncio.to_thread(self._threads.shutdown))
        while not ended.done():
            # Repeated: a worker may have been about to start when it was stopped.
            await asyncio.to_thread(self._stop_workers)
            await asyncio.wait([ended], timeout=STOP_PERIOD_S)
        self.queue.close()

    async def submit(self, request: AlignmentRequest) -> tuple[AlignmentJob, ...]:
        """Submit alignments, or find those that run or are done; failed ones are submitted again.

        All of them are accepted or none.

        Raises:
            NotFoundError: no such recording.
            InvalidInputError: a recording lacks what every episode needs.
            LimitExceededError: too many are waiting.
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
        """Keep a failed job of a recording that cannot be aligned, so that its reason is listed.

        Raises:
            NotFoundError: no such recording.
            LimitExceededError: too many are waiting.
        """
        recording = await asyncio.to_thread(self._store.recording, recording_id)
        options = self._options
        job = AlignmentJob.new(episode_id_of(recording, options), recording_id, options)
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
        """Cancel an alignment that waits or runs; nothing of it is written.

        Raises:
            NotFoundError: not known here.
            ConflictError: it is done or has failed.
        """
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
        """Run one job after another on one worker."""
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
        """Start the job that has waited longest, once there is one."""
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
