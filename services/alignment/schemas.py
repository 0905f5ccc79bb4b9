"""Request and response bodies of the alignment service, and the states of an alignment job."""

from datetime import UTC, datetime
from http import HTTPStatus
from typing import Annotated, Literal

from pydantic import AwareDatetime, Field, FiniteFloat, model_validator

from dextouch.errors import DexTouchError, UnavailableError
from dextouch.frozen_model import FrozenModel
from dextouch.schemas import Problem, StoreId, problem_from_error
from services.alignment.options import AlignmentOptions
from services.alignment.report import AlignmentReport
from services.alignment.synchronization.progress import Progress, Stage

MAX_BATCH = 1000
JobState = Literal["waiting", "running", "done", "failed", "cancelled"]
# Progress below this share is too little to estimate the remaining time from.
MIN_ETA_SHARE = 0.05
ENDED: frozenset[JobState] = frozenset({"done", "failed", "cancelled"})


class AlignmentRequest(FrozenModel):
    """Align one or up to a thousand recordings; missing options default to the service's."""

    recording_id: StoreId | None = None
    recording_ids: Annotated[tuple[StoreId, ...], Field(fail_fast=True)] | None = Field(
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


class AlignmentJob(FrozenModel):
    """One alignment: `alignment_id` is the episode's id, `progress` goes from 0 to 1.

    `stage` and `stream` are being processed, `eta_s` is the estimated remaining time; `attempts`
    counts how often work began. `report` is there when `state` is done, `problem` when it is
    failed.
    """

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

    @classmethod
    def new(cls, alignment_id: str, recording_id: str, options: AlignmentOptions) -> "AlignmentJob":
        """A job that waits."""
        return cls(
            alignment_id=alignment_id,
            recording_id=recording_id,
            options=options,
            state="waiting",
            progress=0.0,
            submitted_at=_now(),
        )

    def started(self) -> "AlignmentJob":
        """A worker begins the next attempt."""
        return self._with(state="running", attempts=self.attempts + 1, started_at=_now())

    def with_progress(self, progress: Progress) -> "AlignmentJob":
        """Further along; progress never decreases."""
        share = max(self.progress, progress.share)
        return self._with(progress=share, stage=progress.stage, stream=progress.stream)

    def ended(
        self,
        state: Literal["done", "failed", "cancelled"],
        *,
        report: AlignmentReport | None = None,
        error: DexTouchError | None = None,
    ) -> "AlignmentJob":
        """Its episode is in the store, it failed for a reason, or it was cancelled."""
        problem = error and problem_from_error(error, instance=self.alignment_id, request_id="")
        return self._with(
            state=state,
            ended_at=_now(),
            progress=1.0 if state == "done" else self.progress,
            stage=None,
            stream=None,
            report=report,
            problem=problem,
        )

    def waiting(self, *, attempts: int) -> "AlignmentJob":
        """It waits for its next attempt, after so many that count."""
        again: dict[str, object] = {"stage": None, "stream": None, "started_at": None}
        return self._with(state="waiting", attempts=attempts, progress=0.0, **again)

    def crashed(self, *, max_attempts: int) -> "AlignmentJob":
        """The service died during this attempt: wait for the next one, or fail if it was the last.

        The job itself may be what kills the service, so it is not tried for ever.
        """
        if self.attempts < max_attempts:
            return self.waiting(attempts=self.attempts)
        error = UnavailableError(
            f"recording {self.recording_id!r}: the alignment service died {self.attempts} times "
            "while it was aligned, so it is not tried again by itself; look into the service's log "
            "(out of memory?), then ask for it again",
            attempts=self.attempts,
        )
        return self.ended("failed", error=error)

    def is_out_of_space(self, *, for_s: float) -> bool:
        """Whether it failed at least `for_s` ago because no space was left."""
        if self.state != "failed" or self.problem is None or self.ended_at is None:
            return False
        is_old = (_now() - self.ended_at).total_seconds() >= for_s
        return is_old and self.problem.status == HTTPStatus.INSUFFICIENT_STORAGE

    def with_eta(self) -> "AlignmentJob":
        """Estimates the remaining time from the time that the progress took so far."""
        if self.state != "running" or self.started_at is None or self.progress < MIN_ETA_SHARE:
            return self
        elapsed_s = max((_now() - self.started_at).total_seconds(), 0.0)
        return self._with(eta_s=elapsed_s * (1 - self.progress) / self.progress)

    def _with(self, **changes: object) -> "AlignmentJob":
        return self.model_copy(update=changes)


class AlignmentList(FrozenModel):
    """One page of the alignments, oldest first, and how many match in all.

    `next_after` is the id to ask on from; None on the last page.
    """

    alignments: tuple[AlignmentJob, ...]
    num_matching: int = Field(ge=0)
    next_after: str | None = None


def _now() -> datetime:
    return datetime.now(UTC)
