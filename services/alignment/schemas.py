"""Bodies of the alignment service: what is asked, and where an alignment stands."""

from typing import Literal

from pydantic import AwareDatetime, BaseModel, ConfigDict, Field, FiniteFloat, model_validator

from dextouch.schemas.episodes import StoreId
from dextouch.schemas.problems import Problem
from services.alignment.options import AlignmentOptions
from services.alignment.report import AlignmentReport
from services.alignment.synchronization.progress import Stage

MAX_BATCH = 1000
JobState = Literal["waiting", "running", "done", "failed", "cancelled"]
ENDED: frozenset[JobState] = frozenset({"done", "failed", "cancelled"})


class AlignmentRequest(BaseModel):
    """Align finished recordings, one or up to a thousand; options left out are the service's."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    recording_id: StoreId | None = None
    recording_ids: tuple[StoreId, ...] | None = Field(
        default=None, min_length=1, max_length=MAX_BATCH
    )
    options: AlignmentOptions | None = None

    @model_validator(mode="after")
    def _names_recordings_once(self) -> "AlignmentRequest":
        if (self.recording_id is None) == (self.recording_ids is None):
            raise ValueError("expected exactly one of recording_id and recording_ids")
        return self

    @property
    def wanted(self) -> tuple[StoreId, ...]:
        """All recordings, each once."""
        if self.recording_id is not None:
            return (self.recording_id,)
        return tuple(dict.fromkeys(self.recording_ids or ()))


class AlignmentJob(BaseModel):
    """One alignment: `alignment_id` is the episode's id, `progress` goes from 0 to 1.

    `stage` and `stream` say what is worked on, `eta_s` how long it will take if all goes on as
    before; `attempts` counts how often work began. `report` is there when `state` is done,
    `problem` when it is failed.
    """

    model_config = ConfigDict(frozen=True, extra="forbid")

    alignment_id: str
    recording_id: str
    options: AlignmentOptions = AlignmentOptions()
    state: JobState
    progress: float = Field(ge=0, le=1)
    stage: Stage | None = None
    stream: str | None = None
    eta_s: FiniteFloat | None = Field(default=None, ge=0)
    attempts: int = Field(default=0, ge=0)
    submitted_at: AwareDatetime | None = None
    started_at: AwareDatetime | None = None
    ended_at: AwareDatetime | None = None
    report: AlignmentReport | None = None
    problem: Problem | None = None


class AlignmentList(BaseModel):
    """One page of the alignments, oldest first, and how many match in all.

    `next_after` is the id to ask on from; None on the last page.
    """

    model_config = ConfigDict(frozen=True, extra="forbid")

    alignments: tuple[AlignmentJob, ...]
    num_matching: int = Field(ge=0)
    next_after: str | None = None
