"""Safetensors checkpoints of the evaluation's networks: weights, configuration and provenance."""

import json
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch
from pydantic import BaseModel, ConfigDict, ValidationError
from safetensors import SafetensorError, safe_open
from safetensors.torch import save

from dextouch.errors import CorruptDataError, InvalidInputError, LimitExceededError, NotFoundError

FORMAT_VERSION = 1
MAX_CHECKPOINT_BYTES = 8 * 2**20
_METADATA_KEY = "dextouch"


class CheckpointMetadata(BaseModel):
    """Provenance of a network.

    Evaluations must not contain any of `training_episodes` and `training_starts` (digests of first
    observations).
    """

    model_config = ConfigDict(frozen=True, extra="forbid")

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


def save_checkpoint(path: Path, checkpoint: Checkpoint) -> None:
    """Write the file atomically.

    Raises:
        InvalidInputError: weights that are not finite.
        LimitExceededError: more than 8 MiB.
    """
    for name, tensor in checkpoint.tensors.items():
        if not bool(torch.isfinite(tensor).all()):
            raise InvalidInputError(f"checkpoint: tensor {name!r} holds NaN or infinity")
    size = sum(t.numel() * t.element_size() for t in checkpoint.tensors.values())
    if size > MAX_CHECKPOINT_BYTES:
        raise LimitExceededError(
            f"checkpoint: {size} bytes of weights, expected at most {MAX_CHECKPOINT_BYTES}"
        )
    path.parent.mkdir(parents=True, exist_ok=True)
    unfinished = path.with_suffix(".unfinished")
    text = checkpoint.metadata.model_dump_json()
    tensors = {name: tensor.contiguous() for name, tensor in checkpoint.tensors.items()}
    unfinished.write_bytes(save(tensors, metadata={_METADATA_KEY: text}))
    unfinished.replace(path)


def load_checkpoint(path: Path, *, kind: str) -> Checkpoint:
    """Read a checkpoint of one kind.

    Raises:
        NotFoundError: no such file.
        CorruptDataError: not a safetensors file, missing or unknown metadata, NaN weights.
        InvalidInputError: a checkpoint of another kind or a newer format.
    """
    if not path.is_file():
        raise NotFoundError(f"checkpoint {path.name!r}: no such file; train one first")
    if path.stat().st_size > 2 * MAX_CHECKPOINT_BYTES:
        raise CorruptDataError(f"checkpoint {path.name!r}: larger than any checkpoint of this kind")
    try:
        with safe_open(path, framework="pt") as file:
            text = (file.metadata() or {}).get(_METADATA_KEY)
            tensors = {name: file.get_tensor(name) for name in file.keys()}  # noqa: SIM118
    except SafetensorError as error:
        raise CorruptDataError(f"checkpoint {path.name!r}: no safetensors ({error})") from error
    metadata = _parse_metadata(text, path.name)
    if metadata.kind != kind or metadata.format_version != FORMAT_VERSION:
        raise InvalidInputError(
            f"checkpoint {path.name!r}: got {metadata.kind} version {metadata.format_version}, "
            f"expected {kind} version {FORMAT_VERSION}"
        )
    for name, tensor in tensors.items():
        if not bool(torch.isfinite(tensor).all()):
            raise CorruptDataError(f"checkpoint {path.name!r}: tensor {name!r} is not finite")
    return Checkpoint(metadata, tensors)


def _parse_metadata(text: str | None, name: str) -> CheckpointMetadata:
    if text is None:
        raise CorruptDataError(f"checkpoint {name!r}: no DexTouch metadata in the file")
    try:
        return CheckpointMetadata.model_validate(json.loads(text))
    except (ValidationError, json.JSONDecodeError) as error:
        raise CorruptDataError(f"checkpoint {name!r}: foreign metadata ({error})") from error


def load_weights(module: torch.nn.Module, checkpoint: Checkpoint, *, prefix: str) -> None:
    """Load the tensors under `prefix` into the module; the names must match exactly.

    Raises:
        CorruptDataError: missing or unexpected tensors, or wrong shapes.
    """
    start = len(prefix) + 1
    weights = {
        name[start:]: t for name, t in checkpoint.tensors.items() if name.startswith(f"{prefix}.")
    }
    expected = {name: tuple(t.shape) for name, t in module.state_dict().items()}
    got = {name: tuple(t.shape) for name, t in weights.items()}
    if got != expected:
        differing = sorted(set(expected.items()) ^ set(got.items()))[:4]
        raise CorruptDataError(
            f"checkpoint of {checkpoint.metadata.kind}: tensors differ from the network's, "
            f"first {differing}"
        )
    module.load_state_dict(weights)
