"""Safetensors files of weights, written atomically and read strictly, and the memory they need."""

import hashlib
import json
import os
import sys
from collections.abc import Collection, Mapping
from pathlib import Path
from typing import TYPE_CHECKING, TypeVar

import torch
from pydantic import BaseModel, ValidationError
from safetensors import SafetensorError, safe_open
from safetensors.torch import save_file
from torch import Tensor, nn

from dextouch.episodes import disk_errors
from dextouch.errors import (
    CorruptDataError,
    InvalidInputError,
    LimitExceededError,
    NonFiniteError,
    NotFoundError,
    StorageError,
    UnavailableError,
)
from dextouch.installation import install_command

if TYPE_CHECKING:
    from torch.distributed.tensor import DTensor
    from typing_extensions import TypeIs

# Of the services, which have weights of their own.
_PACKAGE = Path(__file__).parents[1]
MAX_FILE_BYTES = 64 * 2**20
History = TypeVar("History", bound=BaseModel)
Network = TypeVar("Network", bound=nn.Module)


def half_weights(model: nn.Module, *, prefix: str = "") -> dict[str, Tensor]:
    """Learned weights as float16 and statistics as float32, with prefixed names.

    Raises NonFiniteError for weights that are NaN, infinite, or too large for float16.
    """
    learned = {name for name, _ in model.named_parameters()}
    tensors = {
        f"{prefix}{name}": tensor.half() if name in learned else tensor
        for name, tensor in model.state_dict().items()
    }
    refuse_non_finite(tensors, "weights to be written")
    return tensors


def write_weights(path: Path, tensors: Mapping[str, Tensor], history: BaseModel, key: str) -> str:
    """Write weights with their history, as JSON, atomically; returns the SHA-256 of the file.

    `key` is the metadata key of the history, which identifies the kind of model.
    """
    return write_tensors(path, tensors, {key: history.model_dump_json()})


def write_tensors(path: Path, tensors: Mapping[str, Tensor], notes: dict[str, str]) -> str:
    """Write tensors with texts as metadata; as `write_weights`.

    Raises StorageError if the file cannot be written.
    """
    partial = path.with_name(path.name + ".partial")
    with disk_errors(f"write {path}"):
        path.parent.mkdir(parents=True, exist_ok=True)
        # safetensors makes files that only their owner can read; these get the usual permissions.
        partial.touch()
        mode = partial.stat().st_mode
        try:
            save_file({name: one.contiguous() for name, one in tensors.items()}, partial, notes)
            partial.chmod(mode)
            with partial.open("rb") as file:
                os.fsync(file.fileno())
            digest = digest_of(partial)
            partial.replace(path)
        except SafetensorError as error:
            # Of the disk, which may be full: its text is all that safetensors passes on.
            raise StorageError(f"write {path}: {error}; free space if the disk is full") from error
        finally:
            partial.unlink(missing_ok=True)
    return digest


def digest_of(path: Path) -> str:
    """SHA-256 of a file of any size."""
    with path.open("rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()


def read_weights(
    path: Path, history: type[History], key: str, *, max_bytes: int = MAX_FILE_BYTES
) -> tuple[dict[str, Tensor], History, str]:
    """Read tensors, history and SHA-256 of a file of at most `max_bytes`.

    The history, under the metadata key `key`, is of a class with a `format_version`.

    Raises:
        NotFoundError: no such file.
        LimitExceededError: a larger file.
        CorruptDataError: not a safetensors file, or one without this history.
        InvalidInputError: unsupported format version.
        NonFiniteError: weights that are NaN or infinite.
    """
    where = f"checkpoint {path.name}"
    _check_exists(path)
    size = path.stat().st_size
    if size > max_bytes:
        raise LimitExceededError(f"{where}: got {size} bytes, expected at most {max_bytes}")
    tensors, notes = read_tensors(path, where)
    parsed = _history(notes.get(key), history, key, where)
    refuse_non_finite(tensors, where)
    return tensors, parsed, digest_of(path)


def read_history(path: Path, history: type[History], key: str) -> History:
    """History of a file, without its tensors; as `read_weights`."""
    _check_exists(path)
    return _history(notes_of(path).get(key), history, key, f"checkpoint {path.name}")


def _check_exists(path: Path) -> None:
    if path.is_file():
        return
    do = "check the path, or train one first"
    if path.is_relative_to(_PACKAGE):
        do = f"these weights are a package of their own: `{install_command('model')}`"
    raise NotFoundError(f"checkpoint: no file {path.name} in {path.parent}; {do}")


def read_tensors(path: Path, where: str) -> tuple[dict[str, Tensor], dict[str, str]]:
    """Tensors and metadata of a safetensors file; raises CorruptDataError for another."""
    try:
        with safe_open(path, framework="pt") as file:
            tensors = {name: file.get_tensor(name) for name in file.keys()}  # noqa: SIM118
            return tensors, file.metadata() or {}
    except SafetensorError as error:
        raise CorruptDataError(f"{where}: not a safetensors file ({error})") from error


def _history(text: str | None, history: type[History], key: str, where: str) -> History:
    if text is None:
        raise CorruptDataError(f"{where}: has no {key!r} metadata, so it is another kind of file")
    expected = history.model_fields["format_version"].default
    try:
        version = json.loads(text).get("format_version", expected)
        if version != expected:
            raise InvalidInputError(
                f"{where}: format version {version}, expected {expected}; "
                "train it again with this version"
            )
        return history.model_validate_json(text)
    except (ValidationError, json.JSONDecodeError, AttributeError) as error:
        raise CorruptDataError(f"{where}: metadata unreadable ({error})") from error


def notes_of(path: Path) -> dict[str, str]:
    """Metadata of a file, without reading its tensors; empty if it is not a safetensors file."""
    try:
        with safe_open(path, framework="pt") as file:
            return file.metadata() or {}
    except (SafetensorError, OSError):
        return {}


def load_strictly(
    models: Mapping[str, nn.Module],
    tensors: Mapping[str, Tensor],
    *,
    where: str,
    later: Collection[str] = (),
) -> None:
    """Load tensors into models in their precision, for inference; the names must match exactly.

    Models are keyed by the prefix of their tensor names. Of tensors that are named by `later` and
    that older files do not have, a model keeps its own values. Raises InvalidInputError for missing
    or unexpected tensors, wrong shapes or kinds of numbers.
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
            f"unexpected {foreign[:3]}; expected exactly those of its own network settings"
        )
    for name, tensor in found.items():
        parameter = expected[name]
        kinds = tensor.is_floating_point(), parameter.is_floating_point()
        if tensor.shape != parameter.shape or kinds[0] != kinds[1]:
            raise InvalidInputError(
                f"{where}: {name} is {tensor.dtype} {tuple(tensor.shape)}, expected "
                f"{'floating point' if kinds[1] else parameter.dtype} {tuple(parameter.shape)}"
            )
    for prefix, model in models.items():
        own = {name: found[prefix + name] for name in model.state_dict()}
        # Weights of a network that was built without memory are taken over, not copied.
        if any(weight.is_meta for weight in model.state_dict().values()):
            own = {name: tensor.to(expected[prefix + name].dtype) for name, tensor in own.items()}
            model.load_state_dict(own, assign=True)
        else:
            model.load_state_dict(own)
        model.eval().requires_grad_(requires_grad=False)


def refuse_non_finite(tensors: Mapping[str, Tensor], where: str) -> None:
    """Raise NonFiniteError if a tensor holds NaN or infinity."""
    bad = [name for name, tensor in tensors.items() if not torch.isfinite(tensor).all()]
    if bad:
        raise NonFiniteError(f"{where}: NaN or infinity in {bad[:3]} ({len(bad)} tensors)")


def on_device(network: Network, device: str) -> Network:
    """Move a network to a device, in place.

    Raises UnavailableError if torch has no such device here, and LimitExceededError for a CUDA
    device with less free memory than the weights need.
    """
    try:
        place = torch.device(device)
        torch.empty(0, device=place)
    except (RuntimeError, AssertionError) as error:
        raise UnavailableError(
            f"device {device!r}: not available ({error}); use cpu, or a device that "
            "torch.cuda.is_available() confirms"
        ) from error
    if place.type == "cuda":
        free, _ = torch.cuda.mem_get_info(place)
        check_memory(memory_of(network.state_dict()), where=f"device {device}", max_bytes=free)
    return network.to(place)


def is_sharded(tensor: Tensor) -> "TypeIs[DTensor]":
    """Whether a tensor is sharded over processes."""
    # No tensor is before the module is imported, which takes half as long as torch.
    module = sys.modules.get("torch.distributed.tensor")
    return module is not None and isinstance(tensor, module.DTensor)


def memory_of(tensors: Mapping[str, Tensor]) -> int:
    """Bytes here of tensors, which may be on the meta device, or sharded over processes."""
    here = (one.to_local() if is_sharded(one) else one for one in tensors.values())
    return sum(tensor.numel() * tensor.element_size() for tensor in here)


def allocate(network: nn.Module) -> None:
    """Give parameters of the meta device memory, without values; sharded ones of their mesh."""
    for module in network.modules():
        for name, weight in list(module.named_parameters(recurse=False)):
            if weight.is_meta:
                place = weight.device_mesh.device_type if is_sharded(weight) else "cpu"
                made = nn.Parameter(torch.empty_like(weight, device=place), weight.requires_grad)
                setattr(module, name, made)


@torch.no_grad()
def fill(tensor: Tensor, whole: Tensor) -> None:
    """Copy a whole tensor into one that may be sharded, and of another precision."""
    if is_sharded(tensor):
        from torch.distributed.tensor import distribute_tensor

        mesh, placements = tensor.device_mesh, tensor.placements
        whole = distribute_tensor(whole, mesh, placements, src_data_rank=None)
    tensor.copy_(whole)


def check_memory(num_bytes: int, *, where: str, max_bytes: int | None = None) -> None:
    """Raise LimitExceededError for weights that need more than a limit, or than is available."""
    limit = available_memory() if max_bytes is None else max_bytes
    if limit is not None and num_bytes > limit:
        raise LimitExceededError(
            f"{where}: needs {num_bytes / 1e9:.2f} GB of memory, expected at most "
            f"{limit / 1e9:.2f} GB; free some, use a machine with more, or precision bfloat16"
        )


def available_memory() -> int | None:
    """Bytes that new processes can use without swapping; None where Linux does not tell."""
    table = Path("/proc/meminfo")
    if not table.is_file():
        return None
    rows = dict(line.split(":", 1) for line in table.read_text().splitlines())
    return int(rows["MemAvailable"].split()[0]) * 1024 if "MemAvailable" in rows else None
