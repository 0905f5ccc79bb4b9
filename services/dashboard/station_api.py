"""The acquisition service's answers in, the station as the page shows it out."""

from collections.abc import Sequence
from typing import TypeVar
from urllib.parse import quote

from pydantic import BaseModel, ConfigDict, RootModel, ValidationError

from dextouch.errors import UnavailableError, UnknownNameError
from services.dashboard.views import (
    CameraView,
    Level,
    PromptView,
    RecorderView,
    RefusedView,
    StationView,
    StreamView,
    worst,
)

HEALTH_PATH = "/v1/health"
RECORDER_PATH = "/v1/recorder"
REFUSED_PATH = "/v1/uploads?refused=true"
TAXELS_PATH = "/v1/live/taxels"
CAMERAS_PATH = "/v1/live/cameras"

ALL_ACTIONS = ("arm", "record", "stop", "save", "discard", "rerecord")

ModelT = TypeVar("ModelT", bound=BaseModel)


class _Answer(BaseModel):
    """Fields the page does not know are none of its business."""

    model_config = ConfigDict(frozen=True, extra="ignore")


class HealthFinding(_Answer):
    """Something wrong with a stream, or with the station itself: its disk, its calibration."""

    level: Level
    message: str
    advice: str = ""
    lasted_s: float | None = None


class StreamHealth(_Answer):
    """One stream as acquisition judges it; clock figures only where a clock is being fitted."""

    stream: str
    device: str
    level: Level
    findings: tuple[HealthFinding, ...] = ()
    rate_hz: float | None = None
    nominal_rate_hz: float | None = None
    age_s: float | None = None
    received: int | None = None
    lost: int | None = None
    skew_ppm: float | None = None
    clock_residual_ms: float | None = None


class DeviceHealth(_Answer):
    """One device."""

    device: str
    reconnects: int = 0
    suspects: int = 0
    last_error: str | None = None


class StationHealth(_Answer):
    """All streams and devices, and what is wrong with the station itself."""

    findings: tuple[HealthFinding, ...] = ()
    streams: tuple[StreamHealth, ...]
    devices: tuple[DeviceHealth, ...] = ()


class TakeProblem(_Answer):
    """Something found in a take right after its end."""

    level: str
    message: str


class TakeCheck(_Answer):
    """Whether a take is complete."""

    complete: bool
    problems: tuple[TakeProblem, ...] = ()


class RecorderStatus(_Answer):
    """Where the recorder stands."""

    state: str
    actions: tuple[str, ...]
    recording_id: str | None = None
    prompt: PromptView | None = None
    duration_s: float | None = None
    problems: tuple[str, ...] = ()
    check: TakeCheck | None = None


class RefusedList(RootModel[tuple[RefusedView, ...]]):
    """Takes that the store refused."""


class CameraList(_Answer):
    """Cameras that have sent an image."""

    cameras: tuple[CameraView, ...]


def action_path(action: str) -> str:
    """Where an action is asked for.

    Raises:
        UnknownNameError: no action of the recorder.
    """
    if action not in ALL_ACTIONS:
        raise UnknownNameError("recorder action", action, list(ALL_ACTIONS))
    return f"{RECORDER_PATH}/{action}"


def camera_path(name: str) -> str:
    """Where the newest image of a camera is."""
    return f"{CAMERAS_PATH}/{name}"


def station_view(health: object, recorder: object) -> StationView:
    """The station from the answers at HEALTH_PATH and RECORDER_PATH.

    Raises:
        UnavailableError: answers in a form this version does not know.
    """
    station = _read(StationHealth, health)
    devices = {device.device: device for device in station.devices}
    streams = tuple(_stream_view(item, devices.get(item.device)) for item in station.streams)
    found = [finding.level for finding in station.findings]
    notes = [f"{finding.message} → {finding.advice}" for finding in station.findings]
    if not streams:
        found, notes = ["STALE", *found], ["No devices are connected.", *notes]
    return StationView(
        reachable=True,
        level=worst([*(stream.level for stream in streams), *found]),
        summary=_summary(streams),
        note=" · ".join(notes),
        note_level=worst(found) if found else "OK",
        streams=streams,
        recorder=recorder_view(recorder),
    )


def recorder_view(answer: object) -> RecorderView:
    """The recorder from its own answer."""
    recorder = _read(RecorderStatus, answer)
    check = recorder.check
    found = sorted(check.problems, key=lambda problem: problem.level) if check else []
    # What the check found is also among the problems: say it once. ERROR sorts before WARN.
    checked = [problem.message for problem in found]
    own = [message for message in recorder.problems if message not in checked]
    problems = tuple(dict.fromkeys([*own, *checked]))
    complete = check is None or check.complete
    level: Level = "OK"
    if problems:
        level = "WARN" if complete else "ERROR"
    words = [recorder.recording_id] if recorder.recording_id else []
    if check is not None:
        words.append("complete" if complete else "incomplete")
    if problems:
        words.append("1 finding" if len(problems) == 1 else f"{len(problems)} findings")
    return RecorderView(
        state=recorder.state,
        actions=recorder.actions,
        recording_id=recorder.recording_id,
        prompt=recorder.prompt,
        elapsed_s=recorder.duration_s,
        level=level,
        complete=complete,
        note=" · ".join(words),
        problems=problems,
    )


def retry_path(recording_id: str) -> str:
    """Where a take is sent again."""
    return f"/v1/uploads/{quote(recording_id, safe='')}/retry"


def refused_views(answer: object) -> tuple[RefusedView, ...]:
    """The takes that the store refused from the answer at REFUSED_PATH."""
    return _read(RefusedList, answer).root


def camera_views(answer: object) -> list[CameraView]:
    """The cameras from the answer at CAMERAS_PATH."""
    return list(_read(CameraList, answer).cameras)


def _stream_view(item: StreamHealth, device: DeviceHealth | None) -> StreamView:
    words = [finding.message for finding in item.findings]
    first = item.findings[0] if item.findings else None
    if device is not None and device.reconnects:
        words.append(f"{device.reconnects} reconnects")
    if device is not None and device.suspects:
        words.append(f"{device.suspects} packets held back")
    if device is not None and device.last_error and item.level in {"ERROR", "STALE"}:
        words.append(device.last_error)
    offered = (item.received or 0) + (item.lost or 0)
    return StreamView(
        name=item.stream,
        device=item.device,
        level=item.level,
        message=" · ".join(dict.fromkeys(words)),
        advice=first.advice if first is not None else "",
        lasted_s=first.lasted_s if first is not None else None,
        rate_hz=item.rate_hz,
        nominal_rate_hz=item.nominal_rate_hz,
        dropped=item.lost,
        drop_percent=None if item.lost is None or not offered else 100 * item.lost / offered,
        age_s=item.age_s,
        skew_ppm=item.skew_ppm,
        clock_error_ms=item.clock_residual_ms,
    )


def _summary(streams: Sequence[StreamView]) -> str:
    """How many streams are at each level, and which devices are in trouble."""
    parts = []
    for level in ("ERROR", "STALE", "WARN", "OK"):
        devices = [stream.device for stream in streams if stream.level == level]
        names = "" if level == "OK" else f" ({', '.join(dict.fromkeys(devices))})"
        if devices:
            parts.append(f"{len(devices)} {level}{names}")
    return " · ".join(parts) or "no streams"


def _read(model: type[ModelT], answer: object) -> ModelT:
    try:
        return model.model_validate(answer)
    except ValidationError as error:
        raise UnavailableError(
            f"acquisition: an answer of an unknown form ({error.error_count()} fields do not fit)"
        ) from error
