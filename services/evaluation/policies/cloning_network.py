"""Two head images, touch, pose and time in; the next action chunk as codec coefficients out."""

import math
from dataclasses import dataclass

import numpy as np
import torch
from torch import nn

from dextouch.hands.actions import ACTION_DIM, CAMERA_HEAD, POSE_SLICES
from services.evaluation.features import NUM_PAD_FEATURES

CHUNK_STEPS = 16
CHUNK_SIZE = CHUNK_STEPS * ACTION_DIM
NUM_PHASE_FEATURES = 8
SLOT_STEPS = 8
STATE_DIM = NUM_PAD_FEATURES + ACTION_DIM + NUM_PHASE_FEATURES + 1
_REACHED = slice(NUM_PAD_FEATURES, NUM_PAD_FEATURES + ACTION_DIM)
_CHANNELS = (16, 16, 24)
_TASK_FEATURES = 8


@dataclass(frozen=True)
class CloningBatch:
    """Inputs of the network: images [n, 6, h, w] in −0.5 … 0.5, state [n, 100], task and slot [n].

    A slot is a stretch of `SLOT_STEPS` steps since the start.
    """

    images: torch.Tensor
    state: torch.Tensor
    task: torch.Tensor
    slot: torch.Tensor

    def pick(self, index: torch.Tensor) -> "CloningBatch":
        """Some of the moments."""
        return CloningBatch(
            self.images[index], self.state[index], self.task[index], self.slot[index]
        )


def action_weights() -> np.ndarray:
    """What an error of one weighs per action number: 2 cm = 0.1 of rotation = 0.1 rad."""
    weights = np.full(ACTION_DIM, 10.0)
    for part in POSE_SLICES:
        weights[part.start : part.start + 3] = 50.0
    weights[CAMERA_HEAD] = 1.0
    return weights


def phase_features(step: np.ndarray, *, horizon_steps: int) -> np.ndarray:
    """Time since the start [n] as 8 smooth numbers; it stops at the horizon."""
    phase = np.clip(np.asarray(step, dtype=np.float64) / horizon_steps, 0.0, 1.0)[:, None]
    octaves = math.pi * phase * 2.0 ** np.arange(NUM_PHASE_FEATURES // 2)
    return np.concatenate([np.sin(octaves), np.cos(octaves)], axis=1)


class SpatialSoftmax(nn.Module):
    """Feature maps [n, c, h, w] to the expected image position of each: [n, 2c] in −1 … 1."""

    def forward(self, maps: torch.Tensor) -> torch.Tensor:
        """Expected column and row of every channel."""
        num, channels, height, width = maps.shape
        attention = maps.reshape(num, channels, -1).softmax(dim=-1).reshape(maps.shape)
        columns = torch.linspace(-1, 1, width)
        rows = torch.linspace(-1, 1, height)
        return torch.cat(
            [(attention.sum(2) * columns).sum(-1), (attention.sum(3) * rows).sum(-1)], dim=1
        )


class ChunkCodec(nn.Module):
    """Action chunks [n, 16, 67], relative to the current pose, as a few principal components.

    The mean chunk of a task and slot is taken off first, so that the network only has to tell how
    this moment differs from others of its kind. Linear and orthonormal in weighted units: the
    squared error of coefficients is the weighted squared error of actions.
    """

    mean: torch.Tensor
    basis: torch.Tensor
    weights: torch.Tensor

    def __init__(self, *, num_tasks: int, num_slots: int, num_components: int) -> None:
        super().__init__()
        self.register_buffer("mean", torch.zeros(num_tasks, num_slots, CHUNK_SIZE))
        self.register_buffer("basis", torch.zeros(num_components, CHUNK_SIZE))
        self.register_buffer("weights", torch.tensor(action_weights(), dtype=torch.float32))

    def fit(self, chunks: torch.Tensor, batch: CloningBatch) -> None:
        """Take means and principal components from training chunks [n, 16, 67].

        A slot without examples gets the mean of the nearest earlier one.
        """
        flat = (chunks * self.weights).flatten(1)
        for task in range(self.mean.shape[0]):
            for slot in range(self.mean.shape[1]):
                chosen = (batch.task == task) & (batch.slot == slot)
                known = bool(chosen.any())
                self.mean[task, slot] = (
                    flat[chosen].mean(0) if known else self.mean[task, max(slot - 1, 0)]
                )
        residual = flat - self.mean[batch.task, batch.slot]
        _, _, directions = torch.linalg.svd(residual, full_matrices=False)
        basis = directions[: len(self.basis)]
        # The sign of a direction is free: make its largest entry positive.
        largest = basis.gather(1, basis.abs().argmax(1, keepdim=True))
        self.basis[: len(basis)].copy_(basis * largest.sign())

    def encode(self, chunks: torch.Tensor, batch: CloningBatch) -> torch.Tensor:
        """Coefficients [n, k]."""
        flat = (chunks * self.weights).flatten(1)
        return (flat - self.mean[batch.task, batch.slot]) @ self.basis.T

    def decode(self, coefficients: torch.Tensor, batch: CloningBatch) -> torch.Tensor:
        """Chunks [n, 16, 67]."""
        flat = coefficients @ self.basis + self.mean[batch.task, batch.slot]
        return flat.reshape(-1, CHUNK_STEPS, ACTION_DIM) / self.weights


class CloningNetwork(nn.Module):
    """A small convolutional network with spatial softmax, and a multilayer perceptron on top."""

    reached_mean: torch.Tensor
    reached_scale: torch.Tensor
    coefficient_scale: torch.Tensor

    def __init__(self, *, num_tasks: int, num_slots: int, num_components: int, hidden: int) -> None:
        super().__init__()
        self.codec = ChunkCodec(
            num_tasks=num_tasks, num_slots=num_slots, num_components=num_components
        )
        self.register_buffer("reached_mean", torch.zeros(ACTION_DIM))
        self.register_buffer("reached_scale", torch.ones(ACTION_DIM))
        self.register_buffer("coefficient_scale", torch.ones(num_components))
        self.task = nn.Embedding(num_tasks, _TASK_FEATURES)
        first, second, third = _CHANNELS
        self.eye = nn.Sequential(
            nn.Conv2d(6, first, 5, stride=2, padding=2),
            nn.ReLU(),
            nn.Conv2d(first, second, 3, padding=1),
            nn.ReLU(),
            nn.Conv2d(second, third, 3, padding=1),
            SpatialSoftmax(),
        )
        self.head = nn.Sequential(
            nn.Linear(2 * third + STATE_DIM + _TASK_FEATURES, hidden),
            nn.ReLU(),
            nn.Linear(hidden, hidden),
            nn.ReLU(),
            nn.Linear(hidden, num_components),
        )

    def forward(self, batch: CloningBatch) -> torch.Tensor:
        """Codec coefficients [n, k] of the next chunk."""
        before, after = batch.state[:, : _REACHED.start], batch.state[:, _REACHED.stop :]
        reached = (self.reached(batch.state) - self.reached_mean) / self.reached_scale
        seen = self.eye(batch.images)
        features = torch.cat([seen, before, reached, after, self.task(batch.task)], dim=1)
        return torch.as_tensor(self.head(features)) * self.coefficient_scale

    @staticmethod
    def reached(state: torch.Tensor) -> torch.Tensor:
        """The part [n, 67] of the state that says where the hands are."""
        return state[:, _REACHED]
