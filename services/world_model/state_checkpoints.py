"""Checkpoints of state models: dynamics and renderer in one safetensors file with its history."""

import hashlib
import json
from dataclasses import dataclass
from pathlib import Path

import torch
from pydantic import BaseModel, ConfigDict, ValidationError
from safetensors import SafetensorError, safe_open
from safetensors.torch import save
from torch import Tensor

from dextouch.errors import (
    CorruptDataError,
    InvalidInputError,
    LimitExceededError,
    NonFiniteError,
    NotFoundError,
)
from services.world_model.dynamics.configuration import DynamicsConfig
from services.world_model.dynamics.model import DynamicsModel
from services.world_model.rendering.checkpoints import renderer_from_tensors, renderer_tensors
from services.world_model.rendering.configuration import RendererConfig
from services.world_model.rendering.network import RendererNetwork

FORMAT_VERSION = 1
METADATA_KEY = "dextouch_state_model"
MAX_CHECKPOINT_BYTES = 64 * 2**20
_DYNAMICS, _RENDERER = "dynamics.", "renderer."


class StateBounds(BaseModel):
    """Beyond these a rollout is doubted, or ends.

    `disagreement_m` and `distance` are figures of development episodes that almost none of them
    passes; `horizon_latents` is the length of an episode that the cores were trained on.
    """

    model_config = ConfigDict(frozen=True, extra="forbid")

    disagreement_m: float = 1.0
    distance: float = 1.0
    horizon_latents: int = 20


class StateMetadata(BaseModel):
    """Where a state model comes from and how good it was measured to be."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    format_version: int = FORMAT_VERSION
    name: str
    dynamics: DynamicsConfig
    num_members: int
    renderer: RendererConfig
    object_names: dict[str, tuple[str, ...]]
    object_boxes_m: dict[str, tuple[tuple[float, ...], ...]]
    model_rate_hz: float = 15.0
    bounds: StateBounds = StateBounds()
    command: str
    seed: int
    training_cpu_s: float
    num_training_episodes: int
    training_seeds: dict[str, tuple[int, int]]
    data_hash: str
    metrics: dict[str, float] = {}


@dataclass(frozen=True)
class StateCheckpoint:
    """A loaded state model, its history and the digest of its file."""

    dynamics: DynamicsModel
    renderer: RendererNetwork
    metadata: StateMetadata
    digest: str


def is_state_checkpoint(path: Path) -> bool:
    """Whether a safetensors file says that it holds a state model."""
    try:
        with safe_open(path, framework="pt") as file:
            return METADATA_KEY in (file.metadata() or {})
    except (SafetensorError, OSError):
        return False


def write_state_checkpoint(
    path: Path, dynamics: DynamicsModel, renderer: RendererNetwork, metadata: StateMetadata
) -> str:
    """Write the file in one move and return its digest.

    Learned weights are stored as float16, statistics as float32.
    """
    learned = {name for name, _ in dynamics.named_parameters()}
    tensors = {
        f"{_DYNAMICS}{name}": (tensor.half() if name in learned else tensor).contiguous()
        for name, tensor in dynamics.state_dict().items()
    }
    _refuse_non_finite(tensors, "state model to be written")
    tensors |= renderer_tensors(renderer, prefix=_RENDERER)
    data = save(tensors, {METADATA_KEY: metadata.model_dump_json()})
    path.parent.mkdir(parents=True, exist_ok=True)
    partial = path.with_suffix(path.suffix + ".partial")
    partial.write_bytes(data)
    partial.replace(path)
    return hashlib.sha256(data).hexdigest()


def read_state_checkpoint(path: Path) -> StateCheckpoint:
    """Load a state model strictly, in float32, ready to predict.

    Raises:
        NotFoundError: no such file.
        LimitExceededError: larger than 64 MiB.
        CorruptDataError: no safetensors file, or without our metadata.
        InvalidInputError: another format version; tensors missing, foreign or of other shapes.
        NonFiniteError: weights that are NaN or infinite.
    """
    if not path.is_file():
        raise NotFoundError(f"state model: no file {path.name} in {path.parent}")
    size = path.stat().st_size
    if size > MAX_CHECKPOINT_BYTES:
        raise LimitExceededError(
            f"state model {path.name}: got {size} bytes, expected at most {MAX_CHECKPOINT_BYTES}"
        )
    try:
        with safe_open(path, framework="pt") as file:
            notes = file.metadata() or {}
            tensors = {name: file.get_tensor(name) for name in file.keys()}  # noqa: SIM118
    except SafetensorError as error:
        raise CorruptDataError(f"state model {path.name}: no safetensors file ({error})") from error
    metadata = _metadata(notes.get(METADATA_KEY), path.name)
    dynamics = DynamicsModel(metadata.dynamics, metadata.num_members)
    drawing = {name: t for name, t in tensors.items() if name.startswith(_RENDERER)}
    _load_strictly(dynamics, {n: t for n, t in tensors.items() if n not in drawing}, path.name)
    renderer = renderer_from_tensors(
        drawing, metadata.renderer, prefix=_RENDERER, where=f"state model {path.name}"
    )
    digest = hashlib.sha256(path.read_bytes()).hexdigest()
    dynamics.eval().requires_grad_(requires_grad=False)
    return StateCheckpoint(dynamics, renderer, metadata, digest)


def _metadata(text: str | None, name: str) -> StateMetadata:
    if text is None:
        raise CorruptDataError(
            f"state model {name}: has no {METADATA_KEY!r} metadata; it is no state model of ours"
        )
    try:
        version = json.loads(text).get("format_version")
        if version != FORMAT_VERSION:
            raise InvalidInputError(
                f"state model {name}: format version {version}, expected {FORMAT_VERSION}; "
                "train it anew with this version"
            )
        return StateMetadata.model_validate_json(text)
    except (ValidationError, json.JSONDecodeError, AttributeError) as error:
        raise CorruptDataError(f"state model {name}: metadata unreadable ({error})") from error


def _load_strictly(dynamics: DynamicsModel, tensors: dict[str, Tensor], name: str) -> None:
    expected = {f"{_DYNAMICS}{key}": value for key, value in dynamics.state_dict().items()}
    missing = sorted(expected.keys() - tensors.keys())
    foreign = sorted(tensors.keys() - expected.keys())
    if missing or foreign:
        raise InvalidInputError(
            f"state model {name}: {len(missing)} tensors missing {missing[:3]}, {len(foreign)} "
            f"foreign {foreign[:3]}; expected exactly those of its own settings"
        )
    for key, tensor in tensors.items():
        if tensor.shape != expected[key].shape or not tensor.is_floating_point():
            raise InvalidInputError(
                f"state model {name}: {key} is {tensor.dtype} {tuple(tensor.shape)}, expected "
                f"floating point {tuple(expected[key].shape)}"
            )
    _refuse_non_finite(tensors, f"state model {name}")
    dynamics.load_state_dict(
        {key.removeprefix(_DYNAMICS): tensor.float() for key, tensor in tensors.items()}
    )


def _refuse_non_finite(tensors: dict[str, Tensor], where: str) -> None:
    bad = [key for key, tensor in tensors.items() if not torch.isfinite(tensor).all()]
    if bad:
        raise NonFiniteError(f"{where}: NaN or infinity in {bad[:3]} ({len(bad)} tensors)")
