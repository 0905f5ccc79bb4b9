"""Schemas of episodes: attributes, lineage, clock reports, and the catalog's responses."""

from operator import not_
from typing import Any, Final, Literal

import numpy as np
from jaxtyping import Float64
from pydantic import (
    AwareDatetime,
    BaseModel,
    Field,
    FiniteFloat,
    field_validator,
)

from dextouch.frozen_model import FrozenModel
from dextouch.geometry import rigid_error
from dextouch.hands.actions import AnchorPoses
from dextouch.schemas.fields import (
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
# Characters of the reason why a take is incomplete.
MAX_CAUSE = 500
RIGID_TOLERANCE: Final = 1e-6


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


class LineageEntry(FrozenModel):
    """A source of derived data, by id and content hash."""

    kind: Literal["recording", "episode", "checkpoint", "rollout"]
    id: str
    sha256: str | None = Field(default=None, pattern=r"^[0-9a-f]{64}$")


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

    `anchor` and `K_head` (pixels) belong to step 0; `streams` is completed by the writer;
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
    instruction: str = Field(max_length=2000)
    domain: Domain
    origin: Origin
    station: str | None = Field(default=None, min_length=1, max_length=128)
    operator: str | None = None
    seed: int | None = None
    model_rate_hz: FiniteFloat = Field(default=15.0, gt=0)
    anchor: StoredAnchor
    K_head: Matrix
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
    def _is_camera_matrix(cls, rows: Matrix) -> Matrix:
        return _check_matrix(rows, (3, 3))

    def head_distortion(self) -> Float64[np.ndarray, "5"]:
        """Distortion of the head camera's lens, k1 k2 p1 p2 k3; zeros where none is known."""
        return np.array(self.calibration.get("distortion_head", ((0.0,) * 5,))[0], dtype=np.float64)

    def K_head_matrix(self) -> Float64[np.ndarray, "3 3"]:  # noqa: N802 (K is the camera matrix)
        """The head camera's matrix in pixels."""
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
