"""A model and its history in, one safetensors file named by its SHA-256 out, and strictly back."""

import hashlib
import json
from collections.abc import Mapping
from dataclasses import dataclass
from operator import not_
from pathlib import Path

import torch
from pydantic import BaseModel, ConfigDict, Field, ValidationError
from safetensors import SafetensorError, safe_open
from safetensors.torch import save
from torch import Tensor, nn

from dextouch.errors import (
    CorruptDataError,
    InvalidInputError,
    LimitExceededError,
    NonFiniteError,
    NotFoundError,
    UnknownNameError,
)
from services.world_model.network.configuration import NetworkConfig
from services.world_model.network.model import JointWorldModel

FORMAT_VERSION = 1
METADATA_KEY = "dextouch_world_model"
# Statistics that files of older releases do not hold; the network's own defaults stand in.
LATER_STATISTICS = ("tokenizer.peak_kpa",)
MAX_CHECKPOINT_BYTES = 64 * 2**20
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


def to_bytes(model: JointWorldModel, metadata: CheckpointMetadata) -> bytes:
    """The checkpoint file. Learned weights are stored as float16, statistics as float32."""
    learned = {name for name, _ in model.named_parameters()}
    tensors = {
        name: (tensor.half() if name in learned else tensor).contiguous()
        for name, tensor in model.state_dict().items()
    }
    _refuse_non_finite(tensors, "checkpoint to be written")
    return save(tensors, {METADATA_KEY: metadata.model_dump_json()})


def write_checkpoint(path: Path, model: JointWorldModel, metadata: CheckpointMetadata) -> str:
    """Write the file in one move and return its digest."""
    data = to_bytes(model, metadata)
    path.parent.mkdir(parents=True, exist_ok=True)
    partial = path.with_suffix(path.suffix + ".partial")
    partial.write_bytes(data)
    partial.replace(path)
    return hashlib.sha256(data).hexdigest()


def read_checkpoint(path: Path) -> Checkpoint:
    """Load a checkpoint strictly, in float32, ready to predict.

    Raises:
        NotFoundError: no such file.
        LimitExceededError: larger than 64 MiB.
        CorruptDataError: no safetensors file, or without our metadata.
        InvalidInputError: another format version; tensors missing, foreign or of other shapes.
        NonFiniteError: weights that are NaN or infinite.
    """
    if not path.is_file():
        raise NotFoundError(f"checkpoint: no file {path.name} in {path.parent}")
    size = path.stat().st_size
    if size > MAX_CHECKPOINT_BYTES:
        raise LimitExceededError(
            f"checkpoint {path.name}: got {size} bytes, expected at most {MAX_CHECKPOINT_BYTES}"
        )
    try:
        with safe_open(path, framework="pt") as file:
            notes = file.metadata() or {}
            tensors = {name: file.get_tensor(name) for name in file.keys()}  # noqa: SIM118
    except SafetensorError as error:
        raise CorruptDataError(f"checkpoint {path.name}: no safetensors file ({error})") from error
    metadata = _metadata(notes, path.name)
    model = JointWorldModel(metadata.network)
    _load_strictly(model, tensors, path.name)
    digest = hashlib.sha256(path.read_bytes()).hexdigest()
    return Checkpoint(model.eval().requires_grad_(requires_grad=False), metadata, digest)


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


def _metadata(notes: Mapping[str, str], name: str) -> CheckpointMetadata:
    if METADATA_KEY not in notes:
        raise CorruptDataError(
            f"checkpoint {name}: has no {METADATA_KEY!r} metadata; it is no world model of ours"
        )
    try:
        version = json.loads(notes[METADATA_KEY]).get("format_version")
        if version != FORMAT_VERSION:
            raise InvalidInputError(
                f"checkpoint {name}: format version {version}, expected {FORMAT_VERSION}; "
                "train it anew with this version"
            )
        return CheckpointMetadata.model_validate_json(notes[METADATA_KEY])
    except (ValidationError, json.JSONDecodeError, AttributeError) as error:
        raise CorruptDataError(f"checkpoint {name}: metadata unreadable ({error})") from error


def _load_strictly(model: nn.Module, tensors: Mapping[str, Tensor], name: str) -> None:
    expected = model.state_dict()
    tensors = {**{key: expected[key] for key in LATER_STATISTICS}, **tensors}
    missing = sorted(expected.keys() - tensors.keys())
    foreign = sorted(tensors.keys() - expected.keys())
    if missing or foreign:
        raise InvalidInputError(
            f"checkpoint {name}: {len(missing)} tensors missing {missing[:3]}, {len(foreign)} "
            f"foreign {foreign[:3]}; expected exactly those of its own network settings"
        )
    for key, tensor in tensors.items():
        if tensor.shape != expected[key].shape or not tensor.is_floating_point():
            raise InvalidInputError(
                f"checkpoint {name}: {key} is {tensor.dtype} {tuple(tensor.shape)}, expected "
                f"floating point {tuple(expected[key].shape)}"
            )
    _refuse_non_finite(tensors, f"checkpoint {name}")
    model.load_state_dict({key: tensor.float() for key, tensor in tensors.items()})


def _refuse_non_finite(tensors: Mapping[str, Tensor], where: str) -> None:
    bad = [key for key, tensor in tensors.items() if not torch.isfinite(tensor).all()]
    if bad:
        raise NonFiniteError(f"{where}: NaN or infinity in {bad[:3]} ({len(bad)} tensors)")
