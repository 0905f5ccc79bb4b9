"""Client side of the acquisition API: parses its responses and converts them to views."""

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
    """Base of response models; unknown fields are ignored."""

    model_config = ConfigDict(frozen=True, extra="ignore")


class HealthFinding(_Answer):
    """A problem of a stream or of the station (disk, calibration)."""

    level: Level
    message: str
    advice: str = ""
    lasted_s: float | None = None


class StreamHealth(_Answer):
    """Health of a stream; clock figures only if a clock is fitted."""

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
    """Health of a device."""

    device: str
    reconnects: int = 0
    suspects: int = 0
    last_error: str | None = None


class StationHealth(_Answer):
    """Health of all streams and devices, and problems of the station."""

    findings: tuple[HealthFinding, ...] = ()
    streams: tuple[StreamHealth, ...]
    devices: tuple[DeviceHealth, ...] = ()


class TakeProblem(_Answer):
    """A problem found by the check after a take."""

    level: str
    message: str


class TakeCheck(_Answer):
    """Result of the check after a take."""

    complete: bool
    problems: tuple[TakeProblem, ...] = ()


class RecorderStatus(_Answer):
    """State of the recorder."""

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
    """Path of a recorder action.

    Raises:
        UnknownNameError: no such action.
    """
    if action not in ALL_ACTIONS:
        raise UnknownNameError("recorder action", action, list(ALL_ACTIONS))
    return f"{RECORDER_PATH}/{action}"


def camera_path(name: str) -> str:
    """Path of the newest image of a camera."""
    return f"{CAMERAS_PATH}/{name}"


def station_view(health: object, recorder: object) -> StationView:
    """Build the station view from the responses of HEALTH_PATH and RECORDER_PATH.

    Raises:
        UnavailableError: responses of an unknown form.
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
    """Build the recorder view from its response."""
    recorder = _read(RecorderStatus, answer)
    check = recorder.check
    found = sorted(check.problems, key=lambda problem: problem.level) if check else []
    # Findings of the check are repeated among the problems: list each once. ERROR sorts before
    # WARN.
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
    """Path for uploading a refused take again."""
    return f"/v1/uploads/{quote(recording_id, safe='')}/retry"


def refused_views(answer: object) -> tuple[RefusedView, ...]:
    """Build the views of refused takes from the response of REFUSED_PATH."""
    return _read(RefusedList, answer).root


def camera_views(answer: object) -> list[CameraView]:
    """Build the camera views from the response of CAMERAS_PATH."""
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
    """Number of streams at each level, and the devices with problems."""
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
            f"acquisition: unexpected response ({error.error_count()} invalid fields)"
        ) from error
