"""Where the last saved take is on its way: upload, store and alignment, in one line."""

from typing import Literal
from urllib.parse import quote

from dextouch.errors import DexTouchError, NotFoundError
from dextouch.frozen_model import FrozenModel
from dextouch.schemas import HealthLevel, Problem, RecorderStatus, UploadStatus
from services.dashboard.upstream import Upstream

Stage = Literal["saved", "uploading", "refused", "stored", "aligning", "aligned", "failed"]


class TakeStateView(FrozenModel):
    """Stage of a take; `reason` says why it goes no further, or how far it is."""

    recording_id: str
    stage: Stage
    level: HealthLevel = "OK"
    reason: str = ""


class _Report(FrozenModel):
    num_steps: int
    duration_s: float = 0.0
    refused_parts: tuple[object, ...] = ()


class _Job(FrozenModel):
    alignment_id: str
    state: Literal["waiting", "running", "done", "failed", "cancelled"]
    progress: float
    report: _Report | None = None
    problem: Problem | None = None


class _Jobs(FrozenModel):
    alignments: tuple[_Job, ...]


async def last_take(acquisition: Upstream, alignment: Upstream | None) -> TakeStateView | None:
    """State of the newest take that was saved at the station; None before the first one."""
    session = (await acquisition.read(RecorderStatus, "/v1/recorder")).session
    if session is None or session.last_saved is None:
        return None
    view = await _last_state(session.last_saved, acquisition, alignment)
    if not session.last_incomplete:
        return view
    reason = " · ".join(filter(None, (f"incomplete: {session.last_incomplete}", view.reason)))
    level: HealthLevel = "WARN" if view.level == "OK" else view.level
    return view.model_copy(update={"level": level, "reason": reason})


async def _last_state(
    recording_id: str, acquisition: Upstream, alignment: Upstream | None
) -> TakeStateView:
    try:
        upload = await acquisition.read(UploadStatus, f"/v1/uploads/{quote(recording_id, safe='')}")
    except NotFoundError:
        # Stations that do not keep uploaded takes have removed it.
        upload = UploadStatus(recording_id=recording_id, uploaded=True)
    if upload.refused:
        return _view(recording_id, "refused", "ERROR", upload.error or "")
    if not upload.uploaded:
        if upload.error is None:
            return _view(recording_id, "uploading")
        return _view(recording_id, "saved", "WARN", upload.error)
    return await _aligned(recording_id, upload.stored_as or recording_id, alignment)


async def _aligned(recording_id: str, stored_as: str, alignment: Upstream | None) -> TakeStateView:
    if alignment is None:
        return _view(recording_id, "stored")
    path = f"/v1/alignments?recording_id={quote(stored_as, safe='')}&limit=1000"
    try:
        jobs = (await alignment.read(_Jobs, path)).alignments
    except DexTouchError as error:
        return _view(recording_id, "stored", "WARN", error.message)
    if not jobs:
        return _view(recording_id, "stored", reason="not aligned yet")
    job = jobs[-1]
    if job.state == "done":
        return _view(recording_id, "aligned", *_reported(job.report))
    if job.state in {"waiting", "running"}:
        share = f"{job.progress:.0%}" if job.state == "running" else "waits for its turn"
        return _view(recording_id, "aligning", reason=share)
    reason = job.problem.detail if job.problem else "alignment was cancelled"
    return _view(recording_id, "failed", "ERROR", reason or "no reason given")


def _reported(report: _Report | None) -> tuple[HealthLevel, str]:
    if report is None:
        return "OK", ""
    words = f"{report.duration_s:.1f} s, {report.num_steps} steps"
    if not report.refused_parts:
        return "OK", words
    return (
        "WARN",
        f"{words}; stretches left out: {len(report.refused_parts)} (dextouch align report)",
    )


def _view(
    recording_id: str, stage: Stage, level: HealthLevel = "OK", reason: str = ""
) -> TakeStateView:
    return TakeStateView(recording_id=recording_id, stage=stage, level=level, reason=reason)
