"""Schemas of episodes and recordings: attributes, lineage, clock reports, catalog and uploads."""

from operator import not_
from typing import Annotated, Any, Final, Literal

import numpy as np
from jaxtyping import Float64
from pydantic import AwareDatetime, BaseModel, Field, FiniteFloat, field_validator, model_validator

from dextouch.errors import InvalidInputError
from dextouch.free_text import check_texts
from dextouch.frozen_model import FrozenModel, example
from dextouch.geometry import Distortion, distortion_of, rigid_error
from dextouch.hands.actions import AnchorPoses
from dextouch.schemas.common import (
    MAX_INSTRUCTION,
    Box,
    ClockMethod,
    ClockWarning,
    Domain,
    Matrix,
    NonNegativeFinite,
    Origin,
    StoreId,
    TraceId,
)
from dextouch.streams import StreamDescriptor

FORMAT_VERSION: Final = 1
# What a recording and the episodes made of it say under the same names.
SHARED_ATTRIBUTES: Final = (
    "task", "instruction", "domain", "station", "operator", "trace_id", "success", "recovered",
    "complete", "incomplete_cause",
)  # fmt: skip
# Characters of the reason why a take is incomplete.
MAX_CAUSE = 500
# Characters of the parameters of an edit: room for an instruction and a task of apostrophes alone,
# for each of which a shell needs five.
MAX_OPERATION = 12_000
RIGID_TOLERANCE: Final = 1e-6
# Reason of the store's ConflictError when another recording has the id.
ID_TAKEN = "id_taken"
# Uploads that were idle for less are never dropped. Chosen: a living station pauses for at most a
# request without an answer and a Retry-After, 30 s each; this is ten times as long.
MIN_EXPIRE_IDLE_S = 600.0


def matrix_rows(matrix: np.ndarray) -> Matrix:
    """Convert a two-dimensional array to nested tuples, as stored in attributes."""
    return tuple(tuple(float(value) for value in row) for row in np.asarray(matrix))


def _check_matrix(rows: Matrix, shape: tuple[int, int]) -> Matrix:
    got = (len(rows), *{len(row) for row in rows})
    if got != shape:
        raise ValueError(f"got a matrix of rows and columns {got}, expected {shape}")
    return rows


class StoredAnchor(FrozenModel):
    """Absolute poses of step 0, the anchor of an episode's actions, as 4×4 matrices."""

    T_world_wrist_left: Matrix
    T_world_wrist_right: Matrix
    T_world_camera_head: Matrix

    @field_validator("*")
    @classmethod
    def _is_rigid(cls, rows: Matrix) -> Matrix:
        if rigid_error(np.array(_check_matrix(rows, (4, 4)))) > RIGID_TOLERANCE:
            raise ValueError("expected a rigid transform: a rotation and the last row 0 0 0 1")
        return rows

    @classmethod
    def from_poses(cls, anchor: AnchorPoses) -> "StoredAnchor":
        """The stored form of an anchor."""
        return cls(**{name: matrix_rows(T) for name, T in vars(anchor).items()})

    def to_poses(self) -> AnchorPoses:
        """The anchor as arrays."""
        return AnchorPoses(**{name: np.array(rows) for name, rows in self})


# The operation of a copy that a merge of stores gave a new id.
MERGED: Final = "merge --rename"


class LineageEntry(FrozenModel):
    """A source of derived data, by id and content hash.

    `operation` of an edited item is the edit of this source, with its parameters, as on the command
    line (`trim --steps 15 90`); empty of all other data, and then not written.
    """

    kind: Literal["recording", "episode", "checkpoint", "rollout"]
    id: str
    sha256: str | None = Field(default=None, pattern=r"^[0-9a-f]{64}$")
    operation: str = Field(default="", max_length=MAX_OPERATION, exclude_if=not_)

    def is_of(self, sha256: str | None) -> bool:
        """Whether an item of this kind and id is the source, by its hash, if both are known."""
        return self.sha256 is None or sha256 in {None, self.sha256}

    @property
    def is_edit(self) -> bool:
        """Whether this source was edited, not merely copied under a new id."""
        return self.operation not in {"", MERGED}


class ClockReport(FrozenModel):
    """Quality of the clock fit of one stream against the reference clock.

    `method` is the source of the time stamps, None where unknown. `latency_ms` is the constant path
    delay that was subtracted; `latency_sigma_ms` its standard deviation, None where not measured.
    `num_steps` counts jumps and stops of the device's clock, where the fit was split; `warnings`
    are reasons to doubt the times.
    """

    stream: str
    method: ClockMethod | None = None
    skew_ppm: FiniteFloat | None = None
    latency_ms: FiniteFloat | None = None
    latency_sigma_ms: FiniteFloat | None = Field(default=None, ge=0)
    residual_rms_ms: FiniteFloat | None = None
    num_samples: int = Field(ge=0)
    num_dropped: int = Field(default=0, ge=0)
    num_steps: int = Field(default=0, ge=0)
    warnings: tuple[ClockWarning, ...] = ()


class EpisodeAttributes(FrozenModel):
    """Metadata of an episode.

    `anchor` and `K_head` (pixels, None if unknown) belong to step 0. `absent` are parts of the
    action that no step has: streams, or fingers that were never seen (`ring_left`); their columns
    are those of a hand at rest at the origin of the world. `streams` is completed by the writer;
    `calibration` holds named matrices such as `T_tracker_left_wrist_left`; `quality` named figures;
    `recovered` marks an episode of an interrupted take, or of the intact samples of a damaged one.
    `object_boxes_m` has one box per object, centre and half sizes in the object's own frame.
    `event_times_s` is the time at which each milestone of the task was first reached, in seconds
    from step 0; milestones never reached are absent. `trace_id` is that of the recording, or of
    the client that ran the rollout. If empty, these three are not written, so that older releases
    can read the episode; nor are `complete` and `incomplete_cause` unless the recording was
    incomplete.
    """

    format_version: Literal[1] = FORMAT_VERSION
    episode_id: StoreId
    task: str = Field(min_length=1, max_length=128)
    instruction: str = Field(max_length=MAX_INSTRUCTION)
    domain: Domain
    origin: Origin
    station: str | None = Field(default=None, min_length=1, max_length=128)
    operator: str | None = None
    seed: int | None = None
    model_rate_hz: FiniteFloat = Field(default=15.0, gt=0)
    anchor: StoredAnchor
    K_head: Matrix | None = None
    absent: tuple[str, ...] = Field(default=(), exclude_if=not_)
    success: bool | None = None
    recovered: bool = False
    complete: bool = Field(default=True, exclude_if=bool)
    incomplete_cause: str = Field(default="", max_length=MAX_CAUSE, exclude_if=not_)
    generator_command: str | None = None
    lineage: tuple[LineageEntry, ...] = ()
    object_names: tuple[str, ...] = ()
    object_boxes_m: tuple[Box, ...] = Field(default=(), exclude_if=not_)
    event_times_s: dict[str, NonNegativeFinite] = Field(default={}, exclude_if=not_)
    calibration: dict[str, Matrix] = Field(default={})
    clocks: tuple[ClockReport, ...] = ()
    quality: dict[str, FiniteFloat] = Field(default={})
    created_at: AwareDatetime | None = None
    trace_id: TraceId | None = Field(default=None, exclude_if=not_)
    streams: tuple[StreamDescriptor, ...] = ()

    @field_validator("K_head")
    @classmethod
    def _is_camera_matrix(cls, rows: Matrix | None) -> Matrix | None:
        return None if rows is None else _check_matrix(rows, (3, 3))

    def head_distortion(self) -> Distortion:
        """Distortion of the head camera's lens, k1 k2 p1 p2 k3; zeros where none is known."""
        return distortion_of(self.calibration, "head")

    def matrices(self) -> dict[str, Matrix]:
        """The calibration, with `K_head` if it is known."""
        return self.calibration | ({} if self.K_head is None else {"K_head": self.K_head})

    def K_head_matrix(self) -> Float64[np.ndarray, "3 3"]:  # noqa: N802 (K is the camera matrix)
        """The head camera's matrix in pixels; raises InvalidInputError if it is not known."""
        if self.K_head is None:
            raise InvalidInputError(
                f"episode {self.episode_id!r}: the matrix K_head of its head camera is not known; "
                "calibrate the camera (`dextouch station calibrate camera`), and record again"
            )
        return np.array(self.K_head)


def is_rollout(attributes: EpisodeAttributes) -> bool:
    """Whether an episode is a rollout over the API, which notes no milestones."""
    return any(entry.kind == "rollout" for entry in attributes.lineage)


class EpisodeSummary(FrozenModel):
    """One row of the catalog.

    `duration_s` is that of the model grid, or of the longest stream; an empty `lineage` is not
    written.
    """

    episode_id: StoreId
    task: str
    domain: Domain
    origin: Origin
    station: str | None = None
    operator: str | None = None
    success: bool | None
    recovered: bool = False
    num_steps: int
    duration_s: float = Field(default=0.0, ge=0)
    created_at: AwareDatetime | None = None
    lineage: tuple[LineageEntry, ...] = Field(default=(), exclude_if=not_)
    content_sha256: str


class EpisodeList(FrozenModel):
    """One page of the catalog and how many episodes match in all.

    `next_after` is the cursor of the next page; None on the last page.
    """

    episodes: tuple[EpisodeSummary, ...]
    num_matching: int
    next_after: str | None = None


class HoursRow(FrozenModel):
    """Total duration of one task in one domain from one origin."""

    task: str
    domain: Domain
    origin: Origin
    num_episodes: int
    num_successes: int
    hours: float


class CatalogHours(FrozenModel):
    """Hours by task, domain and origin, in this order, and their sum."""

    rows: tuple[HoursRow, ...]
    num_episodes: int
    hours: float


class EpisodeDetail(FrozenModel):
    """An episode's attributes with its length and hash."""

    attributes: EpisodeAttributes
    num_steps: int
    content_sha256: str


class Verification(FrozenModel):
    """Result of a successful `verify`."""

    num_arrays: int
    num_bytes: int
    content_sha256: str


def json_ready(model: BaseModel) -> dict[str, Any]:
    """A model as plain JSON values."""
    return model.model_dump(mode="json")


class LedgerEntry(FrozenModel):
    """One kind of fault that a station noticed in one stream, and how often."""

    stream: str
    event: str = Field(pattern=r"^[a-z][a-z0-9_]{0,63}$")
    count: int = Field(ge=0)
    first_t_host_ns: int | None = None


class ImportedFile(FrozenModel):
    """The file of another tool that a recording was made of, and what read it.

    `name` is the file's own, without folders; `importer` names format and release.
    """

    name: str = Field(min_length=1, max_length=255)
    sha256: str = Field(pattern=r"^[0-9a-f]{64}$")
    importer: str = Field(min_length=1, max_length=128)


class RecordingAttributes(FrozenModel):
    """Metadata of a raw take.

    `started_t_host_ns` is the station's monotonic clock at `started_at`; `calibration` holds named
    matrices (`K_head`, `T_tracker_left_wrist_left`, …); `ledger` the counted faults; `quality`
    named figures; `recovered` marks a take that the station did not finish.
    `complete` is False of a take that was saved although its check found it incomplete, for the
    reason `incomplete_cause`; both are only written then.
    `trace_id` is that of the request that saved the take, or else began its upload; `num_batches`
    the batches of each stream in the upload, which the store notes; `imported_from` the file of
    another tool that the recording was made of. None of these is written if empty.
    """

    format_version: Literal[1] = FORMAT_VERSION
    recording_id: StoreId
    task: str = Field(min_length=1, max_length=128)
    instruction: str = Field(max_length=MAX_INSTRUCTION)
    domain: Domain
    station: str = Field(min_length=1, max_length=128)
    operator: str | None = None
    consent: bool = False
    started_at: AwareDatetime | None = None
    started_t_host_ns: int | None = None
    success: bool | None = None
    recovered: bool = False
    complete: bool = Field(default=True, exclude_if=bool)
    incomplete_cause: str = Field(default="", max_length=MAX_CAUSE, exclude_if=not_)
    calibration: dict[str, Matrix] = Field(default={})
    lineage: Annotated[tuple[LineageEntry, ...], Field(fail_fast=True)] = ()
    ledger: Annotated[tuple[LedgerEntry, ...], Field(fail_fast=True)] = ()
    quality: dict[str, FiniteFloat] = Field(default={})
    trace_id: TraceId | None = Field(default=None, exclude_if=not_)
    num_batches: dict[str, int] = Field(default={}, exclude_if=not_)
    imported_from: ImportedFile | None = Field(default=None, exclude_if=not_)
    streams: Annotated[tuple[StreamDescriptor, ...], Field(fail_fast=True)] = ()

    def as_interrupted(self) -> "RecordingAttributes":
        """Mark the take as interrupted: set `recovered`, and note it in every stream's ledger."""
        marks = [LedgerEntry(stream=s.name, event="interrupted", count=1) for s in self.streams]
        return self.model_copy(update={"ledger": (*self.ledger, *marks), "recovered": True})


class NewRecording(RecordingAttributes):
    """Attributes with which an upload begins; texts of earlier recordings are not checked again."""

    model_config = example(
        recording_id="take-20260301-1",
        domain="human",
        station="bench-1",
        task="stand_bottle",
        instruction="Stand the bottle upright.",
        streams=[
            {
                "name": "tactile_left",
                "kind": "tactile",
                "shape": [320],
                "dtype": "float32",
                "unit": "kPa",
                "nominal_rate_hz": 60.0,
                "side": "left",
            }
        ],
    )

    @model_validator(mode="after")
    def _is_visible(self) -> "NewRecording":
        check_texts(self)
        return self

    def attributes(self) -> RecordingAttributes:
        """As they are stored, and compared with those that are."""
        return RecordingAttributes.model_construct(**dict(self))


class StreamContent(FrozenModel):
    """What a recording has of one stream: number of samples, and a digest of them.

    The digest is the sha256 of the hexadecimal sha256 of its arrays, as the commit record lists
    them: values, t_host_ns, t_device_ns and sequence, with one space in between.
    """

    num_samples: int = Field(ge=0)
    sha256: str = Field(pattern=r"^[0-9a-f]{64}$")


class RecordingStatus(FrozenModel):
    """Progress of an upload: the batch number that each stream expects next.

    `content` is what the store committed of each stream, for those who announced theirs.
    """

    recording_id: StoreId
    state: Literal["open", "finished"]
    next_batch: dict[str, int] = Field(default={})
    content: dict[str, StreamContent] = Field(default={}, exclude_if=not_)


class BatchReceipt(FrozenModel):
    """Acknowledgement of a batch; `replayed` if it was stored before."""

    recording_id: StoreId
    stream: str
    number: int
    num_samples: int
    replayed: bool


class FinishRecording(FrozenModel):
    """The end of an upload: what each stream has, and attributes known only at the end.

    Without `content`, as older stations send it, the answer proves nothing about the samples.
    """

    model_config = example(num_batches={"tactile_left": 12}, success=True)

    num_batches: dict[str, int]
    content: dict[str, StreamContent] = Field(default={})
    success: bool | None = None
    ledger: Annotated[tuple[LedgerEntry, ...], Field(fail_fast=True)] = ()

    @model_validator(mode="after")
    def _is_visible(self) -> "FinishRecording":
        check_texts(self)
        return self


class RecordingSummary(FrozenModel):
    """One row of the list of recordings.

    `duration_s` is that of the longest stream at its nominal rate; `num_bytes` the size on disk.
    """

    recording_id: StoreId
    task: str
    domain: Domain
    station: str
    operator: str | None = None
    consent: bool = False
    success: bool | None = None
    recovered: bool = False
    num_samples: dict[str, int]
    duration_s: float = Field(default=0.0, ge=0)
    num_bytes: int = Field(default=0, ge=0)
    started_at: AwareDatetime | None = None
    content_sha256: str


class RecordingList(FrozenModel):
    """One page of the finished recordings, by id, and how many there are in all.

    `next_after` is the cursor of the next page; None on the last page.
    """

    recordings: tuple[RecordingSummary, ...]
    num_matching: int
    next_after: str | None = None


class UploadSummary(FrozenModel):
    """An unfinished upload and how long it has been idle."""

    recording_id: StoreId
    station: str
    task: str
    num_bytes: int = Field(ge=0)
    idle_s: float = Field(ge=0)


class UploadList(FrozenModel):
    """Unfinished uploads, by id."""

    uploads: tuple[UploadSummary, ...]


class ExpireUploads(FrozenModel):
    """Request to drop every upload that has been idle for at least `idle_s`."""

    model_config = example(idle_s=86400.0)

    idle_s: float = Field(ge=MIN_EXPIRE_IDLE_S, allow_inf_nan=False)
