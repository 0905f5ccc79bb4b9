"""Checkpoints of the joint flow-matching model."""

import sys
from dataclasses import dataclass
from operator import not_
from pathlib import Path
from typing import Final

from pydantic import Field

from dextouch.frozen_model import FrozenModel
from services.networks.memory import available_memory
from services.networks.weight_files import (
    MAX_FILE_BYTES,
    digest_of,
    half_weights,
    load_strictly,
    notes_of,
    read_history,
    read_weights,
    refuse_non_finite,
    write_weights,
)
from services.world_model.network.configuration import NetworkConfig
from services.world_model.network.model import JointWorldModel
from services.world_model.training_set import TrainingSet

FORMAT_VERSION = 1
METADATA_KEY = "dextouch_world_model"
# Statistics missing from files of older releases; the network's defaults are used instead.
LATER_STATISTICS = ("tokenizer.peak_kpa",)
_TEXT: Final = "text_features."


class CheckpointMetadata(FrozenModel):
    """Provenance and measured accuracy of a model, stored in its checkpoint.

    `initialized_from` is the digest of the checkpoint that the weights were initialized from; its
    training episodes count as training episodes here, too. `tokenizer_digest` is that of the
    pretrained tokenizer's file. None is not written, so that older releases can read the file.
    `sets` are the episodes by domain, those of ancestors included; it is empty in files of older
    releases.
    """

    format_version: int = FORMAT_VERSION
    name: str
    network: NetworkConfig
    tasks: tuple[str, ...]
    command: str
    seed: int
    training_steps: int
    training_cpu_s: float
    train_episode_ids: tuple[str, ...]
    train_fingerprints: tuple[str, ...]
    data_hash: str
    heldout_episode_ids: tuple[str, ...] = ()
    initialized_from: str | None = Field(default=None, exclude_if=not_)
    sets: tuple[TrainingSet, ...] = Field(default=(), exclude_if=not_)
    tokenizer_digest: str | None = Field(default=None, exclude_if=not_)
    metrics: dict[str, float] = Field(default={})


@dataclass(frozen=True)
class Checkpoint:
    """A loaded model with its metadata and the digest of its file."""

    model: JointWorldModel
    metadata: CheckpointMetadata
    digest: str


def write_checkpoint(path: Path, model: JointWorldModel, metadata: CheckpointMetadata) -> str:
    """Write the file atomically and return its digest.

    The full size keeps the precision of its weights, and comes with the text features of its
    instructions, so that the text encoder is not needed to serve them.
    """
    if model.text_features is None:
        return write_weights(path, half_weights(model), metadata, METADATA_KEY)
    known = model.text_features.known
    tensors = {**model.state_dict(), **{_TEXT + key: value for key, value in known.items()}}
    refuse_non_finite(tensors, "weights to be written")
    return write_weights(path, tensors, metadata, METADATA_KEY)


def read_checkpoint(path: Path, *, max_bytes: int | None = None) -> Checkpoint:
    """Load a checkpoint strictly, in evaluation mode.

    Args:
        path: file to read.
        max_bytes: largest size of the file; by default 64 MiB, and for the full size the memory
            that is available.

    Raises:
        NotFoundError, LimitExceededError, CorruptDataError, NonFiniteError: as `read_weights`.
        InvalidInputError: unsupported format version; missing or unexpected tensors, wrong shapes.
    """
    limit = _largest(path) if max_bytes is None else max_bytes
    tensors, metadata, digest = read_weights(
        path, CheckpointMetadata, METADATA_KEY, max_bytes=limit
    )
    model = JointWorldModel(metadata.network)
    if model.text_features is not None:
        keys = [name for name in tensors if name.startswith(_TEXT)]
        model.text_features.learn({key.removeprefix(_TEXT): tensors.pop(key) for key in keys})
    load_strictly({"": model}, tensors, where=f"checkpoint {path.name}", later=LATER_STATISTICS)
    return Checkpoint(model, metadata, digest)


def read_metadata(path: Path) -> CheckpointMetadata:
    """Metadata of a checkpoint, without reading its weights.

    Raises:
        NotFoundError: no such file.
        CorruptDataError: not a checkpoint of this form, or damaged metadata.
        InvalidInputError: unsupported format version.
    """
    return read_history(path, CheckpointMetadata, METADATA_KEY)


def _largest(path: Path) -> int:
    """Largest size of a file of its kind, as its metadata declare it."""
    text = notes_of(path).get(METADATA_KEY, "")
    if '"video_expert":"wan"' not in text:
        return MAX_FILE_BYTES
    available = available_memory()
    return sys.maxsize if available is None else available


def list_checkpoints(folder: Path) -> dict[Path, str]:
    """Every checkpoint file of a folder with its digest."""
    return {path: digest_of(path) for path in sorted(folder.glob("*.safetensors"))}
