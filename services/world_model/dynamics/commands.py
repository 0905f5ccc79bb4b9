"""Commanded motion of both hands, sampled for the recurrent core."""

from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Float32
from torch import Tensor

from services.world_model.dynamics.configuration import STEPS_PER_LATENT
from services.world_model.dynamics.features import LOOKS
from services.world_model.dynamics.hand_motion import HandMotion
from services.world_model.dynamics.nested import mapped


@dataclass(frozen=True)
class Commands:
    """Motion of both hands at the sampled steps of each latent.

    `points_m` are those of `HandMotion` at the `LOOKS` of each latent, `axes` and `joints_rad` at
    its end.
    """

    points_m: Float32[Tensor, "batch latents looks 2 points 3"]
    axes: Float32[Tensor, "batch latents 2 6"]
    joints_rad: Float32[Tensor, "batch latents 2 20"]

    def __len__(self) -> int:
        # A tensor while a trace is made.
        return int(self.points_m.shape[1])

    def __getitem__(self, latents: slice) -> "Commands":
        """Select latent steps."""
        return Commands(
            self.points_m[:, latents], self.axes[:, latents], self.joints_rad[:, latents]
        )

    def repeated(self, times: int) -> "Commands":
        """The same commands for each of several members, whose entries follow each other."""
        return mapped(self, lambda values: values.repeat(times, *[1] * (values.ndim - 1)))

    @classmethod
    def of(cls, motions: list[HandMotion]) -> "Commands":
        """Commands of a batch: for each entry, the hand motion over the next 4k steps."""
        looks = np.arange(0, len(motions[0]), STEPS_PER_LATENT)[:, None] + np.array(LOOKS) - 1
        ends = looks[:, -1]
        return cls(
            torch.from_numpy(np.stack([motion.points_m[looks] for motion in motions])),
            torch.from_numpy(np.stack([motion.axes[ends] for motion in motions])),
            torch.from_numpy(np.stack([motion.joints_rad[ends] for motion in motions])),
        )

    @classmethod
    def standing(cls, motions: list[HandMotion]) -> "Commands":
        """The single latent step, with resting hands, that starts a rollout (one step each)."""
        return cls.of([motion[np.zeros(STEPS_PER_LATENT, dtype=np.int64)] for motion in motions])
