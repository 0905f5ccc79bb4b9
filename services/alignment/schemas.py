"""Bodies of the alignment service: requests, jobs with their states, and reports on episodes."""

import re
from collections.abc import Mapping
from datetime import UTC, datetime
from http import HTTPStatus
from typing import Annotated, Literal

import numpy as np
from pydantic import AwareDatetime, Field, FiniteFloat, model_validator

from dextouch.episodes import EpisodeReader
from dextouch.errors import DexTouchError, UnavailableError
from dextouch.frozen_model import FrozenModel, example
from dextouch.schemas import ClockReport, Domain, Matrix, Problem, StoreId, problem_from_error
from services.alignment.calibration.tactile_tare import REASONS
from services.alignment.settings import AlignmentOptions
from services.alignment.synchronization import Progress, Stage
from services.alignment.synchronization.resampling import RefusedPart, refused_parts

MAX_BATCH = 1000
JobState = Literal["waiting", "running", "done", "failed", "cancelled"]
# Progress below this share is too little to estimate the remaining time from.
MIN_ETA_SHARE = 0.05
ENDED: frozenset[JobState] = frozenset({"done", "failed", "cancelled"})
EXPECTED_STREAMS = (
    "tactile_left",
    "tactile_right",
    "camera_head",
    "camera_wrist_left",
    "camera_wrist_right",
)


class AlignmentRequest(FrozenModel):
    """Align one or up to a thousand recordings; missing options default to the service's."""

    model_config = example(recording_ids=["take-20260301-1", "take-20260301-2"])

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


class AlignmentReport(FrozenModel):
    """Report of one aligned recording.

    `created` is False where the same recording had been aligned with the same options before.
    `duration_s` is that of the model grid. `absent` lists parts of the action and streams that an
    episode may have and this one has not; `refused_parts` the stretches of the recording that are
    not in the episode, and why; `retargeting` figures of each hand: tip error (mean and 95th
    percentile, mm) and the share of steps by status. `refused_taxels` names, by stream and reason,
    taxels (anatomical order) that are zero because they were not measured.
    """

    recording_id: str
    episode_id: str
    created: bool
    domain: Domain
    num_steps: int
    duration_s: float = Field(default=0.0, ge=0)
    streams: dict[str, int]
    absent: tuple[str, ...]
    clocks: tuple[ClockReport, ...]
    quality: dict[str, FiniteFloat]
    retargeting: dict[str, dict[str, FiniteFloat]] = Field(default={})
    refused_parts: tuple[RefusedPart, ...] = ()
    refused_taxels: dict[str, dict[str, tuple[int, ...]]] = Field(default={})
    content_sha256: str


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
            submitted_at=datetime.now(UTC),
        )

    def started(self) -> "AlignmentJob":
        """A worker begins the next attempt."""
        return self._with(state="running", attempts=self.attempts + 1, started_at=datetime.now(UTC))

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
            ended_at=datetime.now(UTC),
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
        """The service died in this attempt: wait for the next, or fail if it was the last."""
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
        is_old = (datetime.now(UTC) - self.ended_at).total_seconds() >= for_s
        return is_old and self.problem.status == HTTPStatus.INSUFFICIENT_STORAGE

    def with_eta(self) -> "AlignmentJob":
        """Estimates the remaining time from the time that the progress took so far."""
        if self.state != "running" or self.started_at is None or self.progress < MIN_ETA_SHARE:
            return self
        elapsed_s = max((datetime.now(UTC) - self.started_at).total_seconds(), 0.0)
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


def report_of(episode: EpisodeReader, *, recording_id: str, created: bool) -> AlignmentReport:
    """The report of an episode that alignment wrote."""
    attributes = episode.attributes
    retargeting: dict[str, dict[str, float]] = {}
    for name, value in attributes.quality.items():
        if match := re.fullmatch(r"retargeting_(left|right)_(.+)", name):
            retargeting.setdefault(match[1], {})[match[2]] = value
    return AlignmentReport(
        recording_id=recording_id,
        episode_id=attributes.episode_id,
        created=created,
        domain=attributes.domain,
        num_steps=episode.num_steps,
        duration_s=episode.num_steps / attributes.model_rate_hz,
        streams={name: episode.num_samples(name) for name in episode.streams},
        absent=(*attributes.absent, *(n for n in EXPECTED_STREAMS if n not in episode.streams)),
        clocks=attributes.clocks,
        quality=attributes.quality,
        retargeting=retargeting,
        refused_parts=refused_parts(attributes.calibration),
        refused_taxels=_refused_taxels(attributes.calibration),
        content_sha256=episode.content_sha256,
    )


def _refused_taxels(calibration: Mapping[str, Matrix]) -> dict[str, dict[str, tuple[int, ...]]]:
    found: dict[str, dict[str, tuple[int, ...]]] = {}
    for name in ("tactile_left", "tactile_right"):
        states = np.array(calibration.get(f"{name}_refused_taxels", ()), dtype=np.int64).ravel()
        for code in np.unique(states[states > 0]).tolist():
            taxels = tuple(np.flatnonzero(states == code).tolist())
            found.setdefault(name, {})[REASONS[code]] = taxels
    return found
