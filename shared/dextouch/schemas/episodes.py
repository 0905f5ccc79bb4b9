"""What an episode says about itself, and the catalog's answers: pydantic models in and out."""

from operator import not_
from typing import Annotated, Any, Final, Literal

import numpy as np
from jaxtyping import Float64
from pydantic import (
    AwareDatetime,
    BaseModel,
    ConfigDict,
    Field,
    FiniteFloat,
    field_validator,
)

from dextouch.hands.actions import AnchorPoses
from dextouch.streams.descriptors import StreamDescriptor

FORMAT_VERSION: Final = 1
ID_PATTERN = r"^[a-z0-9][a-z0-9_-]{0,127}$"

# What dates a stream's samples: the device's stamps, its sequence numbers, the count of those that
# it must have sent, or the arrivals as they are.
ClockMethod = Literal["device", "sequence", "counting", "arrival"]
# Why the times of a stream are in doubt: its clock is far off its nominal rate, even the promptest
# samples arrive later than the fit says by more than a sample period, or a stop of the clock cannot
# be told from a path that got longer.
ClockWarning = Literal["skew", "residual", "stop"]
StoreId = Annotated[str, Field(pattern=ID_PATTERN)]
Domain = Literal["human", "robot"]
Origin = Literal["recorded", "twin", "imagined"]
Matrix = tuple[tuple[FiniteFloat, ...], ...]
NonNegativeFinite = Annotated[FiniteFloat, Field(ge=0)]
# Centre x y z and half sizes x y z of a bounding box.
Box = tuple[FiniteFloat, FiniteFloat, FiniteFloat, FiniteFloat, FiniteFloat, FiniteFloat]


def matrix_rows(matrix: np.ndarray) -> Matrix:
    """A two-dimensional array as nested tuples, the way attributes keep it."""
    return tuple(tuple(float(value) for value in row) for row in np.asarray(matrix))


def _check_matrix(rows: Matrix, shape: tuple[int, int]) -> Matrix:
    got = (len(rows), *{len(row) for row in rows})
    if got != shape:
        raise ValueError(f"got a matrix of rows and columns {got}, expected {shape}")
    return rows


class StoredAnchor(BaseModel):
    """The absolute poses of step 0 that an episode's actions are relative to, as 4×4 rows."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    T_world_wrist_left: Matrix
    T_world_wrist_right: Matrix
    T_world_camera_head: Matrix

    @field_validator("*")
    @classmethod
    def _is_rigid(cls, rows: Matrix) -> Matrix:
        T = np.array(_check_matrix(rows, (4, 4)))
        orthonormal = np.allclose(T[:3, :3] @ T[:3, :3].T, np.eye(3), atol=1e-6)
        if not orthonormal or np.linalg.det(T[:3, :3]) < 0 or T[3].tolist() != [0, 0, 0, 1]:
            raise ValueError("expected a rigid transform: a rotation and the last row 0 0 0 1")
        return rows

    @classmethod
    def from_poses(cls, anchor: AnchorPoses) -> "StoredAnchor":
        """The stored form of an anchor."""
        return cls(
            T_world_wrist_left=matrix_rows(anchor.T_world_wrist_left),
            T_world_wrist_right=matrix_rows(anchor.T_world_wrist_right),
            T_world_camera_head=matrix_rows(anchor.T_world_camera_head),
        )

    def to_poses(self) -> AnchorPoses:
        """The anchor as arrays."""
        return AnchorPoses(
            np.array(self.T_world_wrist_left),
            np.array(self.T_world_wrist_right),
            np.array(self.T_world_camera_head),
        )


class LineageEntry(BaseModel):
    """One thing that another was made from, by id and content hash."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    kind: Literal["recording", "episode", "checkpoint", "rollout"]
    id: str
    sha256: str | None = Field(default=None, pattern=r"^[0-9a-f]{64}$")


class ClockReport(BaseModel):
    """How well one stream's clock was fitted to the reference clock.

    `method` is what dates the samples, None where the episode does not say. `latency_ms` is the
    constant path delay that was taken away; `latency_sigma_ms` says how well it is known, None
    where nobody measured it. `num_steps` counts where the device's clock jumped or stood still and
    the fit was cut; `warnings` say why the times are in doubt.
    """

    model_config = ConfigDict(frozen=True, extra="forbid")

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


class EpisodeAttributes(BaseModel):
    """Everything about an episode that is not a sample.

    `anchor` and `K_head` (pixels) belong to step 0; `streams` is completed by the writer;
    `calibration` holds named matrices such as `T_tracker_left_wrist_left`; `quality` named figures;
    `recovered` says that the writer died and this is what its journals vouch for. `object_boxes_m`
    has one box an object, centre and half sizes in the object's own frame. `event_times_s` says
    when each milestone of the task first held, in seconds from step 0; milestones never reached
    are absent. Where these two are empty they are not written, so that older releases read it.
    """

    model_config = ConfigDict(frozen=True, extra="forbid")

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
    generator_command: str | None = None
    lineage: tuple[LineageEntry, ...] = ()
    object_names: tuple[str, ...] = ()
    object_boxes_m: tuple[Box, ...] = Field(default=(), exclude_if=not_)
    event_times_s: dict[str, NonNegativeFinite] = Field(default={}, exclude_if=not_)
    calibration: dict[str, Matrix] = {}
    clocks: tuple[ClockReport, ...] = ()
    quality: dict[str, FiniteFloat] = {}
    created_at: AwareDatetime | None = None
    streams: tuple[StreamDescriptor, ...] = ()

    @field_validator("K_head")
    @classmethod
    def _is_camera_matrix(cls, rows: Matrix) -> Matrix:
        return _check_matrix(rows, (3, 3))

    def K_head_matrix(self) -> Float64[np.ndarray, "3 3"]:  # noqa: N802 (K is the camera matrix)
        """The head camera's matrix in pixels."""
        return np.array(self.K_head)


class EpisodeSummary(BaseModel):
    """One row of the catalog; `duration_s` is that of the model grid, or of the longest stream."""

    model_config = ConfigDict(frozen=True, extra="forbid")

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
    content_sha256: str


class EpisodeList(BaseModel):
    """One page of the catalog and how many episodes match in all.

    `next_after` is the id to ask on from; None on the last page.
    """

    model_config = ConfigDict(frozen=True, extra="forbid")

    episodes: tuple[EpisodeSummary, ...]
    num_matching: int
    next_after: str | None = None


class HoursRow(BaseModel):
    """How much there is of one task in one domain from one origin."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    task: str
    domain: Domain
    origin: Origin
    num_episodes: int
    num_successes: int
    hours: float


class CatalogHours(BaseModel):
    """Hours by task, domain and origin, in this order, and their sum."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    rows: tuple[HoursRow, ...]
    num_episodes: int
    hours: float


class EpisodeDetail(BaseModel):
    """An episode's attributes with its length and hash."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    attributes: EpisodeAttributes
    num_steps: int
    content_sha256: str


class Verification(BaseModel):
    """What `verify` read and found whole."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    num_arrays: int
    num_bytes: int
    content_sha256: str


def json_ready(model: BaseModel) -> dict[str, Any]:
    """A model as plain JSON values."""
    return model.model_dump(mode="json")
