"""Network of the success classifier: final image, touch and, where known, object poses."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, fields
from typing import cast

import numpy as np
import torch
from jaxtyping import Bool, Float32, Int64, UInt8
from torch import nn

from dextouch.errors import InvalidInputError, UnknownNameError
from dextouch.frozen_model import FrozenModel
from services.evaluation.endings import NUM_SEEN_STEPS, Ending
from services.evaluation.features import NUM_PAD_FEATURES, pad_features
from services.evaluation.object_features import NUM_OBJECT_FEATURES, object_features

NUM_TOUCH_FEATURES = 2 * NUM_PAD_FEATURES
_CHANNELS = (24, 32, 48, 48)
_OBJECT_HIDDEN, _OBJECT_OUTPUT = 64, 32
# Pose features are clipped to this many standard deviations.
_FARTHEST = 5.0


class ClassifierShape(FrozenModel):
    """Shape of the probe's network; stored in the checkpoint.

    `milestones` are the further outputs of each task, in their order.
    """

    tasks: tuple[str, ...]
    hidden: int = 64
    image_size_px: int = 64
    milestones: Mapping[str, tuple[str, ...]] = {}

    @property
    def num_outputs(self) -> int:
        """Success and the milestones of the task with the most of them."""
        return 1 + max((len(names) for names in self.milestones.values()), default=0)


@dataclass(frozen=True)
class ClassifierBatch:
    """Inputs of the network: last images as bytes, touch, features of object poses, task index.

    Missing inputs are zero and marked in `has_image` and `has_objects`. `imagined` is used in
    training only; the network does not see it.
    """

    images: UInt8[torch.Tensor, "n 3 h w"]
    touch: Float32[torch.Tensor, "n 48"]
    objects: Float32[torch.Tensor, "n 105"]
    task: Int64[torch.Tensor, " n"]
    has_image: Bool[torch.Tensor, " n"]
    has_objects: Bool[torch.Tensor, " n"]
    imagined: Bool[torch.Tensor, " n"]

    def __getitem__(self, index: torch.Tensor) -> "ClassifierBatch":
        """Select endings."""
        return ClassifierBatch(*(getattr(self, part.name)[index] for part in fields(self)))


class TaskNetwork(nn.Module):
    """Network of one task: four strided convolutions on the image, two layers on the poses.

    Few image features reach the last layers, so that they encode positions instead of memorizing
    training episodes. Pose features are standardized with the task's `object_mean` and
    `object_std`, which training sets.
    """

    object_mean: torch.Tensor
    object_std: torch.Tensor

    def __init__(self, shape: ClassifierShape) -> None:
        super().__init__()
        layers: list[nn.Module] = []
        channels = 3
        for width in _CHANNELS:
            layers.append(nn.Conv2d(channels, width, 3, stride=2, padding=1))
            layers += [nn.BatchNorm2d(width), nn.GELU()]
            channels = width
        side = -(-shape.image_size_px // 2 ** len(_CHANNELS))
        num_features = channels * side * side + NUM_TOUCH_FEATURES + _OBJECT_OUTPUT + 2
        self.eye = nn.Sequential(*layers, nn.Flatten())
        self.objects = nn.Sequential(
            nn.Linear(NUM_OBJECT_FEATURES, _OBJECT_HIDDEN), nn.GELU(),
            nn.Linear(_OBJECT_HIDDEN, _OBJECT_OUTPUT), nn.GELU(),
        )  # fmt: skip
        self.head = nn.Sequential(
            nn.Dropout(0.3), nn.Linear(num_features, shape.hidden), nn.GELU(),
            nn.Linear(shape.hidden, shape.num_outputs),
        )  # fmt: skip
        self.register_buffer("object_mean", torch.zeros(NUM_OBJECT_FEATURES))
        self.register_buffer("object_std", torch.ones(NUM_OBJECT_FEATURES))

    def forward(
        self, images: Float32[torch.Tensor, "n 3 h w"], batch: ClassifierBatch
    ) -> Float32[torch.Tensor, "n outputs"]:
        """Log odds of a batch with images given separately in −0.5 … 0.5."""
        usual = (batch.objects - self.object_mean) / self.object_std
        poses = self.objects(usual.clamp(-_FARTHEST, _FARTHEST))
        has_image, has_objects = batch.has_image[:, None], batch.has_objects[:, None]
        parts = [
            self.eye(images) * has_image,
            poses * has_objects,
            batch.touch,
            has_image.float(),
            has_objects.float(),
        ]
        return torch.as_tensor(self.head(torch.cat(parts, dim=1)))


class ClassifierNetwork(nn.Module):
    """One network per task.

    A network shared by six tasks has to recognize the task in the image before it can resolve
    millimetres: at equal cost it separates stacked from tilted bowls far worse.
    """

    def __init__(self, shape: ClassifierShape) -> None:
        super().__init__()
        self.num_outputs = shape.num_outputs
        self.tasks = nn.ModuleDict({task: TaskNetwork(shape) for task in shape.tasks})

    def of(self, task: str) -> TaskNetwork:
        """The network of one task."""
        return cast("TaskNetwork", self.tasks[task])

    def forward(self, batch: ClassifierBatch) -> Float32[torch.Tensor, "n outputs"]:
        """Log odds [n, outputs] of success and of the milestones of the task."""
        odds = torch.zeros((len(batch.task), self.num_outputs))
        for index, network in enumerate(self.tasks.values()):
            rows = torch.nonzero(batch.task == index)[:, 0]
            if len(rows):
                mine = batch[rows]
                odds[rows] = network(unit_images(mine.images), mine)
        return odds


def unit_images(images: UInt8[torch.Tensor, "n 3 h w"]) -> Float32[torch.Tensor, "n 3 h w"]:
    """Scale bytes to −0.5 … 0.5."""
    return images.float() / 255 - 0.5


def probe_batch(endings: Sequence[Ending], shape: ClassifierShape) -> ClassifierBatch:
    """Network tensors of endings, for training and prediction alike.

    Raises:
        UnknownNameError: a task that the probe was not trained for.
        InvalidInputError: images of another size, or neither images nor object poses.
    """
    for ending in endings:
        _check(ending, shape)
    size_px = shape.image_size_px
    nothing = np.zeros((size_px, size_px, 3), np.uint8)
    unknown = np.zeros(NUM_OBJECT_FEATURES, np.float32)
    images = np.stack([nothing if e.images is None else e.images[-1] for e in endings])
    objects = [
        unknown if e.object_poses is None else object_features(e.object_poses) for e in endings
    ]
    touch = pad_features(np.stack([e.tactile_kpa for e in endings]))
    return ClassifierBatch(
        torch.from_numpy(images).permute(0, 3, 1, 2).contiguous(),
        torch.from_numpy(np.concatenate([touch.mean(axis=1), touch[:, -1]], axis=1)),
        torch.from_numpy(np.stack(objects)),
        torch.tensor([shape.tasks.index(e.task) for e in endings]),
        torch.tensor([e.images is not None for e in endings]),
        torch.tensor([e.object_poses is not None for e in endings]),
        torch.tensor([e.imagined for e in endings]),
    )


def _check(ending: Ending, shape: ClassifierShape) -> None:
    size = (NUM_SEEN_STEPS, shape.image_size_px, shape.image_size_px, 3)
    if ending.task not in shape.tasks:
        raise UnknownNameError("task of the success classifier", ending.task, list(shape.tasks))
    if ending.images is None and ending.object_poses is None:
        raise InvalidInputError(
            f"success classifier: an ending of {ending.task!r} has neither images nor object "
            "poses; request the images of the last chunk"
        )
    if ending.images is not None and ending.images.shape != size:
        raise InvalidInputError(
            f"success classifier: got images {ending.images.shape}, expected {size}"
        )
