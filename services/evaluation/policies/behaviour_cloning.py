"""Behaviour cloning policy: a closed-loop network on images, touch, poses and time."""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Float64, UInt8
from torch import nn

from dextouch.clients import PolicyStart
from dextouch.errors import InvalidInputError, UnknownNameError
from dextouch.frozen_model import FrozenModel
from dextouch.hands.actions import (
    ACTION_DIM,
    CAMERA_HEAD,
    POSE_DIM,
    POSE_SLICES,
    AnchorPoses,
    actions_from_poses,
    pose_to_9d,
    poses_from_actions,
)
from dextouch.schemas import CHUNK_STEPS, Observation
from dextouch.streams import HEAD_CAMERA
from services.evaluation.endings import NUM_PAD_FEATURES, pad_features
from services.evaluation.trained_networks import Checkpoint, load_checkpoint, load_network

# Older checkpoints, "behaviour-cloning-policy", are incompatible: chunks began at the reached pose.
KIND = "cloned-policy"
_WORLD = AnchorPoses(np.eye(4), np.eye(4), np.eye(4))
# Coefficients are clipped to this many standard deviations from the mean chunk, so that no image or
# touch sends a hand far from all demonstrations.
MAX_DEVIATIONS = 5.0
CHUNK_SIZE = CHUNK_STEPS * ACTION_DIM
NUM_PHASE_FEATURES = 8
SLOT_STEPS = 8
# Current poses of hands and head (as an action), and their poses at step 0 (three poses).
NUM_POSE_FEATURES = ACTION_DIM + POSE_DIM * len(POSE_SLICES)
STATE_DIM = NUM_PAD_FEATURES + NUM_POSE_FEATURES + NUM_PHASE_FEATURES + 1
_POSES = slice(NUM_PAD_FEATURES, NUM_PAD_FEATURES + NUM_POSE_FEATURES)
_CHANNELS = (16, 24, 24)
_TASK_FEATURES = 8


class CloningShape(FrozenModel):
    """Shape of the network; stored in the checkpoint."""

    tasks: tuple[str, ...]
    num_components: int = 48
    hidden: int = 256
    horizon_steps: int = 80
    image_size_px: int = 64

    @property
    def num_slots(self) -> int:
        """Time slots with a mean chunk of their own."""
        return self.horizon_steps // SLOT_STEPS + 1


@dataclass(frozen=True)
class CloningBatch:
    """Inputs of the network; all images are in −0.5 … 0.5.

    `first` [m, 3, h, w] are first images of rollouts, `rollout` [n] the index of that of each
    sample, `newest` [n, 3, h/2, w/2] current images at half size. `state` [n, 127] holds pad
    features, the reached action with poses in the world, the poses of step 0 in the world, the
    phase, and whether the reached action was measured. `slot` [n] counts `SLOT_STEPS` steps since
    the start.
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


def spatial_softmax(maps: torch.Tensor) -> torch.Tensor:
    """Expected columns and rows, [n, 2c] in −1 … 1, of each of the feature maps [n, c, h, w]."""
    attention = maps.flatten(2).softmax(dim=-1).reshape(maps.shape)
    columns = torch.linspace(-1, 1, maps.shape[3])
    rows = torch.linspace(-1, 1, maps.shape[2])
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

    def __init__(self, shape: CloningShape) -> None:
        super().__init__()
        self.register_buffer("mean", torch.zeros(len(shape.tasks), shape.num_slots, CHUNK_SIZE))
        self.register_buffer("basis", torch.zeros(shape.num_components, CHUNK_SIZE))
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

    def forward(self, images: torch.Tensor, task: torch.Tensor) -> torch.Tensor:
        """Features [n, 48] of images [n, 3, h, w], for task features [n, 8]."""
        biases = self.wanted(task)[:, :, None, None].split(_CHANNELS[:2], dim=1)
        images = images.contiguous(memory_format=torch.channels_last)
        maps = torch.relu(self.coarse(images) + biases[0])
        maps = torch.relu(self.middle(maps) + biases[1])
        return spatial_softmax(self.fine(maps).float())


class CloningNetwork(nn.Module):
    """A small convolutional network with spatial softmax, followed by a multilayer perceptron."""

    pose_mean: torch.Tensor
    pose_scale: torch.Tensor
    coefficient_scale: torch.Tensor

    def __init__(self, shape: CloningShape) -> None:
        super().__init__()
        self.codec = ChunkCodec(shape)
        self.register_buffer("pose_mean", torch.zeros(NUM_POSE_FEATURES))
        self.register_buffer("pose_scale", torch.ones(NUM_POSE_FEATURES))
        self.register_buffer("coefficient_scale", torch.ones(shape.num_components))
        self.task = nn.Embedding(len(shape.tasks), _TASK_FEATURES)
        self.first_eye = CloningEye()
        self.newest_eye = CloningEye()
        self.head = nn.Sequential(
            nn.Linear(2 * CloningEye.num_features + STATE_DIM + _TASK_FEATURES, shape.hidden),
            nn.ReLU(),
            nn.Linear(shape.hidden, shape.hidden),
            nn.ReLU(),
            nn.Linear(shape.hidden, shape.num_components),
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


@dataclass(frozen=True)
class CloningInput:
    """Input of the policy at one step, beside images."""

    tactile_kpa: np.ndarray
    anchor: AnchorPoses
    reached: Float64[np.ndarray, "67"]
    reached_is_measured: bool
    step: int
    task: str


def half_size(image: UInt8[np.ndarray, "h w 3"]) -> UInt8[np.ndarray, "half_h half_w 3"]:
    """Average 2 × 2 pixels; an odd last row or column is dropped."""
    height, width = image.shape[0] // 2, image.shape[1] // 2
    blocks = image[: 2 * height, : 2 * width].reshape(height, 2, width, 2, 3)
    return np.rint(blocks.mean(axis=(1, 3))).astype(np.uint8)


def scaled_images(images: torch.Tensor) -> torch.Tensor:
    """Convert bytes [..., h, w, 3] to network input [..., 3, h, w] in −0.5 … 0.5."""
    return images.movedim(-1, -3).float() / 255 - 0.5


def cloning_state(
    inputs: Sequence[CloningInput], shape: CloningShape
) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
    """State, task and slot of inputs: a `CloningBatch` without its images."""
    state = np.concatenate(
        [
            pad_features(np.stack([i.tactile_kpa for i in inputs])),
            np.concatenate([in_world(i.reached[None], i.anchor) for i in inputs]),
            np.stack([pose_to_9d(np.stack(i.anchor.as_tuple())).ravel() for i in inputs]),
            phase_features(np.array([i.step for i in inputs]), horizon_steps=shape.horizon_steps),
            np.array([[float(i.reached_is_measured)] for i in inputs]),
        ],
        axis=1,
    )
    return (
        torch.tensor(state, dtype=torch.float32),
        torch.tensor([shape.tasks.index(i.task) for i in inputs]),
        torch.tensor([min(i.step // SLOT_STEPS, shape.num_slots - 1) for i in inputs]),
    )


def in_world(actions: np.ndarray, anchor: AnchorPoses) -> Float64[np.ndarray, "steps 67"]:
    """Convert actions [K, 67] relative to the anchor to absolute poses."""
    return actions_from_poses(poses_from_actions(actions, anchor), _WORLD)


def from_world(actions: np.ndarray, anchor: AnchorPoses) -> Float64[np.ndarray, "steps 67"]:
    """Inverse of `in_world`."""
    return actions_from_poses(poses_from_actions(actions, _WORLD), anchor)


class BehaviourCloningPolicy:
    """Sends the next 16 actions, given the newest image, touch and pose.

    The only state between `reset` calls is the rollout's first image and anchor. Of an observation
    it needs the last step only (`uses_images`). Raises InvalidInputError if the weights do not
    match the shape in the metadata.
    """

    uses_images = "last"

    def __init__(self, checkpoint: Checkpoint) -> None:
        self.metadata = checkpoint.metadata
        self.shape = CloningShape.model_validate(checkpoint.metadata.settings["shape"])
        self._network = CloningNetwork(self.shape)
        load_network(self._network, checkpoint)
        self._start: PolicyStart | None = None
        self._first_image: np.ndarray | None = None

    @property
    def tasks(self) -> tuple[str, ...]:
        """The tasks it was trained on."""
        return self.shape.tasks

    @classmethod
    def load(cls, path: Path) -> "BehaviourCloningPolicy":
        """Load a policy from its file."""
        return cls(load_checkpoint(path, kind=KIND))

    def reset(self, start: PolicyStart) -> None:
        """Start a new rollout; raises UnknownNameError for a task that it was not trained for."""
        if start.task not in self.shape.tasks:
            raise UnknownNameError("task of the cloned policy", start.task, list(self.shape.tasks))
        self._start = start
        self._first_image = None

    def act(self, observation: Observation) -> Float64[np.ndarray, "16 67"]:
        """The next 16 commanded actions, relative to the rollout's step 0.

        Raises InvalidInputError before `reset` or for images of another size, and UnknownNameError
        without a head camera.
        """
        if self._start is None:
            raise InvalidInputError("cloned policy: act before reset; call reset with the start")
        if HEAD_CAMERA not in observation.images:
            raise UnknownNameError("camera", HEAD_CAMERA, list(observation.images))
        image = observation.images[HEAD_CAMERA][-1]
        size = (self.shape.image_size_px, self.shape.image_size_px, 3)
        if image.shape != size:
            raise InvalidInputError(f"cloned policy: got images {image.shape}, expected {size}")
        if self._first_image is None:
            self._first_image = observation.images[HEAD_CAMERA][0]
        moment = CloningInput(
            observation.tactile_kpa[-1],
            self._start.anchor,
            observation.action_reached[-1],
            observation.reached_is_measured,
            observation.first_step + len(observation) - 1,
            self._start.task,
        )
        with torch.no_grad():
            batch = CloningBatch(
                # A copy, since images of observations may be read-only.
                scaled_images(torch.tensor(self._first_image[None])),
                torch.zeros(1, dtype=torch.long),
                scaled_images(torch.from_numpy(half_size(image)[None])),
                *cloning_state([moment], self.shape),
            )
            bound = MAX_DEVIATIONS * self._network.coefficient_scale
            coefficients = self._network(batch).clamp(-bound, bound)
            chunk = self._network.codec.decode(coefficients, batch.task, batch.slot)[0]
        return from_world(chunk.double().numpy(), moment.anchor)
