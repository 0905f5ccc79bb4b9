"""Panels of devices and recorder: the station's answers in the page's words and display units."""

from collections.abc import Mapping, Sequence
from typing import Literal
from urllib.parse import quote

from pydantic import Field

from dextouch import schemas
from dextouch.errors import AccessDeniedError, DexTouchError, NotFoundError
from dextouch.frozen_model import FrozenModel, is_none
from dextouch.tactile import LayoutDescription
from services.dashboard.upstream import Upstream

# From harmless to grave: an ERROR of one stream outranks the silence of another.
LEVELS: tuple[schemas.HealthLevel, ...] = ("OK", "WARN", "STALE", "ERROR")
# Of the recorder's status, shown as it is.
KEPT = {"state", "actions", "recording_id", "prompt", "session", "needs_consent"}
# What the station finds of its computer.
HOST_FINDINGS = {"overload", "disk", "host_suspended", "wall_clock_set"}


class StreamView(FrozenModel):
    """One row of the devices panel; None where not measured.

    `note` are the counters of its device that an operator should know of.
    """

    name: str
    device: str
    level: schemas.HealthLevel
    note: str
    rate_hz: float | None
    nominal_rate_hz: float
    dropped: int
    drop_percent: float | None
    age_s: float | None
    skew_ppm: float | None
    clock_error_ms: float | None


class CauseView(FrozenModel):
    """A root cause with its one advice; `findings` is what follows from it, a line a stream."""

    key: str
    level: schemas.HealthLevel
    message: str
    advice: str
    lasted_s: float | None
    streams: tuple[str, ...]
    findings: tuple[str, ...]


class HostView(FrozenModel):
    """The station's computer; None where not measured."""

    level: schemas.HealthLevel = "OK"
    cpu_percent: float | None = None
    wake_ms: float | None = None
    disk_free_gb: float | None = None
    disk_left_s: float | None = None


class RecorderView(FrozenModel):
    """State of the recorder and its available actions.

    `cause` is the root cause of the worst problem of the ended take and `advice` what to do about
    it; `problems` are its `num_findings`, one line a stream, worst first.
    """

    state: str
    actions: tuple[str, ...] = ()
    recording_id: str | None = None
    prompt: schemas.TakePrompt | None = None
    elapsed_s: float | None = None
    level: schemas.HealthLevel = "OK"
    complete: bool = True
    cause: str = ""
    advice: str = ""
    problems: tuple[str, ...] = ()
    num_findings: int = 0
    session: schemas.RecorderSession | None = None
    needs_consent: bool = False


class GloveView(FrozenModel):
    """Taxels of a glove that are out of order, by their state, and the age of its tare.

    `layout` is that of its taxels, None of `dextouch_v1`.
    """

    taxels: dict[schemas.TaxelState, tuple[int, ...]]
    tare_age_s: float | None
    layout: LayoutDescription | None = Field(default=None, exclude_if=is_none)


class StationView(FrozenModel):
    """Overview of the station; by default of one that is not configured, for the reason `note`."""

    reachable: bool = False
    level: schemas.HealthLevel = "STALE"
    summary: str = ""
    note: str
    note_level: schemas.HealthLevel = "ERROR"
    host: HostView | None = None
    causes: tuple[CauseView, ...] = ()
    streams: tuple[StreamView, ...] = ()
    recorder: RecorderView = RecorderView(state="unknown", level="ERROR")
    gloves: Mapping[str, GloveView] = {}
    following: Mapping[str, schemas.RobotFollowing] = {}
    faults: tuple[schemas.SimulatedFault, ...] | None = None


def trouble(error: DexTouchError, address: str) -> tuple[str, str]:
    """Why a station is not shown, in the words of an operator, and what to do."""
    if error.details.get("no_answer"):
        return (
            "This station does not answer.",
            "Check that its computer is on and on the network, and that the station's service runs "
            f"there ({address}).",
        )
    if isinstance(error, AccessDeniedError):
        advice = "Give the dashboard a key of this station: DEXTOUCH_DASHBOARD_UPSTREAM_KEY."
        return f"This station refuses the dashboard: {error.message}.", advice
    return error.message, ""


def silent_view(error: DexTouchError, address: str) -> StationView:
    """The view of a station that does not answer, or not as it should."""
    message, advice = trouble(error, address)
    cause = CauseView(
        key="station",
        level="STALE",
        message=message,
        advice=advice,
        lasted_s=None,
        streams=(),
        findings=(error.message,) if error.message != message else (),
    )
    return StationView(summary="no answer", note="", causes=(cause,))


def station_view(station: schemas.StationHealth, recorder: schemas.RecorderStatus) -> StationView:
    """The station view of an acquisition service that responds."""
    devices = {device.device: device for device in station.devices}
    streams = tuple(_stream_view(item, devices.get(item.device)) for item in station.streams)
    causes = tuple(_cause_view(cause, station) for cause in station.causes)
    note = "" if streams else "No devices are connected."
    levels = [*(stream.level for stream in streams), *(cause.level for cause in causes)]
    return StationView(
        reachable=True,
        level=_worst(levels if streams else ["STALE", *levels]),
        summary=_summary(streams, causes),
        note=note,
        note_level="STALE" if note else "OK",
        host=_host_view(station),
        causes=causes,
        streams=streams,
        recorder=recorder_view(recorder),
        gloves={
            item.hand: GloveView(taxels=item.taxels, tare_age_s=item.tare_age_s, layout=item.layout)
            for item in station.streams
            if item.hand is not None and item.stream == f"tactile_{item.hand}"
        },
        following={
            item.hand: item.following
            for item in station.streams
            if item.hand is not None and item.following is not None
        },
        faults=station.faults,
    )


def recorder_view(recorder: schemas.RecorderStatus) -> RecorderView:
    """The recorder view, with the findings of a take's check among the recorder's problems."""
    check = recorder.check
    # ERROR sorts before WARN. The recorder repeats what the check found: each is listed once.
    found = sorted(check.problems, key=lambda problem: problem.level) if check else []
    checked = [problem.message for problem in found]
    own = [message for message in recorder.problems if message not in checked]
    lines: dict[str, list[str]] = {}
    for item in found:
        text = item.message.removeprefix(f"{item.stream}: ")
        if text not in lines.setdefault(item.stream, []):
            lines[item.stream].append(text)
    problems = (*dict.fromkeys(own), *(f"{s}: {' · '.join(texts)}" for s, texts in lines.items()))
    complete = check is None or check.complete
    cause = check.cause if check else None
    level: schemas.HealthLevel = "WARN" if complete else "ERROR"
    return RecorderView(
        **recorder.model_dump(include=KEPT),
        elapsed_s=recorder.duration_s,
        level=level if problems else "OK",
        complete=complete,
        cause=cause.message if cause else next(iter(problems), ""),
        advice=cause.advice if cause else "",
        problems=problems,
        num_findings=len({*own, *checked}),
    )


def _worst(levels: Sequence[schemas.HealthLevel]) -> schemas.HealthLevel:
    return max(levels, key=LEVELS.index, default="OK")


def _stream_view(item: schemas.StreamHealth, device: schemas.DeviceHealth | None) -> StreamView:
    words = []
    if device is not None:
        words += [f"{device.reconnects} reconnects"] * bool(device.reconnects)
        words += [f"{device.suspects} packets held back"] * bool(device.suspects)
        if device.last_error and item.level in {"ERROR", "STALE"}:
            words.append(device.last_error)
    offered = item.received + item.lost
    return StreamView(
        **item.model_dump(include=set(StreamView.model_fields)),
        name=item.stream,
        note=" · ".join(words),
        dropped=item.lost,
        drop_percent=100 * item.lost / offered if offered else None,
        clock_error_ms=item.clock_residual_ms,
    )


def _cause_view(cause: schemas.HealthCause, station: schemas.StationHealth) -> CauseView:
    found = [
        (stream.stream, finding.message)
        for stream in station.streams
        if stream.stream in cause.streams
        for finding in stream.findings
        if finding.code in cause.findings
    ]
    by_stream = {name: [text for other, text in found if other == name] for name, _ in found}
    lines = [f"{name}: {' · '.join(texts)}" for name, texts in by_stream.items()]
    # What the message of the cause says already needs no second line.
    says_all = len(found) == 1 and found[0][1] in cause.message
    return CauseView(
        **cause.model_dump(include={"level", "message", "advice", "lasted_s", "streams"}),
        key=f"{cause.code} {cause.subject}",
        findings=() if says_all else tuple(lines),
    )


def _host_view(station: schemas.StationHealth) -> HostView:
    figures = station.figures
    levels = [
        *(cause.level for cause in station.causes if cause.code == "host"),
        *(finding.level for finding in station.findings if finding.code in HOST_FINDINGS),
    ]
    cpu_ratio, wake_s = figures.get("host_cpu_ratio"), figures.get("host_wake_p90_seconds")
    free_bytes = figures.get("disk_free_bytes")
    return HostView(
        level=_worst(levels),
        cpu_percent=None if cpu_ratio is None else 100 * cpu_ratio,
        wake_ms=None if wake_s is None else 1e3 * wake_s,
        disk_free_gb=None if free_bytes is None else free_bytes / 1e9,
        disk_left_s=figures.get("disk_left_seconds"),
    )


def _summary(streams: Sequence[StreamView], causes: Sequence[CauseView]) -> str:
    """How many streams are well, and for how many reasons others are not."""
    if not streams:
        return "no streams"
    num_ok = sum(stream.level == "OK" for stream in streams)
    words = f"{num_ok} of {len(streams)} streams OK"
    if not causes:
        return words
    return f"{'1 cause' if len(causes) == 1 else f'{len(causes)} causes'} · {words}"


# Where the last saved take is on its way: upload, store and alignment, in one line.

Stage = Literal["saved", "uploading", "refused", "stored", "aligning", "aligned", "failed"]


class TakeStateView(FrozenModel):
    """Stage of a take; `reason` says why it goes no further, or how far it is.

    `player` is the path of what can be played of it: nothing before it is stored.
    """

    recording_id: str
    player: str = ""
    stage: Stage
    level: schemas.HealthLevel = "OK"
    reason: str = ""


class _RefusedPart(FrozenModel):
    reason: str
    stream: str | None = None


class _Report(FrozenModel):
    episode_id: str = ""
    num_steps: int
    duration_s: float = 0.0
    refused_parts: tuple[_RefusedPart, ...] = ()


class _Job(FrozenModel):
    alignment_id: str
    state: Literal["waiting", "running", "done", "failed", "cancelled"]
    progress: float
    report: _Report | None = None
    problem: schemas.Problem | None = None


class _Jobs(FrozenModel):
    alignments: tuple[_Job, ...]


async def last_take(acquisition: Upstream, alignment: Upstream | None) -> TakeStateView | None:
    """State of the newest take that was saved at the station; None before the first one."""
    session = (await acquisition.read(schemas.RecorderStatus, "/v1/recorder")).session
    if session is None or session.last_saved is None:
        return None
    view = await _last_state(session.last_saved, acquisition, alignment)
    if not session.last_incomplete:
        return view
    reason = " · ".join(filter(None, (f"incomplete: {session.last_incomplete}", view.reason)))
    level: schemas.HealthLevel = "WARN" if view.level == "OK" else view.level
    return view.model_copy(update={"level": level, "reason": reason})


async def _last_state(
    recording_id: str, acquisition: Upstream, alignment: Upstream | None
) -> TakeStateView:
    try:
        upload = await acquisition.read(
            schemas.UploadStatus, f"/v1/uploads/{quote(recording_id, safe='')}"
        )
    except NotFoundError:
        # Stations that do not keep uploaded takes have removed it.
        upload = schemas.UploadStatus(recording_id=recording_id, uploaded=True)
    if upload.refused:
        return _view(recording_id, "refused", "ERROR", upload.error or "")
    if not upload.uploaded:
        if upload.error is None:
            return _view(recording_id, "uploading")
        return _view(recording_id, "saved", "WARN", upload.error)
    stored_as = upload.stored_as or recording_id
    view = await _aligned(recording_id, stored_as, alignment)
    return view if view.player else view.model_copy(update={"player": f"recording/{stored_as}"})


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
        episode_id = job.report.episode_id if job.report else ""
        played = {"player": f"episode/{episode_id}"} if episode_id else {}
        return _view(recording_id, "aligned", *_reported(job.report)).model_copy(update=played)
    if job.state in {"waiting", "running"}:
        share = f"{job.progress:.0%}" if job.state == "running" else "waits for its turn"
        return _view(recording_id, "aligning", reason=share)
    reason = job.problem.detail if job.problem else "alignment was cancelled"
    return _view(recording_id, "failed", "ERROR", reason or "no reason given")


def _reported(report: _Report | None) -> tuple[schemas.HealthLevel, str]:
    if report is None:
        return "OK", ""
    words = f"{report.duration_s:.1f} s, {report.num_steps} steps"
    if not report.refused_parts:
        return "OK", words
    causes = {
        f"{part.stream} {part.reason}"
        for part in report.refused_parts
        if part.reason in {"jump", "frozen", "limits"}
    }
    named = "".join(f"{cause}, " for cause in sorted(causes))
    words += f"; stretches left out: {len(report.refused_parts)} ({named}dextouch align report)"
    return "WARN", words


def _view(
    recording_id: str, stage: Stage, level: schemas.HealthLevel = "OK", reason: str = ""
) -> TakeStateView:
    return TakeStateView(recording_id=recording_id, stage=stage, level=level, reason=reason)
