"""Schemas of recordings: attributes, and the bodies of uploads to the store."""

from operator import not_
from typing import Annotated, Literal

from pydantic import AwareDatetime, Field, FiniteFloat, model_validator

from dextouch.free_text import check_texts
from dextouch.frozen_model import FrozenModel
from dextouch.schemas.episodes import FORMAT_VERSION, MAX_CAUSE, LineageEntry
from dextouch.schemas.fields import Domain, Matrix, StoreId, TraceId
from dextouch.streams import StreamDescriptor

# Reason of the store's ConflictError when another recording has the id.
ID_TAKEN = "id_taken"
# Uploads that were idle for less are never dropped. Chosen: a living station pauses for at most a
# request without an answer and a Retry-After, 30 s each; this is ten times as long.
MIN_EXPIRE_IDLE_S = 600.0


class LedgerEntry(FrozenModel):
    """One kind of fault that a station noticed in one stream, and how often."""

    stream: str
    event: str = Field(pattern=r"^[a-z][a-z0-9_]{0,63}$")
    count: int = Field(ge=0)
    first_t_host_ns: int | None = None


class RecordingAttributes(FrozenModel):
    """Metadata of a raw take.

    `started_t_host_ns` is the station's monotonic clock at `started_at`; `calibration` holds named
    matrices (`K_head`, `T_tracker_left_wrist_left`, …); `ledger` the counted faults; `quality`
    named figures; `recovered` marks a take that the station did not finish.
    `complete` is False of a take that was saved although its check found it incomplete, for the
    reason `incomplete_cause`; both are only written then.
    `trace_id` is that of the request that saved the take, or else began its upload; `num_batches`
    the batches of each stream in the upload, which the store notes. Neither is written if empty.
    """

    format_version: Literal[1] = FORMAT_VERSION
    recording_id: StoreId
    task: str = Field(min_length=1, max_length=128)
    instruction: str = Field(max_length=2000)
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
    streams: Annotated[tuple[StreamDescriptor, ...], Field(fail_fast=True)] = ()

    def as_interrupted(self) -> "RecordingAttributes":
        """Mark the take as interrupted: set `recovered`, and note it in every stream's ledger."""
        marks = [LedgerEntry(stream=s.name, event="interrupted", count=1) for s in self.streams]
        return self.model_copy(update={"ledger": (*self.ledger, *marks), "recovered": True})


class NewRecording(RecordingAttributes):
    """Attributes with which an upload begins; texts of earlier recordings are not checked again."""

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

    idle_s: float = Field(ge=MIN_EXPIRE_IDLE_S, allow_inf_nan=False)
