"""Requests in, alignments that run in worker threads and tell where they stand out."""

import asyncio
from concurrent.futures import ThreadPoolExecutor

import structlog

from dextouch.episodes import EpisodeStore
from dextouch.errors import (
    DexTouchError,
    LimitExceededError,
    NotFoundError,
    UnavailableError,
)
from dextouch.schemas.problems import problem_from_error
from services.alignment.jobs import align_recording, check_recording
from services.alignment.options import AlignmentOptions
from services.alignment.schemas import AlignmentJob, AlignmentRequest
from services.alignment.settings import AlignmentSettings

logger = structlog.get_logger(__name__)

RETRY_AFTER_S = 5


class JobTable:
    """The alignments of one process; asking again for the same one gives the same job.

    Args:
        store: of recordings and episodes.
        settings: workers, limits and default options.
    """

    def __init__(self, store: EpisodeStore, settings: AlignmentSettings) -> None:
        self._store = store
        self._settings = settings
        self._jobs: dict[str, AlignmentJob] = {}
        self._tasks: dict[str, asyncio.Task[None]] = {}
        self._workers = ThreadPoolExecutor(settings.num_workers, thread_name_prefix="align")

    async def submit(self, request: AlignmentRequest) -> AlignmentJob:
        """Start an alignment, or find the one that runs or is done; a failed one starts again.

        Raises:
            NotFoundError: no such recording.
            InvalidInputError: it lacks what every episode needs.
            LimitExceededError: too many are waiting.
        """
        options = request.options or self._settings.options
        alignment_id = await asyncio.to_thread(
            check_recording, self._store, request.recording_id, options
        )
        known = self._jobs.get(alignment_id)
        if known is not None and known.state != "failed":
            return known
        if len(self._tasks) >= self._settings.num_workers + self._settings.max_waiting:
            raise LimitExceededError(
                f"alignments: {len(self._tasks)} are running or waiting, expected at most "
                f"{self._settings.num_workers} and {self._settings.max_waiting}; try again later",
                retry_after_s=RETRY_AFTER_S,
            )
        job = AlignmentJob(
            alignment_id=alignment_id,
            recording_id=request.recording_id,
            state="waiting",
            progress=0.0,
        )
        self._jobs.pop(alignment_id, None)
        self._jobs[alignment_id] = job
        self._forget_oldest()
        self._tasks[alignment_id] = asyncio.create_task(self._run(job, options))
        return job

    async def wait(self, alignment_id: str) -> AlignmentJob:
        """The job once it is done or failed."""
        task = self._tasks.get(alignment_id)
        if task is not None:
            # The work goes on when the one who waits goes away.
            await asyncio.shield(task)
        return self.get(alignment_id)

    def get(self, alignment_id: str) -> AlignmentJob:
        """Where an alignment stands.

        Raises:
            NotFoundError: not asked for in this process.
        """
        if alignment_id not in self._jobs:
            raise NotFoundError(
                f"alignment {alignment_id!r}: not known here; POST /v1/alignments starts one"
            )
        return self._jobs[alignment_id]

    def all(self) -> tuple[AlignmentJob, ...]:
        """Every job, oldest first."""
        return tuple(self._jobs.values())

    async def close(self) -> None:
        """Let running work end; what still waits is dropped."""
        self._workers.shutdown(wait=False, cancel_futures=True)
        await asyncio.gather(*self._tasks.values(), return_exceptions=True)

    async def _run(self, job: AlignmentJob, options: AlignmentOptions) -> None:
        loop = asyncio.get_running_loop()

        def tell(progress: float) -> None:
            loop.call_soon_threadsafe(self._update, job.alignment_id, "running", progress)

        try:
            report = await loop.run_in_executor(
                self._workers, align_recording, self._store, job.recording_id, options, tell
            )
            done = {"state": "done", "progress": 1.0, "report": report}
        except (DexTouchError, asyncio.CancelledError) as error:
            ours = error if isinstance(error, DexTouchError) else UnavailableError("stopped")
            logger.warning("alignment_failed", recording_id=job.recording_id, reason=ours.message)
            problem = problem_from_error(ours, instance=job.alignment_id, request_id="")
            done = {"state": "failed", "problem": problem}
        except Exception:
            # The job's supervisor: one broken recording must not end the service.
            logger.exception("alignment_broke", recording_id=job.recording_id)
            broken = DexTouchError("unexpected error in alignment; the service's log tells more")
            problem = problem_from_error(broken, instance=job.alignment_id, request_id="")
            done = {"state": "failed", "problem": problem}
        finally:
            self._tasks.pop(job.alignment_id, None)
        self._jobs[job.alignment_id] = self._jobs[job.alignment_id].model_copy(update=done)

    def _update(self, alignment_id: str, state: str, progress: float) -> None:
        job = self._jobs[alignment_id]
        if job.state in {"waiting", "running"}:
            self._jobs[alignment_id] = job.model_copy(update={"state": state, "progress": progress})

    def _forget_oldest(self) -> None:
        ended = [key for key, job in self._jobs.items() if job.state in {"done", "failed"}]
        for key in ended[: max(0, len(self._jobs) - self._settings.max_kept)]:
            del self._jobs[key]
