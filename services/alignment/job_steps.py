"""A job as it is in, the same job one step further out."""

from collections.abc import Mapping
from datetime import UTC, datetime
from typing import Any

from dextouch.errors import DexTouchError, UnavailableError
from dextouch.schemas.problems import problem_from_error
from services.alignment.options import AlignmentOptions
from services.alignment.report import AlignmentReport
from services.alignment.schemas import AlignmentJob
from services.alignment.synchronization.progress import Progress

# Less than this is too little to say how long the rest takes.
MIN_ETA_SHARE = 0.05


def submitted(alignment_id: str, recording_id: str, options: AlignmentOptions) -> AlignmentJob:
    """A new job."""
    return AlignmentJob(
        alignment_id=alignment_id,
        recording_id=recording_id,
        options=options,
        state="waiting",
        progress=0.0,
        submitted_at=_now(),
    )


def begun(job: AlignmentJob) -> AlignmentJob:
    """A worker takes it."""
    more = {"state": "running", "attempts": job.attempts + 1, "started_at": _now()}
    return job.model_copy(update=more)


def progressed(job: AlignmentJob, progress: Progress) -> AlignmentJob:
    """Further than before; progress never goes back."""
    share = max(job.progress, progress.share)
    more = {"progress": share, "stage": progress.stage, "stream": progress.stream}
    return job.model_copy(update=more)


def done(job: AlignmentJob, report: AlignmentReport) -> AlignmentJob:
    """Its episode is in the store."""
    return _ended(job, {"state": "done", "progress": 1.0, "report": report})


def failed(job: AlignmentJob, error: DexTouchError) -> AlignmentJob:
    """It ended without an episode, with the reason."""
    problem = problem_from_error(error, instance=job.alignment_id, request_id="")
    return _ended(job, {"state": "failed", "problem": problem})


def cancelled(job: AlignmentJob) -> AlignmentJob:
    """Somebody wanted it no more."""
    return _ended(job, {"state": "cancelled"})


def put_back(job: AlignmentJob) -> AlignmentJob:
    """The service was stopped while it ran: nobody's fault, so the attempt does not count."""
    return _waiting(job, attempts=job.attempts - 1)


def interrupted(job: AlignmentJob, *, max_attempts: int) -> AlignmentJob:
    """The service died while it ran: once more, but not for ever."""
    if job.attempts < max_attempts:
        return _waiting(job, attempts=job.attempts)
    error = UnavailableError(
        f"recording {job.recording_id!r}: the alignment service died {job.attempts} times while "
        "it was aligned, so it is not tried again by itself; look into the service's log "
        "(memory?), then ask for it again",
        attempts=job.attempts,
    )
    return failed(job, error)


def with_eta(job: AlignmentJob) -> AlignmentJob:
    """The job with the seconds that are left if all goes on as before."""
    if job.state != "running" or job.started_at is None or job.progress < MIN_ETA_SHARE:
        return job
    elapsed_s = max((_now() - job.started_at).total_seconds(), 0.0)
    return job.model_copy(update={"eta_s": elapsed_s * (1 - job.progress) / job.progress})


def _waiting(job: AlignmentJob, *, attempts: int) -> AlignmentJob:
    more = {"stage": None, "stream": None, "started_at": None, "progress": 0.0}
    return job.model_copy(update={"state": "waiting", "attempts": attempts, **more})


def _ended(job: AlignmentJob, update: Mapping[str, Any]) -> AlignmentJob:
    more = {"ended_at": _now(), "stage": None, "stream": None}
    return job.model_copy(update={**more, **update})


def _now() -> datetime:
    return datetime.now(UTC)
