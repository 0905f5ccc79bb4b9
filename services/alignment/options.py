"""Options of an alignment, such as the rate of its action grid."""

from typing import Literal

from pydantic import Field

from dextouch.frozen_model import FrozenModel
from dextouch.schemas import SceneObjects

WristChoice = Literal["tracked", "touch"]


class AlignmentOptions(FrozenModel):
    """Options of one alignment; they are part of the episode's identity.

    A `wrist` as tracked is not written, and nor are `objects` if there are none, so that ids of
    episodes of earlier versions remain.
    """

    model_rate_hz: float = Field(default=15.0, gt=0, le=1000, description="rate of the model grid")
    max_gap_ms: float = Field(
        default=50.0,
        gt=0,
        le=10_000,
        description="longest gap between samples that is interpolated; of slow streams it is 2.5 "
        "nominal periods",
    )
    min_num_steps: int = Field(
        default=17, ge=2, description="shortest gap-free interval that becomes an episode"
    )
    wrist: WristChoice = Field(
        default="tracked",
        exclude_if=lambda wrist: wrist == "tracked",
        description="poses of human wrists and fingertips: as tracked, or moved so that the "
        "robot's hand touches where the person's did",
    )
    objects: SceneObjects | None = Field(
        default=None,
        exclude_if=lambda objects: objects is None,
        description="objects of the tasks, whose poses become streams of the episodes",
    )

    def of_task(self, task: str) -> "AlignmentOptions":
        """The options that matter to recordings of one task."""
        if self.objects is None:
            return self
        return self.model_copy(update={"objects": self.objects.of_task(task)})

    @property
    def max_gap_ns(self) -> int:
        """The largest gap in nanoseconds; slow streams may have longer ones (`stream_gap_ns`)."""
        return round(self.max_gap_ms * 1e6)
