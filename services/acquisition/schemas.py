"""The bodies of the station's routes: what an operator sends, what the station tells."""

from typing import Literal

from pydantic import BaseModel, ConfigDict, Field

from dextouch.schemas.episodes import Domain

Level = Literal["OK", "WARN", "ERROR", "STALE"]
State = Literal["idle", "armed", "recording", "checking", "saved", "discarded"]
Action = Literal["arm", "record", "stop", "save", "discard"]


class TakePrompt(BaseModel):
    """What is going to be recorded; given before the start."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    task: str = Field(min_length=1, max_length=128)
    instruction: str = Field(min_length=1, max_length=2000)
    domain: Domain = "human"
    operator: str | None = Field(default=None, max_length=128)
    consent: bool = False


class SaveTake(BaseModel):
    """How a take ended; an incomplete one is only saved when `accept_incomplete` says so."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    success: bool | None = None
    accept_incomplete: bool = False


class TakeProblem(BaseModel):
    """Something that the check after a take found in one stream."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    stream: str
    code: str
    level: Literal["WARN", "ERROR"]
    message: str


class StreamTake(BaseModel):
    """What a take holds of one stream."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    stream: str
    num_samples: int
    rate_hz: float | None
    largest_gap_s: float
    lost: int
    crc_errors: int


class TakeCheck(BaseModel):
    """Whether a take is complete, found right after its end."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    complete: bool
    duration_s: float
    streams: tuple[StreamTake, ...]
    problems: tuple[TakeProblem, ...]


class RecorderStatus(BaseModel):
    """Where the recorder stands, and which actions it would take now."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    state: State
    actions: tuple[Action, ...]
    recording_id: str | None = None
    prompt: TakePrompt | None = None
    duration_s: float | None = None
    num_samples: dict[str, int] = {}
    problems: tuple[str, ...] = ()
    check: TakeCheck | None = None


class StreamHealth(BaseModel):
    """One stream at this moment; `lost` and `received` count its device's packets since start."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    stream: str
    device: str
    level: Level
    reasons: tuple[str, ...]
    rate_hz: float | None
    nominal_rate_hz: float
    age_s: float | None
    received: int
    lost: int


class DeviceHealth(BaseModel):
    """One device and its counters since the station's start."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    device: str
    connected: bool
    address: str
    packets: int
    lost: int
    crc_errors: int
    length_errors: int
    resync_bytes: int
    refused: int
    reconnects: int
    last_error: str | None


class StationHealth(BaseModel):
    """All streams and devices; `level` is the worst of the streams."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    station: str
    level: Level
    streams: tuple[StreamHealth, ...]
    devices: tuple[DeviceHealth, ...]


class CameraLive(BaseModel):
    """A camera whose newest image can be had."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    name: str
    image_index: int
    age_s: float
    height_px: int
    width_px: int


class CameraList(BaseModel):
    """Cameras that have sent an image."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    cameras: tuple[CameraLive, ...]


class UploadStatus(BaseModel):
    """One saved take and whether the store has it."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    recording_id: str
    uploaded: bool
    error: str | None = None
