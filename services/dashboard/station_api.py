"""The acquisition service's answers in, the station as the page shows it out."""

from typing import TypeVar

from pydantic import BaseModel, ConfigDict, ValidationError

from dextouch.errors import UnavailableError, UnknownNameError
from services.dashboard.views import (
    CameraView,
    Level,
    RecorderView,
    StationView,
    StreamView,
    worst,
)

HEALTH_PATH = "/v1/health"
RECORDER_PATH = "/v1/recorder"
TAXELS_PATH = "/v1/live/taxels"
CAMERAS_PATH = "/v1/live/cameras"

ALL_ACTIONS = ("arm", "record", "stop", "save", "discard")

ModelT = TypeVar("ModelT", bound=BaseModel)


class _Answer(BaseModel):
    """Fields the page does not know are none of its business."""

    model_config = ConfigDict(frozen=True, extra="ignore")


class StreamHealth(_Answer):
    """One stream as acquisition judges it; clock figures only where a clock is being fitted."""

    stream: str
    level: Level
    reasons: tuple[str, ...] = ()
    rate_hz: float | None = None
    nominal_rate_hz: float | None = None
    age_s: float | None = None
    drop_ratio: float | None = None
    skew_ppm: float | None = None
    clock_residual_ms: float | None = None


class DeviceHealth(_Answer):
    """One device with its streams."""

    device: str
    level: Level
    lost: int | None = None
    reconnects: int = 0
    dead_taxels: int = 0
    last_error: str | None = None
    streams: tuple[StreamHealth, ...] = ()


class StationHealth(_Answer):
    """All devices."""

    devices: tuple[DeviceHealth, ...]


class TakeProblem(_Answer):
    """Something found in a take right after its end."""

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
    elapsed_s: float | None = None
    failure: str | None = None
    check: TakeCheck | None = None


class CameraLive(_Answer):
    """A camera whose newest image can be had."""

    name: str
    sequence: int
    age_s: float | None = None


class CameraList(_Answer):
    """Cameras that have sent an image."""

    cameras: tuple[CameraLive, ...]


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
    devices = _read(StationHealth, health).devices
    streams = tuple(_stream_view(device, item) for device in devices for item in device.streams)
    levels = [stream.level for stream in streams]
    return StationView(
        reachable=True,
        level=worst(levels),
        summary=_summary(levels),
        note="" if streams else "No devices are connected.",
        streams=streams,
        recorder=recorder_view(recorder),
    )


def recorder_view(answer: object) -> RecorderView:
    """The recorder from its own answer."""
    recorder = _read(RecorderStatus, answer)
    complete = recorder.check is None or recorder.check.complete
    words = [recorder.failure] if recorder.failure else []
    if recorder.check is not None:
        words += [problem.message for problem in recorder.check.problems]
        words += [] if words else ["complete"]
    named = [recorder.recording_id] if recorder.recording_id else []
    return RecorderView(
        state=recorder.state,
        actions=recorder.actions,
        elapsed_s=recorder.elapsed_s,
        level="ERROR" if recorder.failure else "OK" if complete else "WARN",
        complete=complete,
        note=" · ".join([*named, *words]),
    )


def camera_views(answer: object) -> list[CameraView]:
    """The cameras from the answer at CAMERAS_PATH."""
    return [
        CameraView(name=camera.name, image_index=camera.sequence, age_s=camera.age_s)
        for camera in _read(CameraList, answer).cameras
    ]


def _stream_view(device: DeviceHealth, item: StreamHealth) -> StreamView:
    words = list(item.reasons)
    if device.reconnects:
        words.append(f"{device.reconnects} reconnects")
    if device.dead_taxels:
        words.append(f"{device.dead_taxels} dead taxels")
    if device.last_error and item.level in {"ERROR", "STALE"}:
        words.append(device.last_error)
    return StreamView(
        name=item.stream,
        level=item.level,
        message=" · ".join(words),
        rate_hz=item.rate_hz,
        nominal_rate_hz=item.nominal_rate_hz,
        dropped=device.lost,
        drop_percent=None if item.drop_ratio is None else 100 * item.drop_ratio,
        age_s=item.age_s,
        skew_ppm=item.skew_ppm,
        clock_error_ms=item.clock_residual_ms,
    )


def _summary(levels: list[Level]) -> str:
    counts = [(level, levels.count(level)) for level in ("ERROR", "STALE", "WARN", "OK")]
    return " · ".join(f"{count} {level}" for level, count in counts if count) or "no streams"


def _read(model: type[ModelT], answer: object) -> ModelT:
    try:
        return model.model_validate(answer)
    except ValidationError as error:
        raise UnavailableError(
            f"acquisition: an answer of an unknown form ({error.error_count()} fields do not fit)"
        ) from error
