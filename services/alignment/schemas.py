"""Bodies of the alignment service: what is asked, and where an alignment stands."""

from typing import Literal

from pydantic import BaseModel, ConfigDict, Field

from dextouch.schemas.episodes import StoreId
from dextouch.schemas.problems import Problem
from services.alignment.options import AlignmentOptions
from services.alignment.report import AlignmentReport


class AlignmentRequest(BaseModel):
    """Align one finished recording; options that are not given are the service's."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    recording_id: StoreId
    options: AlignmentOptions | None = None


class AlignmentJob(BaseModel):
    """One alignment: `alignment_id` is the episode's id, `progress` goes from 0 to 1.

    `report` is there when `state` is done, `problem` when it is failed.
    """

    model_config = ConfigDict(frozen=True, extra="forbid")

    alignment_id: str
    recording_id: str
    state: Literal["waiting", "running", "done", "failed"]
    progress: float = Field(ge=0, le=1)
    report: AlignmentReport | None = None
    problem: Problem | None = None


class AlignmentList(BaseModel):
    """Alignments of this process, oldest first."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    alignments: tuple[AlignmentJob, ...]
