"""Recurrent core: predicts object motion and touch from commanded hand motion.

A gated recurrent network (Cho et al. 2014) at 3.75 Hz. Its hidden state is the only memory that a
rollout carries from one action chunk to the next, and it is bounded by construction (every unit
stays within −1 … 1).
"""

from dataclasses import dataclass

import torch
from jaxtyping import Float32, Int64
from torch import Tensor, nn

from dextouch.tactile.layout import NUM_TAXELS
from services.world_model.dynamics.configuration import (
    MAX_OBJECTS,
    STEPS_PER_LATENT,
    DynamicsConfig,
)
from services.world_model.dynamics.features import NUM_FEATURES, compressed
from services.world_model.dynamics.objects import ObjectPoses

NUM_PADS = 12
# The contact of a hand's taxels is modelled as a mixture of this many patterns.
NUM_PATTERNS = 48
# Displacements from the start are predicted in this unit.
MOVE_M = 0.05
MAX_DEVIATION = 5.0
_OBJECT_SIZE = MAX_OBJECTS * 10


@dataclass(frozen=True)
class SceneStart:
    """Inputs of the core at the first step, besides the commands.

    `touch` holds the latents of both hands, `pads_kpa` the mean pressures of the twelve pads (thumb
    … little, palm; left, right); `commanded` is 1 for commanded actions and 0 for measured ones.
    """

    objects: ObjectPoses
    touch: Float32[Tensor, "batch 2 channels"]
    pads_kpa: Float32[Tensor, "batch 12"]
    task: Int64[Tensor, " batch"]
    commanded: Float32[Tensor, " batch"]


@dataclass(frozen=True)
class SceneFuture:
    """Predictions of the core for every latent step.

    `touch`, `pattern` (mapped by `RecurrentCore.taxels` to contact log odds of each taxel) and
    `contact` (contact log odds of each pad) cover the four steps that end at the latent; `success`
    holds the log odds that the task is done at it. `contact` and `success` are training targets
    only.
    """

    objects: ObjectPoses
    touch: Float32[Tensor, "batch latents 4 2 channels"]
    contact: Float32[Tensor, "batch latents 4 12"]
    pattern: Float32[Tensor, "batch latents 4 2 patterns"]
    success: Float32[Tensor, "batch latents"]


class RecurrentCore(nn.Module):
    """Predicts object poses and touch from command features and a start.

    Args:
        config: configuration of the dynamics model.
    """

    feature_mean: Tensor
    feature_std: Tensor

    def __init__(self, config: DynamicsConfig) -> None:
        super().__init__()
        self.config = config
        width, channels = config.width, config.touch_channels
        self.register_buffer("feature_mean", torch.zeros(len(config.tasks), NUM_FEATURES))
        self.register_buffer("feature_std", torch.ones(len(config.tasks), NUM_FEATURES))
        static = _OBJECT_SIZE + NUM_PADS + len(config.tasks) + 1
        self.enter = nn.Sequential(
            nn.Linear(NUM_FEATURES + static, width),
            nn.LayerNorm(width),
            nn.GELU(),
            nn.Linear(width, width),
            nn.GELU(),
        )
        self.begin = nn.Sequential(
            nn.Linear(static + 2 * channels, width),
            nn.GELU(),
            nn.Linear(width, config.num_layers * width),
            nn.Tanh(),
        )
        self.memory = nn.GRU(width, width, num_layers=config.num_layers, batch_first=True)
        self.dropout = nn.Dropout(0.1)
        self.objects = nn.Linear(width, MAX_OBJECTS * 9)
        self.touch = nn.Linear(width, STEPS_PER_LATENT * 2 * channels)
        self.contact = nn.Linear(width, STEPS_PER_LATENT * NUM_PADS)
        self.pattern = nn.Linear(width, STEPS_PER_LATENT * 2 * NUM_PATTERNS)
        self.taxels = nn.Linear(NUM_PATTERNS, NUM_TAXELS)
        self.success = nn.Sequential(nn.Linear(width, 64), nn.GELU(), nn.Linear(64, 1))

    def first_state(self, start: SceneStart) -> Float32[Tensor, "layers batch width"]:
        """The hidden state before the first step."""
        static = torch.cat([self._static(start), start.touch.flatten(1)], dim=1)
        state = self.begin(static).unflatten(1, (self.config.num_layers, self.config.width))
        return state.transpose(0, 1).contiguous()

    def forward(
        self,
        features: Float32[Tensor, "batch latents features"],
        start: SceneStart,
        state: Float32[Tensor, "layers batch width"],
    ) -> tuple[SceneFuture, Float32[Tensor, "layers batch width"]]:
        """Predictions for every latent, and the hidden state after the last one.

        Args:
            features: from `command_features`, relative to the objects of `start`.
            start: start of the rollout, the same for all its chunks.
            state: from `first_state` or from the previous chunk.
        """
        scaled = self.scaled(features, start.task).clamp(-MAX_DEVIATION, MAX_DEVIATION)
        static = self._static(start)[:, None].expand(-1, features.shape[1], -1)
        entered = self.dropout(self.enter(torch.cat([scaled, static], dim=-1)))
        hidden, state = self.memory(entered, state)
        return self._decoded(hidden, start), state

    def scaled(
        self, features: Float32[Tensor, "batch latents features"], task: Int64[Tensor, " batch"]
    ) -> Float32[Tensor, "batch latents features"]:
        """Features standardized with the mean and deviation of their task.

        Tasks hold the hands in different regions: with statistics shared by all tasks, the
        millimetres that decide success would be too small to learn from.
        """
        return (features - self.feature_mean[task][:, None]) / self.feature_std[task][:, None]

    def _static(self, start: SceneStart) -> Float32[Tensor, "batch static"]:
        objects = start.objects
        position = objects.position_m * 5.0 * objects.present[..., None]
        parts = [
            position.flatten(1),
            objects.axes.flatten(1),
            objects.present,
            compressed(start.pads_kpa * 1e-2),
            nn.functional.one_hot(start.task, len(self.config.tasks)).float(),
            start.commanded[:, None],
        ]
        return torch.cat(parts, dim=1)

    def _decoded(
        self, hidden: Float32[Tensor, "batch latents width"], start: SceneStart
    ) -> SceneFuture:
        outputs = self.objects(hidden).unflatten(-1, (MAX_OBJECTS, 3, 3))
        position = start.objects.position_m[:, None] + MOVE_M * outputs[..., 0, :]
        present = start.objects.present[:, None].expand(-1, hidden.shape[1], -1)
        axes = start.objects.axes[:, None] + outputs[..., 1:, :]
        steps = (STEPS_PER_LATENT, 2, self.config.touch_channels)
        return SceneFuture(
            ObjectPoses(position, axes, present),
            self.touch(hidden).unflatten(-1, steps),
            self.contact(hidden).unflatten(-1, (STEPS_PER_LATENT, NUM_PADS)),
            self.pattern(hidden).unflatten(-1, (STEPS_PER_LATENT, 2, NUM_PATTERNS)),
            self.success(hidden)[..., 0],
        )
