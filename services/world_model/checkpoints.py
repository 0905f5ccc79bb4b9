"""Checkpoints of the paper's form, and which checkpoint comes with the package."""

import hashlib
from dataclasses import dataclass
from operator import not_
from pathlib import Path

from pydantic import BaseModel, ConfigDict, Field

from dextouch.errors import InvalidInputError, UnknownNameError
from services.world_model.network.configuration import NetworkConfig
from services.world_model.network.model import JointWorldModel
from services.world_model.weights import half_weights, load_strictly, read_weights, write_weights

FORMAT_VERSION = 1
METADATA_KEY = "dextouch_world_model"
# Statistics that files of older releases do not hold; the network's own defaults stand in.
LATER_STATISTICS = ("tokenizer.peak_kpa",)
PRETRAINED = Path(__file__).parent / "pretrained"
STATE_MODEL, PAPER_FORM = "state.safetensors", "tiny.safetensors"


class CheckpointMetadata(BaseModel):
    """Where a checkpoint comes from and how good it was measured to be, inside its file.

    `initialized_from` is the digest of the checkpoint whose weights training began with; what that
    one was trained on counts as trained on here, too. Where it is None it is not written, so that
    older releases read the file.
    """

    model_config = ConfigDict(frozen=True, extra="forbid")

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
    metrics: dict[str, float] = {}


@dataclass(frozen=True)
class Checkpoint:
    """A loaded model, its history and the digest of its file."""

    model: JointWorldModel
    metadata: CheckpointMetadata
    digest: str


def write_checkpoint(path: Path, model: JointWorldModel, metadata: CheckpointMetadata) -> str:
    """Write the file in one move and return its digest."""
    return write_weights(path, half_weights(model), metadata, METADATA_KEY)


def read_checkpoint(path: Path) -> Checkpoint:
    """Load a checkpoint strictly, in float32, ready to predict.

    Raises:
        NotFoundError, LimitExceededError, CorruptDataError: as `read_weights`.
        InvalidInputError: another format version; tensors missing, foreign or of other shapes.
        NonFiniteError: weights that are NaN or infinite.
    """
    tensors, metadata, digest = read_weights(path, CheckpointMetadata, METADATA_KEY)
    model = JointWorldModel(metadata.network)
    load_strictly({"": model}, tensors, where=f"checkpoint {path.name}", later=LATER_STATISTICS)
    return Checkpoint(model, metadata, digest)


def find_checkpoint(folder: Path, digest: str) -> Path:
    """The file in `folder` whose SHA-256 is, or begins with, `digest` (eight digits at least).

    Raises:
        UnknownNameError: none; the message lists those there are.
        InvalidInputError: fewer than eight digits, or more than one file fits.
    """
    if len(digest) < 8:
        raise InvalidInputError(f"digest: got {digest!r}, expected at least 8 hexadecimal digits")
    digests = list_checkpoints(folder)
    found = [path for path, known in digests.items() if known.startswith(digest.lower())]
    if not found:
        raise UnknownNameError("checkpoint digest", digest, [d[:12] for d in digests.values()])
    if len({digests[path] for path in found}) > 1:
        raise InvalidInputError(f"digest {digest!r} fits {len(found)} checkpoints; give more of it")
    return found[0]


def list_checkpoints(folder: Path) -> dict[Path, str]:
    """Every checkpoint file of a folder with its digest."""
    return {
        path: hashlib.sha256(path.read_bytes()).hexdigest()
        for path in sorted(folder.glob("*.safetensors"))
    }


def default_checkpoint() -> Path:
    """The checkpoint that comes with the package: the state model, where it is there."""
    state = PRETRAINED / STATE_MODEL
    return state if state.is_file() else paper_form_checkpoint()


def paper_form_checkpoint() -> Path:
    """The checkpoint of the paper's form that comes with the package."""
    return PRETRAINED / PAPER_FORM
