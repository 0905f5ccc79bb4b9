"""The bodies of the station's routes but its health: what an operator sends, what it tells."""

from typing import Literal

from pydantic import Field

from dextouch.frozen_model import FrozenModel
from dextouch.schemas import Domain, StoreId

State = Literal["idle", "armed", "recording", "checking", "saved", "discarded"]
Action = Literal["arm", "record", "stop", "save", "discard", "rerecord"]


class TakePrompt(FrozenModel):
    """What is going to be recorded; given before the start."""

    task: str = Field(min_length=1, max_length=128)
    instruction: str = Field(min_length=1, max_length=2000)
    domain: Domain = "human"
    operator: str | None = Field(default=None, max_length=128)
    consent: bool = False


class TakeName(FrozenModel):
    """Which take an action is meant for; without an id, the present one.

    A request that names its take may be sent again: what was done is not done twice. `record` gives
    its take this id.
    """

    recording_id: StoreId | None = None


class SaveTake(TakeName):
    """How a take ended; an incomplete one is only saved when `accept_incomplete` says so."""

    success: bool | None = None
    accept_incomplete: bool = False


class TakeProblem(FrozenModel):
    """Something that the check after a take found in one stream."""

    stream: str
    code: str
    level: Literal["WARN", "ERROR"]
    message: str


class StreamTake(FrozenModel):
    """Summary of one stream in a take."""

    stream: str
    num_samples: int
    rate_hz: float | None
    largest_gap_s: float
    lost: int
    crc_errors: int


class TakeCheck(FrozenModel):
    """Whether a take is complete, found right after its end."""

    complete: bool
    duration_s: float
    streams: tuple[StreamTake, ...]
    problems: tuple[TakeProblem, ...]


class RecorderStatus(FrozenModel):
    """Current state of the recorder, and the actions that are possible."""

    state: State
    actions: tuple[Action, ...]
    recording_id: str | None = None
    prompt: TakePrompt | None = None
    duration_s: float | None = None
    num_samples: dict[str, int] = Field(default_factory=dict)
    problems: tuple[str, ...] = ()
    check: TakeCheck | None = None


class CameraLive(FrozenModel):
    """A camera whose newest image can be had."""

    name: str
    image_index: int
    age_s: float
    height_px: int
    width_px: int


class CameraList(FrozenModel):
    """Cameras that have sent an image."""

    cameras: tuple[CameraLive, ...]


class UploadStatus(FrozenModel):
    """One saved take and whether the store has it.

    `stored_as` is its id in the store, which differs where another recording had that id already. A
    `refused` take stays in the spool and is not sent again until a retry is requested.
    """

    recording_id: str
    uploaded: bool
    stored_as: str | None = None
    refused: bool = False
    error: str | None = None
