"""Processes of a training run that share its batches and its weights (FSDP2), under torchrun.

Every process draws the windows and the noise of the whole batch from the same seed and keeps its
own part, so that losses and weights do not depend on the number of processes, except for rounding.
"""

import warnings
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Any, TypeVar

import torch
from torch import Tensor, distributed, nn
from torch.distributed.checkpoint.state_dict import (
    StateDictOptions,
    get_model_state_dict,
    set_model_state_dict,
)
from torch.distributed.device_mesh import DeviceMesh, init_device_mesh
from torch.distributed.fsdp import fully_shard

from dextouch.errors import InvalidInputError

Whole = TypeVar("Whole", Tensor, list[Any])


@dataclass(frozen=True)
class Processes:
    """Processes of one run; without torchrun there is one, with no `mesh`."""

    rank: int = 0
    count: int = 1
    mesh: DeviceMesh | None = None

    @property
    def is_first(self) -> bool:
        """Whether this process writes files and reports progress."""
        return self.rank == 0

    def check(self, batch: int, device: str) -> None:
        """Refuse a batch that cannot be divided, and a device that several cannot share yet.

        Raises:
            InvalidInputError: not a multiple of the number of processes, or several processes on
                another device than the processor.
        """
        if batch % self.count:
            raise InvalidInputError(
                f"training: got batches of {batch} windows for {self.count} processes, expected a "
                "multiple; change --optimizer.batch or --nproc-per-node"
            )
        if self.mesh is not None and device != "cpu":
            raise InvalidInputError(
                f"training: got {self.count} processes on {device}, expected cpu; several "
                "processes train on processors only"
            )

    def rand(self, shape: Sequence[int], generator: torch.Generator) -> Tensor:
        """This process's part, of this shape, of uniform numbers drawn for the whole batch."""
        return self.own(torch.rand(shape[0] * self.count, *shape[1:], generator=generator))

    def randn(self, shape: Sequence[int], generator: torch.Generator) -> Tensor:
        """As `rand`, of Gaussian noise."""
        return self.own(torch.randn(shape[0] * self.count, *shape[1:], generator=generator))

    def own(self, whole: Whole) -> Whole:
        """This process's part of the whole batch."""
        return whole[self.rank :: self.count]

    def mean(self, value: Tensor) -> Tensor:
        """Mean over processes of a tensor without gradient."""
        if self.mesh is None:
            return value
        total = value.detach().clone()
        distributed.all_reduce(total)
        return total / self.count

    def std(self, value: Tensor) -> Tensor:
        """Standard deviation over the tensors of all processes, which have one shape."""
        if self.mesh is None:
            return value.std()
        squares = (value - self.mean(value.mean())).square().sum()
        return (self.count * self.mean(squares) / (self.count * value.numel() - 1)).sqrt()

    def shard(self, model: nn.Module, layers: nn.ModuleList) -> None:
        """Keep only this process's share of every learned weight, gathered layer by layer.

        Frozen weights and statistics stay whole, since they are used outside of `forward`.

        Raises:
            InvalidInputError: learned weights of several precisions.
        """
        if self.mesh is None:
            return
        frozen = {weight for weight in model.parameters() if not weight.requires_grad}
        kinds = {str(weight.dtype) for weight in model.parameters() if weight.requires_grad}
        if len(kinds) > 1:
            raise InvalidInputError(
                f"training: got learned weights of {', '.join(sorted(kinds))} in {self.count} "
                "processes, expected one precision; use --network.wan.precision float32"
            )
        for module in (*layers, model):
            fully_shard(module, mesh=self.mesh, ignored_params=frozen)


ALONE = Processes()


@contextmanager
def joined_processes() -> Iterator[Processes]:
    """The processes that torchrun started; `ALONE` without it."""
    if not distributed.is_torchelastic_launched():
        yield ALONE
        return
    distributed.init_process_group("gloo")
    try:
        count = distributed.get_world_size()
        mesh = init_device_mesh("cpu", (count,))
        with warnings.catch_warnings():
            # Nothing is changed in place.
            warnings.filterwarnings("ignore", message="FSDP2-wrapped module .* a view tensor")
            yield Processes(distributed.get_rank(), count, mesh)
    finally:
        distributed.destroy_process_group()


def whole_weights(model: nn.Module) -> dict[str, Tensor]:
    """Whole weights of a model, which may be sharded; empty in all processes but the first."""
    options = StateDictOptions(full_state_dict=True, cpu_offload=True)
    weights = get_model_state_dict(model, options=options)
    if distributed.is_initialized():
        # The others may leave from here on.
        distributed.barrier()
    return {name: weight for name, weight in weights.items() if isinstance(weight, Tensor)}


def load_whole(model: nn.Module, weights: Mapping[str, Tensor]) -> None:
    """Load whole weights into a model, which may be sharded."""
    set_model_state_dict(model, dict(weights), options=StateDictOptions(full_state_dict=True))
