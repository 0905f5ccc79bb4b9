"""Success probe: a small network that tells from the end of a rollout whether it succeeded."""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Float32, Float64, Int64, UInt8
from pydantic import BaseModel, ConfigDict
from torch import nn

from dextouch.errors import InvalidInputError, UnknownNameError
from services.evaluation.checkpoints import Checkpoint, load_checkpoint, load_weights
from services.evaluation.features import NUM_PAD_FEATURES, pad_features

# Version 2 of the network; checkpoints of the first are refused by this name.
KIND = "success-probe-2"
NUM_SEEN_STEPS = 3
DECISION_THRESHOLD = 0.5
_CHANNELS = (24, 32, 48, 48)
_TASK_FEATURES = 8


class ProbeShape(BaseModel):
    """What the probe looks like; kept in the checkpoint."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    tasks: tuple[str, ...]
    hidden: int = 64
    image_size_px: int = 64


@dataclass(frozen=True)
class Ending:
    """The last three steps of a rollout: head images, and taxels in kPa."""

    images: UInt8[np.ndarray, "3 h w 3"]
    tactile_kpa: Float32[np.ndarray, "3 2 320"]
    task: str


@dataclass(frozen=True)
class ProbeBatch:
    """Inputs of the network: last images as bytes, mean touch of the three steps, task index."""

    images: UInt8[torch.Tensor, "n 3 h w"]
    touch: Float32[torch.Tensor, "n 24"]
    task: Int64[torch.Tensor, " n"]

    def __getitem__(self, index: torch.Tensor) -> "ProbeBatch":
        """Some of the endings."""
        return ProbeBatch(self.images[index], self.touch[index], self.task[index])


class ProbeNetwork(nn.Module):
    """Four strided convolutions on the last image, touch and task beside them, two linear layers.

    The image is all that shows how well an object stands. Few features reach the linear layers,
    so that they learn where things lie and not one training episode from another.
    """

    def __init__(self, shape: ProbeShape) -> None:
        super().__init__()
        layers: list[nn.Module] = []
        channels = 3
        for width in _CHANNELS:
            layers.append(nn.Conv2d(channels, width, 3, stride=2, padding=1))
            layers += [nn.BatchNorm2d(width), nn.GELU()]
            channels = width
        side = -(-shape.image_size_px // 2 ** len(_CHANNELS))
        num_features = channels * side * side + NUM_PAD_FEATURES + _TASK_FEATURES
        self.eye = nn.Sequential(*layers, nn.Flatten())
        self.task = nn.Embedding(len(shape.tasks), _TASK_FEATURES)
        self.head = nn.Sequential(
            nn.Dropout(0.3), nn.Linear(num_features, shape.hidden), nn.GELU(),
            nn.Linear(shape.hidden, 1),
        )  # fmt: skip

    def forward(self, batch: ProbeBatch) -> torch.Tensor:
        """Log odds [n] of success."""
        return self.judge(unit_images(batch.images), batch.touch, batch.task)

    def judge(
        self, images: torch.Tensor, touch: torch.Tensor, task: torch.Tensor
    ) -> Float32[torch.Tensor, " n"]:
        """Log odds of images [n, 3, h, w] in −0.5 … 0.5 with their touch and task."""
        parts = [self.eye(images), touch, self.task(task)]
        return torch.as_tensor(self.head(torch.cat(parts, dim=1)))[:, 0]


def unit_images(images: UInt8[torch.Tensor, "n 3 h w"]) -> Float32[torch.Tensor, "n 3 h w"]:
    """Bytes as −0.5 … 0.5."""
    return images.float() / 255 - 0.5


def probe_batch(endings: Sequence[Ending], shape: ProbeShape) -> ProbeBatch:
    """Network tensors of endings; the same code serves training and judging.

    Raises:
        UnknownNameError: a task the probe was not made for.
        InvalidInputError: images of another size.
    """
    size = (NUM_SEEN_STEPS, shape.image_size_px, shape.image_size_px, 3)
    for ending in endings:
        if ending.task not in shape.tasks:
            raise UnknownNameError("task of the success probe", ending.task, list(shape.tasks))
        if ending.images.shape != size:
            raise InvalidInputError(
                f"success probe: got images {ending.images.shape}, expected {size}"
            )
    images = torch.from_numpy(np.stack([e.images[-1] for e in endings]))
    touch = pad_features(np.stack([e.tactile_kpa for e in endings])).mean(axis=1)
    return ProbeBatch(
        images.permute(0, 3, 1, 2).contiguous(),
        torch.from_numpy(touch),
        torch.tensor([shape.tasks.index(e.task) for e in endings]),
    )


class SuccessProbe:
    """A trained probe.

    Args:
        checkpoint: from `load_checkpoint` or straight from training.

    Raises:
        CorruptDataError: weights that do not fit the shape in the metadata.
    """

    def __init__(self, checkpoint: Checkpoint) -> None:
        self.metadata = checkpoint.metadata
        self.shape = ProbeShape.model_validate(checkpoint.metadata.settings["shape"])
        self._network = ProbeNetwork(self.shape)
        load_weights(self._network, checkpoint, prefix="network")
        self._network.eval()

    @classmethod
    def load(cls, path: Path) -> "SuccessProbe":
        """A probe from its file."""
        return cls(load_checkpoint(path, kind=KIND))

    def probabilities(self, endings: Sequence[Ending]) -> Float64[np.ndarray, " n"]:
        """Probability of success of each ending.

        Raises:
            UnknownNameError: a task the probe was not made for.
            InvalidInputError: no endings, or images of another size.
        """
        if not endings:
            raise InvalidInputError("success probe: got no endings, expected at least one")
        with torch.no_grad():
            odds = self._network(probe_batch(endings, self.shape))
        return torch.sigmoid(odds.double()).numpy()

    def probability(self, ending: Ending) -> float:
        """Probability of success of one ending."""
        return float(self.probabilities([ending])[0])
