"""Network of behaviour cloning: predicts action chunks from images, touch, poses and time."""

import math
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np
import torch
from jaxtyping import Float32, Float64, UInt8
from torch import nn

from dextouch.episodes import (
    TRUE_ORIGINS,
    EpisodeGrid,
    EpisodeReader,
    EpisodeStore,
    Split,
    needs,
    select_episodes,
)
from dextouch.hands.actions import ACTION_DIM, CAMERA_HEAD, POSE_DIM, POSE_SLICES, AnchorPoses
from dextouch.schemas import CHUNK_STEPS, Origin
from services.evaluation.matched_starts import start_digest
from services.evaluation.success_classifier import NUM_PAD_FEATURES
from services.networks.training_settings import USUAL_IMAGE_PX

CHUNK_SIZE = CHUNK_STEPS * ACTION_DIM
NUM_PHASE_FEATURES = 8
SLOT_STEPS = 8
# Current poses of hands and head (as an action), and their poses at step 0 (three poses).
NUM_POSE_FEATURES = ACTION_DIM + POSE_DIM * len(POSE_SLICES)
STATE_DIM = NUM_PAD_FEATURES + NUM_POSE_FEATURES + NUM_PHASE_FEATURES + 1
_POSES = slice(NUM_PAD_FEATURES, NUM_PAD_FEATURES + NUM_POSE_FEATURES)
_CHANNELS = (16, 24, 24)
_TASK_FEATURES = 8


@dataclass(frozen=True)
class CloningBatch:
    """Inputs of the network; all images are in −0.5 … 0.5.

    Args:
        first: [m, 3, h, w], first images of rollouts.
        rollout: [n], index of the first image of each sample.
        newest: [n, 3, h/2, w/2], current images at half size.
        state: [n, 127]: pad features, the reached action with poses in the world, the poses of
            step 0 in the world, the phase, and whether the reached action was measured.
        task: [n].
        slot: [n], number of `SLOT_STEPS` steps since the start.
    """

    first: torch.Tensor
    rollout: torch.Tensor
    newest: torch.Tensor
    state: torch.Tensor
    task: torch.Tensor
    slot: torch.Tensor


def action_weights() -> np.ndarray:
    """Error weights of the action numbers: 2 cm = 0.1 of rotation = 0.1 rad."""
    weights = np.full(ACTION_DIM, 10.0)
    for part in POSE_SLICES:
        weights[part.start : part.start + 3] = 50.0
    weights[CAMERA_HEAD] = 1.0
    return weights


def phase_features(step: np.ndarray, *, horizon_steps: int) -> np.ndarray:
    """Time since the start [n] as 8 smooth features; it saturates at the horizon."""
    phase = np.clip(np.asarray(step, dtype=np.float64) / horizon_steps, 0.0, 1.0)[:, None]
    octaves = math.pi * phase * 2.0 ** np.arange(NUM_PHASE_FEATURES // 2)
    return np.concatenate([np.sin(octaves), np.cos(octaves)], axis=1)


class SpatialSoftmax(nn.Module):
    """Expected image position, [n, 2c] in −1 … 1, of each of the feature maps [n, c, h, w]."""

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
    """Principal components of action chunks [n, 16, 67] with poses in the world.

    The mean chunk of a task and slot is subtracted first, so that the network only predicts the
    deviation from it. Linear and orthonormal in weighted units: the squared error of coefficients
    is the weighted squared error of actions.
    """

    mean: torch.Tensor
    basis: torch.Tensor
    weights: torch.Tensor

    def __init__(self, *, num_tasks: int, num_slots: int, num_components: int) -> None:
        super().__init__()
        self.register_buffer("mean", torch.zeros(num_tasks, num_slots, CHUNK_SIZE))
        self.register_buffer("basis", torch.zeros(num_components, CHUNK_SIZE))
        self.register_buffer("weights", torch.tensor(action_weights(), dtype=torch.float32))

    def fit(self, chunks: torch.Tensor, tasks: torch.Tensor, slots: torch.Tensor) -> None:
        """Fit means and principal components to training chunks [n, 16, 67].

        A slot without examples gets the mean of the nearest earlier one.
        """
        flat = (chunks * self.weights).flatten(1)
        for task in range(self.mean.shape[0]):
            for slot in range(self.mean.shape[1]):
                chosen = (tasks == task) & (slots == slot)
                known = bool(chosen.any())
                self.mean[task, slot] = (
                    flat[chosen].mean(0) if known else self.mean[task, max(slot - 1, 0)]
                )
        residual = flat - self.mean[tasks, slots]
        _, _, directions = torch.linalg.svd(residual, full_matrices=False)
        basis = directions[: len(self.basis)]
        # Signs are arbitrary: the largest entry of each direction is made positive.
        largest = basis.gather(1, basis.abs().argmax(1, keepdim=True))
        self.basis[: len(basis)].copy_(basis * largest.sign())

    def encode(
        self, chunks: torch.Tensor, tasks: torch.Tensor, slots: torch.Tensor
    ) -> torch.Tensor:
        """Coefficients [n, k]."""
        flat = (chunks * self.weights).flatten(1)
        return (flat - self.mean[tasks, slots]) @ self.basis.T

    def decode(
        self, coefficients: torch.Tensor, tasks: torch.Tensor, slots: torch.Tensor
    ) -> torch.Tensor:
        """Chunks [n, 16, 67]."""
        flat = coefficients @ self.basis + self.mean[tasks, slots]
        return flat.reshape(-1, CHUNK_STEPS, ACTION_DIM) / self.weights


class CloningEye(nn.Module):
    """Image positions of task-relevant features: 2 numbers for each of 24 feature maps."""

    num_features = 2 * _CHANNELS[-1]

    def __init__(self) -> None:
        super().__init__()
        first, second, third = _CHANNELS
        self.coarse = nn.Conv2d(3, first, 5, stride=2, padding=2)
        self.middle = nn.Conv2d(first, second, 3, padding=1)
        self.fine = nn.Conv2d(second, third, 3, padding=1)
        # The relevant features depend on the task.
        self.wanted = nn.Linear(_TASK_FEATURES, first + second)
        self.places = SpatialSoftmax()

    def forward(self, images: torch.Tensor, task: torch.Tensor) -> torch.Tensor:
        """Features [n, 48] of images [n, 3, h, w], for task features [n, 8]."""
        biases = self.wanted(task)[:, :, None, None].split(_CHANNELS[:2], dim=1)
        images = images.contiguous(memory_format=torch.channels_last)
        maps = torch.relu(self.coarse(images) + biases[0])
        maps = torch.relu(self.middle(maps) + biases[1])
        return torch.as_tensor(self.places(self.fine(maps).float()))


class CloningNetwork(nn.Module):
    """A small convolutional network with spatial softmax, followed by a multilayer perceptron."""

    pose_mean: torch.Tensor
    pose_scale: torch.Tensor
    coefficient_scale: torch.Tensor

    def __init__(self, *, num_tasks: int, num_slots: int, num_components: int, hidden: int) -> None:
        super().__init__()
        self.codec = ChunkCodec(
            num_tasks=num_tasks, num_slots=num_slots, num_components=num_components
        )
        self.register_buffer("pose_mean", torch.zeros(NUM_POSE_FEATURES))
        self.register_buffer("pose_scale", torch.ones(NUM_POSE_FEATURES))
        self.register_buffer("coefficient_scale", torch.ones(num_components))
        self.task = nn.Embedding(num_tasks, _TASK_FEATURES)
        self.first_eye = CloningEye()
        self.newest_eye = CloningEye()
        self.head = nn.Sequential(
            nn.Linear(2 * CloningEye.num_features + STATE_DIM + _TASK_FEATURES, hidden),
            nn.ReLU(),
            nn.Linear(hidden, hidden),
            nn.ReLU(),
            nn.Linear(hidden, num_components),
        )

    def forward(self, batch: CloningBatch) -> torch.Tensor:
        """Codec coefficients [n, k] of the next chunk.

        In training, convolutions run in bfloat16, which halves the time.
        """
        before, after = batch.state[:, : _POSES.start], batch.state[:, _POSES.stop :]
        poses = (self.poses(batch.state) - self.pose_mean) / self.pose_scale
        task = self.task(batch.task)
        task_of_first = torch.zeros(len(batch.first), dtype=torch.long)
        task_of_first[batch.rollout] = batch.task
        with torch.autocast("cpu", dtype=torch.bfloat16, enabled=self.training):
            first = self.first_eye(batch.first, self.task(task_of_first)).float()
            newest = self.newest_eye(batch.newest, task).float()
        features = [first[batch.rollout], newest, before, poses, after, task]
        return torch.as_tensor(self.head(torch.cat(features, dim=1))) * self.coefficient_scale

    @staticmethod
    def poses(state: torch.Tensor) -> torch.Tensor:
        """Part [n, 94] of the state with the current and initial poses of hands and head."""
        return state[:, _POSES]


# Training episodes of behaviour cloning: successful robot episodes at decision steps only.

# Training uses every such step; an evaluation with chunks of 16 decides at every second of them.
DECISION_STRIDE: Final = SLOT_STEPS
# What an episode of a cloned policy must have.
IMITATED: Final = (needs.WHOLE, needs.OUTCOME, needs.SUCCESS, needs.image_every(DECISION_STRIDE))


@dataclass(frozen=True)
class Moment:
    """Image and touch at one step."""

    image: UInt8[np.ndarray, "h w 3"]
    tactile_kpa: Float32[np.ndarray, "2 320"]


@dataclass(frozen=True)
class CloningEpisode:
    """One robot episode: measured and commanded actions at every step, observations at some.

    `commanded` are the measured ones where the episode has no commands. Both actions are relative
    to the measured poses of step 0, which are `anchor`. `moments` maps steps to observations and
    includes step 0. `start_digest` is that of the first observation as recorded.
    """

    episode_id: str
    task: str
    instruction: str
    scene: str
    success: bool
    anchor: AnchorPoses
    moments: Mapping[int, Moment]
    measured: Float64[np.ndarray, "steps 67"]
    commanded: Float64[np.ndarray, "steps 67"]
    start_digest: str
    content_sha256: str

    @property
    def num_steps(self) -> int:
        """Steps of the model grid, including the first one."""
        return len(self.measured)


def read_cloning_episode(
    reader: EpisodeReader, *, image_px: int = USUAL_IMAGE_PX
) -> CloningEpisode:
    """Read one robot episode; only images at decision steps are decoded.

    Args:
        reader: the episode; it must have what is `IMITATED`.
        image_px: side that the middle square of larger images is scaled to.

    Raises:
        InvalidInputError: the outcome is unknown.
    """
    grid, about = EpisodeGrid(reader, image_px), reader.attributes
    steps = range(0, len(grid), DECISION_STRIDE)
    touch_kpa, _ = grid.touch()
    return CloningEpisode(
        about.episode_id,
        about.task,
        about.instruction,
        grid.scene,
        grid.success,
        grid.anchor,
        {
            step: Moment(image, touch_kpa[step].copy())
            for step, image in zip(steps, grid.images(steps), strict=True)
        },
        grid.measured,
        grid.sent,
        start_digest(EpisodeGrid(reader).images([0])[0], touch_kpa[0]),
        grid.content_sha256,
    )


def read_cloning_episodes(
    *stores: EpisodeStore,
    tasks: Sequence[str] = (),
    splits: Collection[Split] = (),
    image_px: int = USUAL_IMAGE_PX,
    imagined: bool = False,
) -> list[CloningEpisode]:
    """Read the successful robot episodes of some stores, store by store in the order of ids.

    Args:
        stores: stores to read.
        tasks: tasks to read; empty for all.
        splits: splits of the scenes; empty for all.
        image_px: side that the middle square of larger images is scaled to.
        imagined: whether imagined episodes are read instead of true ones.

    Raises:
        NotFoundError, ConflictError: as `select_episodes`.
    """
    origins: Collection[Origin] = ("imagined",) if imagined else TRUE_ORIGINS
    readers = select_episodes(
        stores, domain="robot", tasks=tasks, splits=splits, origins=origins, needs=IMITATED
    )
    return [read_cloning_episode(reader, image_px=image_px) for reader in readers]
