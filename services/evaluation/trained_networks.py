"""Networks of the evaluation: their training loop, and checkpoints of weights with provenance."""

from collections.abc import Callable, Collection, Iterable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch
from torch import Tensor, nn

from dextouch.errors import InvalidInputError, LimitExceededError
from dextouch.frozen_model import FrozenModel
from services.evaluation.progress import Progress
from services.networks import weight_files
from services.networks.optimizer import Budget, OptimizerLoop, OptimizerOptions
from services.networks.training_settings import TrainingSettings

FORMAT_VERSION = 1
MAX_CHECKPOINT_BYTES = 8 * 2**20  # chosen: twice what the largest of these networks has
_METADATA_KEY, _PREFIX = "dextouch", "network."


class CheckpointMetadata(FrozenModel):
    """Provenance of a network; no evaluation may begin from its starts (digests)."""

    kind: str
    format_version: int = FORMAT_VERSION
    command: str
    seed: int
    data_hash: str
    tasks: tuple[str, ...]
    training_episodes: tuple[str, ...]
    training_starts: tuple[str, ...]
    settings: dict[str, Any]
    metrics: dict[str, Any]


@dataclass(frozen=True)
class Checkpoint:
    """Weights by name, with their provenance."""

    metadata: CheckpointMetadata
    tensors: dict[str, torch.Tensor]


def network_tensors(network: nn.Module, *, halved: Collection[str] = ()) -> dict[str, torch.Tensor]:
    """Copies of a network's weights for a checkpoint, those named in `halved` as float16."""
    return {
        f"{_PREFIX}{name}": tensor.half() if name in halved else tensor.clone()
        for name, tensor in network.state_dict().items()
    }


def save_checkpoint(path: Path, checkpoint: Checkpoint) -> None:
    """Write the file atomically; raises NonFiniteError, or LimitExceededError over 8 MiB."""
    weight_files.refuse_non_finite(checkpoint.tensors, "checkpoint")
    size = sum(t.numel() * t.element_size() for t in checkpoint.tensors.values())
    if size > MAX_CHECKPOINT_BYTES:
        raise LimitExceededError(
            f"checkpoint: {size} bytes of weights, expected at most {MAX_CHECKPOINT_BYTES}"
        )
    weight_files.write_weights(path, checkpoint.tensors, checkpoint.metadata, _METADATA_KEY)


def load_checkpoint(path: Path, *, kind: str | tuple[str, ...]) -> Checkpoint:
    """Read a checkpoint of a kind, or of one of several.

    Raises as `read_weights`, and InvalidInputError for a checkpoint of another kind.
    """
    tensors, metadata, _ = weight_files.read_weights(
        path, CheckpointMetadata, _METADATA_KEY, max_bytes=2 * MAX_CHECKPOINT_BYTES
    )
    kinds = (kind,) if isinstance(kind, str) else kind
    if metadata.kind not in kinds:
        raise InvalidInputError(
            f"checkpoint {path.name}: got {metadata.kind}, expected {' or '.join(kinds)}"
        )
    return Checkpoint(metadata, tensors)


def load_network(network: nn.Module, checkpoint: Checkpoint) -> None:
    """Load the weights of a checkpoint into its network, for inference.

    Raises InvalidInputError for missing or unexpected tensors, or wrong shapes.
    """
    where = f"checkpoint of {checkpoint.metadata.kind}"
    weight_files.load_strictly({_PREFIX: network}, checkpoint.tensors, where=where)


def optimized(
    network: nn.Module,
    loss: Callable[[torch.Generator], Tensor],
    settings: TrainingSettings,
    *,
    title: str,
    max_gradient_norm: float = 1.0,
) -> Iterator[Budget]:
    """Train a network by losses of drawn batches; yields the used budget after each step."""
    generator = torch.Generator().manual_seed(settings.seed)
    budget = Budget(settings.max_cpu_s, settings.num_training_steps)
    options = OptimizerOptions(
        settings.learning_rate, settings.weight_decay, max_gradient_norm, fused=False
    )
    network.train()
    with Progress(title, settings.num_training_steps) as progress:
        for value in OptimizerLoop(network, options, budget).run(lambda: loss(generator)):
            progress.advance(loss=value)
            yield budget


def instructions_of(tasks: Iterable[tuple[str, str]]) -> dict[str, str]:
    """The first instruction of every task, from tasks and instructions of episodes."""
    found: dict[str, str] = {}
    for task, instruction in tasks:
        found.setdefault(task, instruction)
    return found
