"""Jobs in, the same jobs by id, by page and on disk out; what is kept and what is told agree."""

import asyncio
from collections.abc import Sequence
from pathlib import Path

import structlog

from dextouch.errors import LimitExceededError, NotFoundError, StorageError, UnavailableError
from services.alignment import job_steps
from services.alignment.job_log import JobLog
from services.alignment.schemas import ENDED, AlignmentJob, AlignmentList, JobState
from services.alignment.synchronization.progress import Progress

logger = structlog.get_logger(__name__)

RETRY_AFTER_S = 5


class JobBook:
    """All jobs of one service in the order in which they were asked for.

    Changes are made while holding `step`, one at a time; all of it belongs to one event loop.

    Args:
        max_open: jobs that may wait or run.
        max_kept: jobs that are remembered; the oldest that ended go first.
    """

    def __init__(self, *, max_open: int, max_kept: int) -> None:
        self.step = asyncio.Lock()
        self._max_open, self._max_kept = max_open, max_kept
        self._jobs: dict[str, AlignmentJob] = {}
        self._log: JobLog | None = None

    async def open(self, folder: Path) -> list[AlignmentJob]:
        """Take over what is kept in a folder; the jobs that ran when it was left come back.

        Raises:
            ConflictError: another service has it.
            CorruptDataError: it is damaged.
        """
        self._log = await asyncio.to_thread(JobLog, folder)
        self._jobs = dict(self._log.jobs)
        return [job for job in self._jobs.values() if job.state == "running"]

    def close(self) -> None:
        """Give the folder back."""
        if self._log is not None:
            self._log.close()
            self._log = None

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

    @property
    def recording_ids(self) -> set[str]:
        """Recordings that there are jobs of."""
        return {job.recording_id for job in self._jobs.values()}

    def next(self) -> AlignmentJob | None:
        """The job that has waited longest."""
        return next((job for job in self._jobs.values() if job.state == "waiting"), None)

    def runs(self, job: AlignmentJob) -> bool:
        """Whether a job is still at this very attempt, neither cancelled nor begun again."""
        known = self._jobs.get(job.alignment_id)
        return known is not None and known.state == "running" and known.started_at == job.started_at

    async def add(self, jobs: Sequence[AlignmentJob]) -> None:
        """Take new jobs in; those that wait, run or are done stay as they are. Needs `step`.

        Raises:
            LimitExceededError: too many would wait; none is taken.
            StorageError: they cannot be kept; none is taken.
        """
        again = {None, "failed", "cancelled"}
        states = {key: job.state for key, job in self._jobs.items()}
        new = {j.alignment_id: j for j in jobs if states.get(j.alignment_id) in again}
        num_open = sum(job.state not in ENDED for job in self._jobs.values())
        if new and num_open + len(new) > self._max_open:
            raise LimitExceededError(
                f"alignments: {num_open} are running or waiting and {len(new)} more were asked "
                f"for, expected at most {self._max_open} in all; try again later",
                retry_after_s=RETRY_AFTER_S,
            )
        await self._write(list(new.values()))
        for alignment_id in new:
            self._jobs.pop(alignment_id, None)
        self._jobs |= new
        ended = [key for key, job in self._jobs.items() if job.state in ENDED]
        for key in ended[: max(0, len(self._jobs) - self._max_kept)]:
            del self._jobs[key]
        if self._log is not None:
            self._log.shorten(self._jobs.values())

    async def change(self, job: AlignmentJob) -> None:
        """One more step of a job, kept before it is told. Needs `step`.

        Raises:
            StorageError: it cannot be kept, and so has not happened.
        """
        await self._write([job])
        self._jobs[job.alignment_id] = job

    async def note(self, job: AlignmentJob) -> None:
        """A step that has happened, whether or not there is room to keep it. Needs `step`."""
        try:
            await self._write([job])
        except StorageError as error:
            # Lost, the job is done once more after a restart, and finds its episode.
            logger.warning("job_not_kept", alignment_id=job.alignment_id, reason=error.message)
        self._jobs[job.alignment_id] = job

    def progressed(self, job: AlignmentJob, progress: Progress) -> None:
        """How far a job is, which only the memory of this process holds."""
        if self.runs(job):
            known = self._jobs[job.alignment_id]
            self._jobs[job.alignment_id] = job_steps.progressed(known, progress)

    async def _write(self, jobs: list[AlignmentJob]) -> None:
        if self._log is None:
            raise UnavailableError("alignments: the service has not started or is stopping")
        await asyncio.to_thread(self._log.append, jobs)
