"""Checkpoints of the joint flow-matching model, and the default checkpoint of the package."""

import hashlib
from dataclasses import dataclass
from operator import not_
from pathlib import Path

from pydantic import Field

from dextouch.frozen_model import FrozenModel
from dextouch.schemas import Domain
from services.networks.weight_files import (
    half_weights,
    load_strictly,
    read_weights,
    write_weights,
)
from services.world_model.network.configuration import NetworkConfig
from services.world_model.network.model import JointWorldModel

FORMAT_VERSION = 1
METADATA_KEY = "dextouch_world_model"
# Statistics missing from files of older releases; the network's defaults are used instead.
LATER_STATISTICS = ("tokenizer.peak_kpa",)
PRETRAINED = Path(__file__).parent / "pretrained"
STATE_MODEL, PAPER_FORM = "state.safetensors", "tiny.safetensors"


class TrainingSet(FrozenModel):
    """Episodes of one domain that a model was trained on, or that it was evaluated on (held out).

    `tasks` has the number of episodes of each task, `data_hash` is `combined_hash` of their
    content. `window_share` is the share of windows from the set, None where it follows from the
    number of episodes. `checkpoint` is the digest of the ancestor that was trained on the set, None
    for the checkpoint's own training.
    """

    domain: Domain
    heldout: bool = False
    tasks: dict[str, int]
    data_hash: str
    window_share: float | None = None
    checkpoint: str | None = None


class CheckpointMetadata(FrozenModel):
    """Provenance and measured accuracy of a model, stored in its checkpoint.

    `initialized_from` is the digest of the checkpoint that the weights were initialized from; its
    training episodes count as training episodes here, too. None is not written, so that older
    releases can read the file. `sets` are the episodes by domain, those of ancestors included; it
    is empty in files of older releases.
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
    metrics: dict[str, float] = Field(default={})


@dataclass(frozen=True)
class Checkpoint:
    """A loaded model with its metadata and the digest of its file."""

    model: JointWorldModel
    metadata: CheckpointMetadata
    digest: str


def write_checkpoint(path: Path, model: JointWorldModel, metadata: CheckpointMetadata) -> str:
    """Write the file atomically and return its digest."""
    return write_weights(path, half_weights(model), metadata, METADATA_KEY)


def read_checkpoint(path: Path) -> Checkpoint:
    """Load a checkpoint strictly, in float32 and evaluation mode.

    Raises:
        NotFoundError, LimitExceededError, CorruptDataError, NonFiniteError: as `read_weights`.
        InvalidInputError: unsupported format version; missing or unexpected tensors, wrong shapes.
    """
    tensors, metadata, digest = read_weights(path, CheckpointMetadata, METADATA_KEY)
    model = JointWorldModel(metadata.network)
    load_strictly({"": model}, tensors, where=f"checkpoint {path.name}", later=LATER_STATISTICS)
    return Checkpoint(model, metadata, digest)


def list_checkpoints(folder: Path) -> dict[Path, str]:
    """Every checkpoint file of a folder with its digest."""
    return {
        path: hashlib.sha256(path.read_bytes()).hexdigest()
        for path in sorted(folder.glob("*.safetensors"))
    }


def default_checkpoint() -> Path:
    """Default checkpoint of the package: the state model if it is installed."""
    state = PRETRAINED / STATE_MODEL
    return state if state.is_file() else paper_form_checkpoint()


def paper_form_checkpoint() -> Path:
    """Checkpoint of the joint flow-matching model that ships with the package."""
    return PRETRAINED / PAPER_FORM
