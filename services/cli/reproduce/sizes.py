"""Amounts of data and training of a reproduction."""

from typing import Final

from pydantic import Field

from dextouch.frozen_model import FrozenModel
from services.twin.tasks.registry import DOWNSTREAM, HUMAN_PRETRAINING, ROBOT_PRETRAINING


class Sizes(FrozenModel):
    """Amounts of data and training; the defaults take some hours on two cores.

    The paper has 5 h of robot and up to 100 h of human data, that is 20 times as much.
    """

    robot_per_task: int = Field(default=4, ge=2, description="robot episodes per pretraining task")
    multiples: tuple[int, ...] = Field(
        default=(1, 5, 10), description="human episodes, as multiples of the robot episodes"
    )
    heldout_per_task: int = Field(default=6, ge=1, description="held-out episodes per task")
    downstream_per_task: int = Field(default=84, ge=3, description="robot episodes per task")
    adapt_robot: int = Field(default=200, ge=1, description="robot episodes of WM-Robot")
    adapt_half: int = Field(default=100, ge=1, description="robot and human episodes of WM-Mix")
    tokenizer_cpu_s: int = Field(default=60, ge=1, description="training of a tokenizer")
    train_cpu_s: int = Field(default=300, ge=1, description="training of a world model")
    option_cpu_s: int = Field(default=120, ge=1, description="the same, to compare options")
    adapt_cpu_s: int = Field(default=150, ge=1, description="adaptation of a world model")
    policy_steps: int = Field(default=3000, ge=1, description="training steps of a cloned policy")
    num_starts: int = Field(default=10, ge=1, description="starts per task and policy")
    num_generated: int = Field(default=100, ge=1, description="generated demonstrations")

    @property
    def num_robot(self) -> int:
        """Robot episodes of pretraining."""
        return self.robot_per_task * len(ROBOT_PRETRAINING)

    @property
    def human_per_task(self) -> int:
        """Human episodes per task, for the largest multiple and some that alignment refuses."""
        return 2 + max(self.multiples) * self.num_robot // len(HUMAN_PRETRAINING)

    @property
    def downstream_human_per_task(self) -> int:
        """Human episodes per task of which two thirds of the scenes give `adapt_half`."""
        return 3 + 2 * self.adapt_half // len(DOWNSTREAM)


QUICK: Final = Sizes(
    robot_per_task=8,
    multiples=(1,),
    heldout_per_task=1,
    downstream_per_task=24,
    adapt_robot=8,
    adapt_half=4,
    tokenizer_cpu_s=3,
    train_cpu_s=6,
    option_cpu_s=4,
    adapt_cpu_s=4,
    policy_steps=20,
    num_starts=1,
    num_generated=4,
)
