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

# What an operator may do in each state of the recorder.
ACTIONS: dict[str, tuple[str, ...]] = {
    "idle": ("arm",),
    "armed": ("record", "discard"),
    "recording": ("stop", "discard"),
    "checking": ("save", "discard"),
    "saved": ("arm",),
    "discarded": ("arm",),
}
ALL_ACTIONS = ("arm", "record", "stop", "save", "discard")

ModelT = TypeVar("ModelT", bound=BaseModel)


class _Answer(BaseModel):
    """Fields the page does not know are none of its business."""

    model_config = ConfigDict(frozen=True, extra="ignore")


class StreamHealth(_Answer):
    """Health of one stream as acquisition tells it."""

    stream: str
    level: Level
    reasons: tuple[str, ...] = ()
    rate_hz: float | None = None
    nominal_rate_hz: float | None = None
    lost: int | None = None
    received: int | None = None
    age_s: float | None = None
    skew_ppm: float | None = None
    clock_residual_ms: float | None = None


class StationHealth(_Answer):
    """Health of all streams."""

    streams: tuple[StreamHealth, ...]


class RecorderState(_Answer):
    """Where the recorder stands."""

    state: str
    duration_s: float | None = None
    problems: tuple[str, ...] = ()
    recording_id: str | None = None


class CameraList(_Answer):
    """Cameras with a newest image."""

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
    streams = tuple(_stream_view(item) for item in _read(StationHealth, health).streams)
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
    recorder = _read(RecorderState, answer)
    level: Level = "WARN" if recorder.problems else "OK"
    named = f"{recorder.recording_id}: " if recorder.recording_id else ""
    note = named + "; ".join(recorder.problems) if recorder.problems else recorder.recording_id
    return RecorderView(
        state=recorder.state,
        actions=ACTIONS.get(recorder.state, ()),
        elapsed_s=recorder.duration_s,
        level=level,
        note=note or "",
    )


def camera_views(answer: object) -> list[CameraView]:
    """The cameras from the answer at CAMERAS_PATH."""
    return list(_read(CameraList, answer).cameras)


def _stream_view(item: StreamHealth) -> StreamView:
    offered = (item.received or 0) + (item.lost or 0)
    percent = None if item.lost is None or offered == 0 else 100 * item.lost / offered
    return StreamView(
        name=item.stream,
        level=item.level,
        message="; ".join(item.reasons),
        rate_hz=item.rate_hz,
        nominal_rate_hz=item.nominal_rate_hz,
        dropped=item.lost,
        drop_percent=percent,
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
