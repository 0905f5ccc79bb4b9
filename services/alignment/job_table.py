"""Requests in, alignments that run in worker processes and tell where they stand out.

Jobs outlive the service: each step of a job is kept in its log before it is acknowledged, and what
waited or ran when the service died goes on when it starts again.
"""

import asyncio
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import structlog

from dextouch.episodes import EpisodeStore
from dextouch.errors import (
    ConflictError,
    DexTouchError,
    LimitExceededError,
    NotFoundError,
    StorageError,
    UnavailableError,
)
from services.alignment import job_steps
from services.alignment.job_log import JobLog
from services.alignment.jobs import check_recordings
from services.alignment.schemas import (
    ENDED,
    AlignmentJob,
    AlignmentList,
    AlignmentRequest,
    JobState,
)
from services.alignment.settings import AlignmentSettings
from services.alignment.synchronization.progress import Progress
from services.alignment.worker import AlignmentWorker

logger = structlog.get_logger(__name__)

JOBS_FOLDER = ".alignments"
RETRY_AFTER_S = 5


class JobTable:
    """The alignments of one store; asking again for the same one gives the same job.

    Open between `start` and `close`. All methods belong to one event loop.

    Args:
        store: of recordings and episodes.
        settings: workers, limits and default options.
    """

    def __init__(self, store: EpisodeStore, settings: AlignmentSettings) -> None:
        self._store, self._settings = store, settings
        self._jobs: dict[str, AlignmentJob] = {}
        self._log: JobLog | None = None
        # One step at a time: what is kept and what is told never differ.
        self._step = asyncio.Lock()
        self._changed = asyncio.Condition()
        self._workers = [AlignmentWorker(settings.store_url) for _ in range(settings.num_workers)]
        self._threads = ThreadPoolExecutor(settings.num_workers, thread_name_prefix="align")
        self._at_work: dict[str, AlignmentWorker] = {}
        self._slots: list[asyncio.Task[None]] = []
        self._warming: asyncio.Task[None] | None = None
        self.is_warm = False

    async def start(self) -> None:
        """Take over the jobs of the service before, and go to work.

        Raises:
            ConflictError: another service has them.
            CorruptDataError: their log is damaged.
        """
        folder = self._settings.jobs_folder or Path(self._store.root) / JOBS_FOLDER
        self._log = await asyncio.to_thread(JobLog, folder)
        self._jobs = dict(self._log.jobs)
        for job in [job for job in self._jobs.values() if job.state == "running"]:
            await self._keep(job_steps.interrupted(job, max_attempts=self._settings.max_attempts))
        await asyncio.to_thread(self._store.sweep)
        self._warming = asyncio.create_task(self._warm_up())
        self._slots = [asyncio.create_task(self._work(worker)) for worker in self._workers]

    async def close(self) -> None:
        """Stop at once; what runs or waits goes on when a service starts again."""
        for task in [*self._slots, *([self._warming] if self._warming else [])]:
            task.cancel()
        at_work = list(self._at_work)
        await asyncio.to_thread(self._stop_workers)
        await asyncio.gather(*self._slots, return_exceptions=True)
        for alignment_id in at_work:
            job = self._jobs[alignment_id]
            if job.state == "running":
                await self._keep(job_steps.put_back(job))
        await asyncio.to_thread(self._threads.shutdown)
        if self._log is not None:
            self._log.close()
            self._log = None

    async def submit(self, request: AlignmentRequest) -> tuple[AlignmentJob, ...]:
        """Start alignments, or find those that run or are done; failed ones start again.

        All of them or none are taken.

        Raises:
            NotFoundError: no such recording.
            InvalidInputError: a recording lacks what every episode needs.
            LimitExceededError: too many are waiting.
        """
        options = request.options or self._settings.options
        ids = await asyncio.to_thread(check_recordings, self._store, request.wanted, options)
        async with self._step:
            new = {
                alignment_id: job_steps.submitted(alignment_id, recording_id, options)
                for recording_id, alignment_id in ids.items()
                if self._is_wanted(alignment_id)
            }
            self._check_room(len(new))
            await self._write(list(new.values()))
            for alignment_id in new:
                self._jobs.pop(alignment_id, None)
            self._jobs |= new
            self._forget_oldest()
        await self._announce()
        return tuple(self.get(alignment_id) for alignment_id in ids.values())

    async def wait(self, alignment_id: str) -> AlignmentJob:
        """The job once it has ended."""
        async with self._changed:
            await self._changed.wait_for(lambda: self.get(alignment_id).state in ENDED)
        return self.get(alignment_id)

    async def cancel(self, alignment_id: str) -> AlignmentJob:
        """End an alignment that waits or runs; nothing of it is written.

        Raises:
            NotFoundError: not known here.
            ConflictError: it is done or has failed.
        """
        async with self._step:
            job = self.get(alignment_id)
            if job.state in {"done", "failed"}:
                raise ConflictError(
                    f"alignment {alignment_id!r}: is {job.state}, expected one that waits or runs"
                )
            if job.state != "cancelled":
                await self._write([job_steps.cancelled(job)])
                self._jobs[alignment_id] = job_steps.cancelled(job)
            worker = self._at_work.get(alignment_id)
            if worker is not None:
                # Within the step: else the worker could have begun the next job already.
                await asyncio.to_thread(worker.stop)
        await self._announce()
        return self.get(alignment_id)

    def get(self, alignment_id: str) -> AlignmentJob:
        """Where an alignment stands.

        Raises:
            NotFoundError: nobody asked for it, or it ended long ago.
        """
        if alignment_id not in self._jobs:
            raise NotFoundError(
                f"alignment {alignment_id!r}: not known here; POST /v1/alignments starts one"
            )
        return job_steps.with_eta(self._jobs[alignment_id])

    def page(self, *, state: JobState | None, after: str | None, limit: int) -> AlignmentList:
        """Some of the jobs, oldest first.

        Args:
            state: only these; None for all.
            after: the id behind which the page begins.
            limit: of the page.

        Raises:
            NotFoundError: no such job as `after`.
        """
        ids = list(self._jobs)
        start = 0 if after is None else ids.index(self.get(after).alignment_id) + 1
        rest = [i for i in ids[start:] if state is None or self._jobs[i].state == state]
        shown = rest[:limit]
        return AlignmentList(
            alignments=tuple(self.get(alignment_id) for alignment_id in shown),
            num_matching=sum(state is None or job.state == state for job in self._jobs.values()),
            next_after=shown[-1] if len(rest) > limit else None,
        )

    def waiting_for(self) -> list[str]:
        """What is missing before work may be sent."""
        return [] if self.is_warm else ["solver"]

    def _is_wanted(self, alignment_id: str) -> bool:
        known = self._jobs.get(alignment_id)
        return known is None or known.state in {"failed", "cancelled"}

    def _check_room(self, num_new: int) -> None:
        open_jobs = sum(job.state not in ENDED for job in self._jobs.values())
        allowed = self._settings.num_workers + self._settings.max_waiting
        if num_new and open_jobs + num_new > allowed:
            raise LimitExceededError(
                f"alignments: {open_jobs} are running or waiting and {num_new} more were asked "
                f"for, expected at most {allowed} in all; try again later",
                retry_after_s=RETRY_AFTER_S,
            )

    async def _warm_up(self) -> None:
        """Start the first worker, so that the first recording need not wait for its solver."""
        loop = asyncio.get_running_loop()
        try:
            await loop.run_in_executor(self._threads, self._workers[0].start)
        except UnavailableError as error:
            logger.warning("worker_does_not_start", reason=error.message)
            return
        self.is_warm = True

    async def _work(self, worker: AlignmentWorker) -> None:
        """One slot: a job after the other."""
        while True:
            async with self._changed:
                await self._changed.wait_for(lambda: self._next() is not None)
            try:
                job = await self._take(worker)
            except StorageError as error:
                logger.warning("job_cannot_begin", reason=error.message)
                await asyncio.sleep(RETRY_AFTER_S)
                continue
            if job is None:
                continue
            try:
                await self._carry_out(job, worker)
            finally:
                self._at_work.pop(job.alignment_id, None)
            await self._announce()

    async def _take(self, worker: AlignmentWorker) -> AlignmentJob | None:
        """Let the job that waits longest begin; None if another worker was faster."""
        async with self._step:
            waiting = self._next()
            if waiting is None:
                return None
            job = job_steps.begun(waiting)
            await self._write([job])
            self._jobs[job.alignment_id] = job
            self._at_work[job.alignment_id] = worker
            return job

    async def _carry_out(self, job: AlignmentJob, worker: AlignmentWorker) -> None:
        loop = asyncio.get_running_loop()

        def tell(progress: Progress) -> None:
            loop.call_soon_threadsafe(self._progressed, job.alignment_id, progress)

        try:
            report = await loop.run_in_executor(
                self._threads, worker.run, job.recording_id, job.options, tell
            )
            ended = job_steps.done(job, report)
        except DexTouchError as error:
            if self._jobs[job.alignment_id].state == "running":
                logger.warning(
                    "alignment_failed", recording_id=job.recording_id, reason=error.message
                )
            ended = job_steps.failed(job, error)
            if isinstance(error, UnavailableError):
                # What the process was writing; it lies beside the store's episodes.
                await asyncio.to_thread(self._store.sweep)
        except Exception:
            # The job's supervisor: one broken recording must not end the service.
            logger.exception("alignment_broke", recording_id=job.recording_id)
            broken = DexTouchError("unexpected error; the service's log tells more")
            ended = job_steps.failed(job, broken)
        if self._jobs[job.alignment_id].state == "running":
            await self._keep(ended)

    def _next(self) -> AlignmentJob | None:
        return next((job for job in self._jobs.values() if job.state == "waiting"), None)

    def _progressed(self, alignment_id: str, progress: Progress) -> None:
        job = self._jobs.get(alignment_id)
        if job is not None and job.state == "running":
            self._jobs[alignment_id] = job_steps.progressed(job, progress)

    async def _keep(self, job: AlignmentJob) -> None:
        """A step that has happened, whether or not there is room to write it down."""
        async with self._step:
            try:
                await self._write([job])
            except StorageError as error:
                # Lost, the job is done once more after a restart, and finds its episode.
                logger.warning("job_not_kept", alignment_id=job.alignment_id, reason=error.message)
            self._jobs[job.alignment_id] = job

    async def _write(self, jobs: list[AlignmentJob]) -> None:
        if self._log is None:
            raise UnavailableError("alignments: the service has not started or is stopping")
        await asyncio.to_thread(self._log.append, jobs)

    async def _announce(self) -> None:
        async with self._changed:
            self._changed.notify_all()

    def _forget_oldest(self) -> None:
        ended = [key for key, job in self._jobs.items() if job.state in ENDED]
        for key in ended[: max(0, len(self._jobs) - self._settings.max_kept)]:
            del self._jobs[key]
        if self._log is not None:
            self._log.shorten(self._jobs.values())

    def _stop_workers(self) -> None:
        for worker in self._workers:
            worker.stop()
