"""A renderer's weights as a file of its own, or as part of a larger checkpoint under a prefix."""

import hashlib
import json
from collections.abc import Mapping
from pathlib import Path

import torch
from pydantic import BaseModel, ConfigDict, ValidationError
from safetensors import SafetensorError, safe_open
from safetensors.torch import save
from torch import Tensor

from dextouch.errors import CorruptDataError, InvalidInputError, NonFiniteError, NotFoundError
from services.world_model.rendering.configuration import RendererConfig
from services.world_model.rendering.network import RendererNetwork
from services.world_model.rendering.training import RendererTraining

FORMAT_VERSION = 1
METADATA_KEY = "dextouch_renderer"


class RendererMetadata(BaseModel):
    """Where a renderer comes from and how good it was measured to be, inside its file."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    format_version: int = FORMAT_VERSION
    config: RendererConfig
    training: RendererTraining
    command: str
    seed: int
    training_steps: int
    training_cpu_s: float
    train_seeds: tuple[int, ...] = ()
    metrics: dict[str, float] = {}


def renderer_tensors(network: RendererNetwork, *, prefix: str = "") -> dict[str, Tensor]:
    """Weights as float16, each name behind a prefix.

    Raises:
        NonFiniteError: weights that are NaN, infinite, or too large for float16.
    """
    tensors = {
        f"{prefix}{name}": tensor.half().contiguous()
        for name, tensor in network.state_dict().items()
    }
    _refuse_non_finite(tensors, "renderer to be written")
    return tensors


def renderer_from_tensors(
    tensors: Mapping[str, Tensor], config: RendererConfig, *, prefix: str = "", where: str
) -> RendererNetwork:
    """A network of exactly the tensors whose names begin with a prefix; others are ignored.

    Raises:
        InvalidInputError: tensors missing, foreign or of another shape.
        NonFiniteError: weights that are NaN or infinite.
    """
    found = {
        name.removeprefix(prefix): tensor
        for name, tensor in tensors.items()
        if name.startswith(prefix)
    }
    network = RendererNetwork(config)
    expected = network.state_dict()
    wrong = sorted(expected.keys() ^ found.keys()) or [
        name for name in expected if found[name].shape != expected[name].shape
    ]
    if wrong:
        raise InvalidInputError(
            f"{where}: {len(wrong)} tensors of the renderer are missing, foreign or of another "
            f"shape {wrong[:3]}; expected exactly those of its own settings"
        )
    _refuse_non_finite(found, where)
    network.load_state_dict({name: tensor.float() for name, tensor in found.items()})
    return network.eval().requires_grad_(requires_grad=False)


def write_renderer(path: Path, network: RendererNetwork, metadata: RendererMetadata) -> str:
    """Write a renderer in one move and return the SHA-256 of its file."""
    data = save(renderer_tensors(network), {METADATA_KEY: metadata.model_dump_json()})
    path.parent.mkdir(parents=True, exist_ok=True)
    partial = path.with_suffix(path.suffix + ".partial")
    partial.write_bytes(data)
    partial.replace(path)
    return hashlib.sha256(data).hexdigest()


def read_renderer(path: Path) -> tuple[RendererNetwork, RendererMetadata]:
    """Load a renderer strictly, in float32.

    Raises:
        NotFoundError: no such file.
        CorruptDataError: no safetensors file, or without our metadata.
        InvalidInputError: another format version, or tensors that do not fit the settings.
        NonFiniteError: weights that are NaN or infinite.
    """
    if not path.is_file():
        raise NotFoundError(f"renderer: no file {path.name} in {path.parent}")
    try:
        with safe_open(path, framework="pt") as file:
            notes = file.metadata() or {}
            tensors = {name: file.get_tensor(name) for name in file.keys()}  # noqa: SIM118
    except SafetensorError as error:
        raise CorruptDataError(f"renderer {path.name}: no safetensors file ({error})") from error
    metadata = _metadata(notes, path.name)
    where = f"renderer {path.name}"
    return renderer_from_tensors(tensors, metadata.config, where=where), metadata


def _metadata(notes: Mapping[str, str], name: str) -> RendererMetadata:
    if METADATA_KEY not in notes:
        raise CorruptDataError(
            f"renderer {name}: has no {METADATA_KEY!r} metadata; it is no renderer of ours"
        )
    try:
        version = json.loads(notes[METADATA_KEY]).get("format_version")
        if version != FORMAT_VERSION:
            raise InvalidInputError(
                f"renderer {name}: format version {version}, expected {FORMAT_VERSION}; train it "
                "anew with this version"
            )
        return RendererMetadata.model_validate_json(notes[METADATA_KEY])
    except (ValidationError, json.JSONDecodeError, AttributeError) as error:
        raise CorruptDataError(f"renderer {name}: metadata unreadable ({error})") from error


def _refuse_non_finite(tensors: Mapping[str, Tensor], where: str) -> None:
    bad = [name for name, tensor in tensors.items() if not torch.isfinite(tensor).all()]
    if bad:
        raise NonFiniteError(f"{where}: NaN or infinity in {bad[:3]} ({len(bad)} tensors)")
