"""Safetensors files of weights with their history: written in one move, read back strictly."""

import hashlib
import json
from collections.abc import Collection, Mapping
from pathlib import Path
from typing import TypeVar

import torch
from pydantic import BaseModel, ValidationError
from safetensors import SafetensorError, safe_open
from safetensors.torch import save
from torch import Tensor, nn

from dextouch.errors import (
    CorruptDataError,
    InvalidInputError,
    LimitExceededError,
    NonFiniteError,
    NotFoundError,
)

MAX_FILE_BYTES = 64 * 2**20
History = TypeVar("History", bound=BaseModel)


def half_weights(model: nn.Module, *, prefix: str = "") -> dict[str, Tensor]:
    """Learned weights as float16, statistics as float32, each name behind a prefix.

    Raises:
        NonFiniteError: weights that are NaN, infinite, or too large for float16.
    """
    learned = {name for name, _ in model.named_parameters()}
    tensors = {
        f"{prefix}{name}": (tensor.half() if name in learned else tensor).contiguous()
        for name, tensor in model.state_dict().items()
    }
    refuse_non_finite(tensors, "weights to be written")
    return tensors


def write_weights(path: Path, tensors: Mapping[str, Tensor], history: BaseModel, key: str) -> str:
    """Write a file in one move and return the SHA-256 of its bytes.

    Args:
        path: of the file.
        tensors: from `half_weights`, of one model or of several.
        history: where the weights come from; kept as JSON.
        key: of the history in the file's metadata: says what kind of model it is.
    """
    data = save(dict(tensors), {key: history.model_dump_json()})
    path.parent.mkdir(parents=True, exist_ok=True)
    partial = path.with_suffix(path.suffix + ".partial")
    partial.write_bytes(data)
    partial.replace(path)
    return hashlib.sha256(data).hexdigest()


def read_weights(
    path: Path, history: type[History], key: str
) -> tuple[dict[str, Tensor], History, str]:
    """Tensors, history and SHA-256 of a file.

    Args:
        path: of the file.
        history: its class; it has a `format_version`.
        key: that the history was written under.

    Raises:
        NotFoundError: no such file.
        LimitExceededError: larger than 64 MiB.
        CorruptDataError: no safetensors file, or without this history.
        InvalidInputError: another format version.
    """
    where = f"checkpoint {path.name}"
    if not path.is_file():
        raise NotFoundError(f"checkpoint: no file {path.name} in {path.parent}")
    size = path.stat().st_size
    if size > MAX_FILE_BYTES:
        raise LimitExceededError(f"{where}: got {size} bytes, expected at most {MAX_FILE_BYTES}")
    try:
        with safe_open(path, framework="pt") as file:
            notes = file.metadata() or {}
            tensors = {name: file.get_tensor(name) for name in file.keys()}  # noqa: SIM118
    except SafetensorError as error:
        raise CorruptDataError(f"{where}: no safetensors file ({error})") from error
    told = _history(notes.get(key), history, key, where)
    return tensors, told, hashlib.sha256(path.read_bytes()).hexdigest()


def _history(text: str | None, history: type[History], key: str, where: str) -> History:
    if text is None:
        raise CorruptDataError(f"{where}: has no {key!r} metadata; it is no such model of ours")
    expected = history.model_fields["format_version"].default
    try:
        version = json.loads(text).get("format_version")
        if version != expected:
            raise InvalidInputError(
                f"{where}: format version {version}, expected {expected}; "
                "train it anew with this version"
            )
        return history.model_validate_json(text)
    except (ValidationError, json.JSONDecodeError, AttributeError) as error:
        raise CorruptDataError(f"{where}: metadata unreadable ({error})") from error


def holds(path: Path, key: str) -> bool:
    """Whether a file says that it holds this kind of model; False where it is no such file."""
    try:
        with safe_open(path, framework="pt") as file:
            return key in (file.metadata() or {})
    except (SafetensorError, OSError):
        return False


def load_strictly(
    models: Mapping[str, nn.Module],
    tensors: Mapping[str, Tensor],
    *,
    where: str,
    later: Collection[str] = (),
) -> None:
    """Put tensors into models, all of them and nothing else, as float32.

    Args:
        models: by the prefix of their tensors' names.
        tensors: of all models together.
        where: for messages.
        later: names that older files do not hold; the model's own values stand in.

    Raises:
        InvalidInputError: tensors missing, foreign or of other shapes.
        NonFiniteError: weights that are NaN or infinite.
    """
    expected = {
        prefix + name: value
        for prefix, model in models.items()
        for name, value in model.state_dict().items()
    }
    found = {**{name: expected[name] for name in later}, **tensors}
    missing = sorted(expected.keys() - found.keys())
    foreign = sorted(found.keys() - expected.keys())
    if missing or foreign:
        raise InvalidInputError(
            f"{where}: {len(missing)} tensors missing {missing[:3]}, {len(foreign)} "
            f"foreign {foreign[:3]}; expected exactly those of its own network settings"
        )
    for name, tensor in found.items():
        if tensor.shape != expected[name].shape or not tensor.is_floating_point():
            raise InvalidInputError(
                f"{where}: {name} is {tensor.dtype} {tuple(tensor.shape)}, expected "
                f"floating point {tuple(expected[name].shape)}"
            )
    refuse_non_finite(found, where)
    for prefix, model in models.items():
        names = model.state_dict()
        model.load_state_dict({name: found[prefix + name].float() for name in names})
        model.eval().requires_grad_(requires_grad=False)


def refuse_non_finite(tensors: Mapping[str, Tensor], where: str) -> None:
    """Raise NonFiniteError where a tensor holds NaN or infinity."""
    bad = [name for name, tensor in tensors.items() if not torch.isfinite(tensor).all()]
    if bad:
        raise NonFiniteError(f"{where}: NaN or infinity in {bad[:3]} ({len(bad)} tensors)")
