"""Behaviour cloning policy: a closed-loop network on images, touch and poses."""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Float64, UInt8

from dextouch.clients import PolicyStart
from dextouch.errors import InvalidInputError, UnknownNameError
from dextouch.frozen_model import FrozenModel
from dextouch.hands.actions import (
    AnchorPoses,
    actions_from_poses,
    pose_to_9d,
    poses_from_actions,
)
from dextouch.schemas import Observation
from dextouch.streams import HEAD_CAMERA
from services.evaluation.policies.cloning_network import (
    SLOT_STEPS,
    CloningBatch,
    CloningNetwork,
    phase_features,
)
from services.evaluation.success_classifier import pad_features
from services.evaluation.trained_networks import Checkpoint, load_checkpoint, load_network

# Older checkpoints, "behaviour-cloning-policy", are incompatible: chunks began at the reached pose.
KIND = "cloned-policy"
_WORLD = AnchorPoses(np.eye(4), np.eye(4), np.eye(4))
# Coefficients are clipped to this many standard deviations from the mean chunk, so that no image or
# touch sends a hand far from all demonstrations.
MAX_DEVIATIONS = 5.0


class CloningShape(FrozenModel):
    """Shape of the network; stored in the checkpoint."""

    tasks: tuple[str, ...]
    num_components: int = 48
    hidden: int = 256
    horizon_steps: int = 80
    image_size_px: int = 64

    def network(self) -> CloningNetwork:
        """Untrained network of this shape."""
        return CloningNetwork(
            num_tasks=len(self.tasks),
            num_slots=self.num_slots,
            num_components=self.num_components,
            hidden=self.hidden,
        )

    @property
    def num_slots(self) -> int:
        """Time slots with a mean chunk of their own."""
        return self.horizon_steps // SLOT_STEPS + 1


@dataclass(frozen=True)
class CloningInput:
    """Input of the policy at one step."""

    first_image: UInt8[np.ndarray, "h w 3"]
    image: UInt8[np.ndarray, "h w 3"]
    tactile_kpa: np.ndarray
    anchor: AnchorPoses
    reached: Float64[np.ndarray, "67"]
    reached_is_measured: bool
    step: int
    task: str


def cloning_batch(inputs: Sequence[CloningInput], shape: CloningShape) -> CloningBatch:
    """Network tensors of inputs, for training and acting alike.

    Raises:
        UnknownNameError: a task that the network was not trained for.
        InvalidInputError: images of another size.
    """
    size = (shape.image_size_px, shape.image_size_px, 3)
    for item in inputs:
        if item.task not in shape.tasks:
            raise UnknownNameError("task of the cloned policy", item.task, list(shape.tasks))
        if item.image.shape != size or item.first_image.shape != size:
            raise InvalidInputError(
                f"cloned policy: got images {item.first_image.shape} and {item.image.shape}, "
                f"expected {size}"
            )
    return CloningBatch(
        scaled_images(torch.from_numpy(np.stack([i.first_image for i in inputs]))),
        torch.arange(len(inputs)),
        scaled_images(torch.from_numpy(np.stack([half_size(i.image) for i in inputs]))),
        *cloning_state(inputs, shape),
    )


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
    it needs the last step only (`looks`).

    Args:
        checkpoint: from `load_checkpoint` or from training.

    Raises:
        InvalidInputError: the weights do not match the shape in the metadata.
    """

    looks = "last"

    def __init__(self, checkpoint: Checkpoint) -> None:
        self.metadata = checkpoint.metadata
        self.shape = CloningShape.model_validate(checkpoint.metadata.settings["shape"])
        self._network = self.shape.network()
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
        """Start a new rollout.

        Raises:
            UnknownNameError: a task that the network was not trained for.
        """
        if start.task not in self.shape.tasks:
            raise UnknownNameError("task of the cloned policy", start.task, list(self.shape.tasks))
        self._start = start
        self._first_image = None

    def act(self, observation: Observation) -> Float64[np.ndarray, "16 67"]:
        """The next 16 commanded actions, relative to the rollout's step 0.

        Raises:
            InvalidInputError: `reset` was not called, or images of another size.
            UnknownNameError: the observation has no head camera.
        """
        if self._start is None:
            raise InvalidInputError("cloned policy: act before reset; call reset with the start")
        if HEAD_CAMERA not in observation.images:
            raise UnknownNameError("camera", HEAD_CAMERA, list(observation.images))
        image = observation.images[HEAD_CAMERA][-1]
        if self._first_image is None:
            self._first_image = observation.images[HEAD_CAMERA][0]
        moment = CloningInput(
            self._first_image,
            image,
            observation.tactile_kpa[-1],
            self._start.anchor,
            observation.action_reached[-1],
            observation.reached_is_measured,
            observation.first_step + len(observation) - 1,
            self._start.task,
        )
        with torch.no_grad():
            batch = cloning_batch([moment], self.shape)
            bound = MAX_DEVIATIONS * self._network.coefficient_scale
            coefficients = self._network(batch).clamp(-bound, bound)
            chunk = self._network.codec.decode(coefficients, batch.task, batch.slot)[0]
        return from_world(chunk.double().numpy(), moment.anchor)
