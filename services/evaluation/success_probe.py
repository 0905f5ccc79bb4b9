"""The last images and taxels of a rollout in; the probability that the task succeeded out."""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Float32, Float64, UInt8
from pydantic import BaseModel, ConfigDict
from torch import nn

from dextouch.errors import InvalidInputError, UnknownNameError
from services.evaluation.checkpoints import Checkpoint, load_checkpoint, load_weights
from services.evaluation.features import NUM_PAD_FEATURES, pad_features

KIND = "success-probe"
NUM_SEEN_STEPS = 3
DECISION_THRESHOLD = 0.5
_CHANNELS = (16, 32, 32)
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
    """Inputs of the network: images [n, 9, h, w] in −0.5 … 0.5, touch [n, 72], task index [n]."""

    images: torch.Tensor
    touch: torch.Tensor
    task: torch.Tensor


class ProbeNetwork(nn.Module):
    """Three strided convolutions and two linear layers."""

    def __init__(self, shape: ProbeShape) -> None:
        super().__init__()
        layers: list[nn.Module] = []
        channels = 3 * NUM_SEEN_STEPS
        for width in _CHANNELS:
            layers += [nn.Conv2d(channels, width, 3, stride=2, padding=1), nn.ReLU()]
            channels = width
        side = -(-shape.image_size_px // 2 ** len(_CHANNELS))
        num_features = channels * side * side + NUM_SEEN_STEPS * NUM_PAD_FEATURES + _TASK_FEATURES
        self.eye = nn.Sequential(*layers, nn.Flatten())
        self.task = nn.Embedding(len(shape.tasks), _TASK_FEATURES)
        self.head = nn.Sequential(
            nn.Dropout(0.2), nn.Linear(num_features, shape.hidden), nn.ReLU(),
            nn.Linear(shape.hidden, 1),
        )  # fmt: skip

    def forward(self, batch: ProbeBatch) -> torch.Tensor:
        """Log odds [n] of success."""
        parts = [self.eye(batch.images), batch.touch, self.task(batch.task)]
        return torch.as_tensor(self.head(torch.cat(parts, dim=1)))[:, 0]


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
    images = torch.from_numpy(np.stack([e.images for e in endings])).float() / 255 - 0.5
    touch = pad_features(np.stack([e.tactile_kpa for e in endings]))
    return ProbeBatch(
        images.permute(0, 1, 4, 2, 3).flatten(1, 2),
        torch.from_numpy(touch).flatten(1),
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
