"""Bodies of a station's routes (recorder, live views, uploads, health), and of its enrolment."""

from operator import not_
from typing import Annotated, Literal

from pydantic import AwareDatetime, Field, FiniteFloat, SecretStr

from dextouch.free_text import FreeText
from dextouch.frozen_model import FrozenModel, example, is_none
from dextouch.schemas.common import MAX_INSTRUCTION, Domain, StoreId
from dextouch.tactile import LayoutDescription, LayoutText

RecorderState = Literal["idle", "armed", "recording", "checking", "saved", "discarded"]
RecorderAction = Literal["arm", "record", "stop", "save", "discard", "rerecord"]
HealthLevel = Literal["OK", "WARN", "ERROR", "STALE"]
StaleCode = Literal["unplugged", "silent"]
LinkKind = Literal["hub", "network", "bridge"]
TaxelState = Literal["dead", "stuck", "saturated", "drifting", "gone", "refused", "absent"]
# Why a robot's hand cannot follow a person's finger (docs/retargeting.md).
FollowCause = Literal["limit", "speed", "reach", "unseen"]
CauseCode = Literal["host", "hub", "network", "bridge", "gone", "clock", "device", "station"]
KEY_NAME_PATTERN = r"^[a-z][a-z0-9_-]{0,31}$"
KeyName = Annotated[str, Field(pattern=KEY_NAME_PATTERN)]
# Reason of the store's ConflictError for a take that was deleted: the station removes it.
TAKE_DELETED = "take_deleted"
# And for one that began after its operator was deleted, which a person has to judge.
OPERATOR_DELETED = "operator_deleted"
MAX_CHECKED_TAKES = 200
MAX_OPERATORS = 1000
StationName = Annotated[str, Field(min_length=1, max_length=128)]


class TakePrompt(FrozenModel):
    """What is going to be recorded; given before the start."""

    model_config = example(
        task="stand_bottle", instruction="Stand the bottle upright.", operator="p07", consent=True
    )

    task: FreeText = Field(min_length=1, max_length=128)
    instruction: FreeText = Field(min_length=1, max_length=MAX_INSTRUCTION)
    domain: Domain = "human"
    operator: FreeText | None = Field(default=None, max_length=128)
    consent: bool = False


class TakeName(FrozenModel):
    """Which take an action is meant for; without an id, the present one.

    A request that names its take may be sent again: what was done is not done twice. `record` gives
    its take this id.
    """

    model_config = example(recording_id="take-20260301-1")

    recording_id: StoreId | None = None


class SaveTake(TakeName):
    """How a take ended; an incomplete one is only saved when `accept_incomplete` says so."""

    model_config = example(recording_id="take-20260301-1", success=True)

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


class TakeCause(FrozenModel):
    """Root cause of the gravest problem of a take, and what to do about it."""

    message: str
    advice: str


class TakeCheck(FrozenModel):
    """Whether a take is complete, found right after its end; `cause` is None without problems."""

    complete: bool
    duration_s: float
    streams: tuple[StreamTake, ...]
    problems: tuple[TakeProblem, ...]
    cause: TakeCause | None = None


class SavedTakes(FrozenModel):
    """Number of takes of one task and operator that were saved in a session."""

    task: str
    operator: str | None = None
    num_saved: int = Field(ge=1)


class RecorderSession(FrozenModel):
    """Takes saved since an operator began a session; it outlives the station's process.

    `last_saved` is the id of the newest saved take, also of an earlier session, and
    `last_incomplete` why its check found it incomplete, empty if it did not.
    """

    started_at: AwareDatetime
    saved: tuple[SavedTakes, ...] = ()
    last_saved: str | None = None
    last_incomplete: str = Field(default="", exclude_if=not_)


class RecorderStatus(FrozenModel):
    """Current state of the recorder, and the actions that are possible.

    A station that `needs_consent` arms no take without an operator who agreed to be recorded.
    """

    state: RecorderState
    actions: tuple[RecorderAction, ...]
    recording_id: str | None = None
    prompt: TakePrompt | None = None
    duration_s: float | None = None
    num_samples: dict[str, int] = Field(default_factory=dict)
    problems: tuple[str, ...] = ()
    check: TakeCheck | None = None
    session: RecorderSession | None = None
    needs_consent: bool = Field(default=False, exclude_if=not_)


class CameraLive(FrozenModel):
    """A camera whose newest image can be had.

    `late_s` is how much later than at best it arrived, by the camera's own clock; None without one.
    """

    name: str
    image_index: int
    age_s: float
    late_s: float | None = None
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


class RaisedFinding(FrozenModel):
    """Something that is wrong now, since when, and what to do about it.

    `code` is one of the table in docs/health.md. `lasted_s` is None where nothing was ever heard of
    a stream.
    """

    code: str
    level: Literal["WARN", "ERROR", "STALE"]
    message: str
    advice: str
    lasted_s: float | None


class RobotFollowing(FrozenModel):
    """Whether the robot's hand can follow a tracked hand at this moment (docs/retargeting.md).

    WARN: not the `fingers`, by cause, and that for `lasted_s`; STALE: it is not checked. `message`
    says it in words.
    """

    level: HealthLevel
    message: str
    fingers: dict[str, FollowCause] = Field(default_factory=dict)
    lasted_s: float = 0.0


class StreamHealth(FrozenModel):
    """One stream at this moment; `lost` and `received` count its device's packets since start.

    `stale` says why nothing is known; it is the first of the findings then. `reasons` are their
    messages. `figures` are the numbers behind them by their Prometheus names, none while the stream
    is stale. Of a glove, `taxels` are those out of order by their state, in anatomical order
    (`dextouch.tactile.layout`), and `tare_age_s` is the age of its tare where the calibration says
    when it was made, and `layout` is that of its taxels, None of `dextouch_v1`. `following` is that
    of a tracked hand, where the station checks it.
    """

    stream: str
    device: str
    hand: Literal["left", "right"] | None = None
    level: HealthLevel
    stale: StaleCode | None = None
    reasons: tuple[str, ...]
    findings: tuple[RaisedFinding, ...] = ()
    figures: dict[str, FiniteFloat] = Field(default_factory=dict)
    rate_hz: float | None
    nominal_rate_hz: float
    age_s: float | None
    num_samples: int = 0
    received: int
    lost: int
    skew_ppm: float | None = None
    clock_residual_ms: float | None = None
    taxels: dict[TaxelState, tuple[int, ...]] = Field(default_factory=dict)
    tare_age_s: float | None = None
    layout: LayoutDescription | None = Field(default=None, exclude_if=is_none)
    following: RobotFollowing | None = None


class SharedLink(FrozenModel):
    """What a device shares with others on its way: a USB hub, a remote host, a local program."""

    kind: LinkKind
    name: str


class DeviceHealth(FrozenModel):
    """One device and its counters since the station's start.

    `simulated` devices are mocks in the station's process. `shares` is known where the device is
    open, or was.
    """

    device: str
    simulated: bool = False
    shares: SharedLink | None = None
    hand: Literal["left", "right"] | None = None
    connected: bool
    address: str
    packets: int
    lost: int
    crc_errors: int
    length_errors: int
    resync_bytes: int
    refused: int
    suspects: int = 0
    repeated: int = 0
    restarts: int = 0
    queue_dropped: int = 0
    reconnects: int
    failures: int = 0
    last_error: str | None


class HealthCause(FrozenModel):
    """A root cause with the one advice for all that it explains.

    `code` is one of the causes in docs/health.md, `subject` the hub, host, program or device, or
    the code of the station's finding. `findings` are the codes explained, `streams` those affected.
    """

    code: CauseCode
    subject: str
    level: HealthLevel
    message: str
    advice: str
    lasted_s: float | None
    streams: tuple[str, ...] = ()
    findings: tuple[str, ...] = ()


class PracticeStatus(FrozenModel):
    """Whether a station simulates devices to practise calibration with, below `/practice`.

    Stations of real devices have none (`unavailable`).
    """

    state: Literal["unavailable", "off", "on"]


# What a simulated station does on request, for operators to see: its glove, and the whole station.
SimulatedFault = Literal["unplug", "drift", "dead_taxel", "slow_host"]


class SetFault(FrozenModel):
    """Whether a fault is simulated from now on."""

    model_config = example(on=True)

    on: bool


class StationHealth(FrozenModel):
    """All streams and devices; `level` is the worst of the streams and of `findings`.

    `findings` and `figures` are those of the station itself: disk, calibration and uploads.
    `causes` explain the findings of station and streams, widest and gravest first. `faults` are
    those that a simulated station shows on request, None of real devices.
    """

    station: str
    level: HealthLevel
    causes: tuple[HealthCause, ...] = ()
    findings: tuple[RaisedFinding, ...] = ()
    figures: dict[str, FiniteFloat] = Field(default_factory=dict)
    streams: tuple[StreamHealth, ...]
    devices: tuple[DeviceHealth, ...]
    faults: tuple[SimulatedFault, ...] | None = Field(default=None, exclude_if=is_none)


class StationOverview(FrozenModel):
    """A station in a few values.

    `cause` is the widest cause of its level and `advice` what to do about it, `age_s` the age of
    the newest sample of any stream. `layouts` are those of its gloves by hand, where they are not
    `dextouch_v1`; in messages each is one JSON text.
    """

    station: str
    level: HealthLevel
    cause: str
    advice: str = ""
    recorder: RecorderState
    task: str | None = None
    duration_s: float | None = None
    age_s: float | None = None
    disk_left_s: float | None = None
    disk_free_bytes: float | None = None
    cameras: tuple[CameraLive, ...] = ()
    layouts: dict[str, LayoutText] = Field(default={}, exclude_if=not_)


class HealthEvent(FrozenModel):
    """A code of a stream (or of the `station`) reached a level; OK is its end."""

    t_host_ns: int
    stream: str
    code: str
    level: HealthLevel


class HealthEvents(FrozenModel):
    """Changes of levels, oldest first, and the station's clock now."""

    now_ns: int
    events: tuple[HealthEvent, ...]


class TakeSpan(FrozenModel):
    """When a take ran, on the station's clock; `stop_ns` is None while it runs."""

    recording_id: str
    start_ns: int
    stop_ns: int | None = None


class HealthHistory(FrozenModel):
    """Health of the newest hour, about a row a second; null where a value is unknown.

    `station` has a list of rows for each of `station_series`, `streams` for each stream and each of
    `stream_series`. Times are on the station's clock, which shows `now_ns` when its wall clock
    shows `now_unix_s`.
    """

    now_ns: int
    now_unix_s: float
    takes: tuple[TakeSpan, ...]
    nominal_rate_hz: dict[str, float]
    station_series: tuple[str, ...]
    stream_series: tuple[str, ...]
    t_ns: tuple[int, ...] = ()
    station: tuple[tuple[float | None, ...], ...] = ()
    streams: dict[str, tuple[tuple[float | None, ...], ...]] = Field(default_factory=dict)


class EnrolStation(FrozenModel):
    """Request for a token; the station's key will have the station's name.

    Attributes:
        renew: for a station that has a key, which stays valid beside the new one.
    """

    model_config = example(station="bench-1")

    station: KeyName
    renew: bool = False


class EnrolmentToken(FrozenModel):
    """A one-time token, which is shown in this response only."""

    station: KeyName
    token: str
    expires_at: AwareDatetime


class UseToken(FrozenModel):
    """A station's request for a key."""

    model_config = example(token="…")  # noqa: S106 - an example

    token: SecretStr = Field(max_length=256)


class StationKey(FrozenModel):
    """The key of a station, which is shown in this response only."""

    station: KeyName
    key: str


class StationEnrolment(FrozenModel):
    """One enrolment of a station: who asked for it, when its token was used, who revoked its key.

    `requested_by` and `revoked_by` are names of keys, `enrolled_from` is an address.
    """

    station: KeyName
    state: Literal["waiting", "expired", "enrolled", "revoked"]
    requested_at: AwareDatetime
    requested_by: str
    expires_at: AwareDatetime
    enrolled_at: AwareDatetime | None = None
    enrolled_from: str = ""
    revoked_at: AwareDatetime | None = None
    revoked_by: str = ""


class StationEnrolments(FrozenModel):
    """All enrolments, newest first; `needs_key` is false where uploads need no key."""

    enrolments: tuple[StationEnrolment, ...]
    needs_key: bool


class SpooledTake(FrozenModel):
    """A take in a station's spool, with the ids under which the store has or would have it.

    Of damaged takes nothing but ids is known.
    """

    recording_id: str
    stored_as: Annotated[tuple[str, ...], Field(max_length=2)] = ()
    operator: str | None = None
    started_at: AwareDatetime | None = None
    started_t_host_ns: int | None = None
    is_damaged: bool = False


class CheckTakes(FrozenModel):
    """A part of a station's spool, and all operators that its session names."""

    model_config = example(
        station="bench-1", takes=[{"recording_id": "take-20260301-1", "operator": "p07"}]
    )

    station: StationName
    takes: Annotated[tuple[SpooledTake, ...], Field(max_length=MAX_CHECKED_TAKES)] = ()
    operators: Annotated[tuple[str, ...], Field(max_length=MAX_OPERATORS)] = ()


class PendingDeletion(FrozenModel):
    """A take that has to be removed, and the deletion that says so."""

    recording_id: str
    deletion: str


class CheckedTakes(FrozenModel):
    """Takes to remove and operators to forget; `revision` is that of the deletions."""

    revision: str
    takes: tuple[PendingDeletion, ...] = ()
    operators: tuple[str, ...] = ()


class DeletionsRevision(FrozenModel):
    """Changes with every deletion."""

    revision: str


class ConfirmRemoval(FrozenModel):
    """A station has worked off all deletions of a revision, except the takes it still holds."""

    model_config = example(station="bench-1", revision="12")

    station: StationName
    revision: str
    held: Annotated[tuple[PendingDeletion, ...], Field(max_length=MAX_CHECKED_TAKES)] = ()


class OutstandingTakes(FrozenModel):
    """Takes of a deletion that a station still holds, or has not yet said that it does not.

    `has_answered` is False where the station did not ask since the deletion: then `recordings` are
    those that the store had of it, and the spool may hold takes that were never uploaded.
    """

    station: str
    recordings: tuple[str, ...]
    has_answered: bool


class DeletionStatus(FrozenModel):
    """A deletion and what is outstanding of it; `key` is the same for the same request."""

    key: str
    deleted_at: AwareDatetime
    is_of_operator: bool
    num_recordings: int
    outstanding: tuple[OutstandingTakes, ...]


class Deletions(FrozenModel):
    """All deletions that the store remembers, oldest first."""

    deletions: tuple[DeletionStatus, ...]
