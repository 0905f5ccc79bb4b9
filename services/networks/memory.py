"""Memory that weights need, compared with what a machine or device has before they are placed."""

from collections.abc import Mapping
from pathlib import Path
from typing import TypeVar

import torch
from torch import Tensor, nn

from dextouch.errors import LimitExceededError, UnavailableError

Network = TypeVar("Network", bound=nn.Module)


def on_device(network: Network, device: str) -> Network:
    """Move a network to a device, in place.

    Raises:
        UnavailableError: torch has no such device here.
        LimitExceededError: a CUDA device with less free memory than the weights need.
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


def memory_of(tensors: Mapping[str, Tensor]) -> int:
    """Bytes of tensors, which may be on the meta device."""
    return sum(tensor.numel() * tensor.element_size() for tensor in tensors.values())


def check_memory(num_bytes: int, *, where: str, max_bytes: int | None = None) -> None:
    """Refuse weights that do not fit.

    Args:
        num_bytes: memory that the weights need.
        where: context for the error message.
        max_bytes: limit; None for the memory that is available.

    Raises:
        LimitExceededError: more than the limit.
    """
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
