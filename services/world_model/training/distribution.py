"""Processes of a training run that share its batches and its weights (FSDP2), under torchrun.

Each draws windows and noise of the whole batch from the same seed and keeps its own part.
"""

import os
import warnings
from collections.abc import Collection, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Any, Final, TypeVar

import torch
from torch import Tensor, distributed, nn
from torch.distributed.checkpoint.state_dict import (
    StateDictOptions,
    get_model_state_dict,
    set_model_state_dict,
)
from torch.distributed.device_mesh import DeviceMesh, init_device_mesh
from torch.distributed.fsdp import fully_shard

from dextouch.errors import InvalidInputError, UnavailableError
from services.networks.optimizer import learned_weights

Whole = TypeVar("Whole", Tensor, list[Any])


@dataclass(frozen=True)
class Processes:
    """Processes of one run; one without `mesh`, which of two dimensions has copies of the model."""

    rank: int = 0
    count: int = 1
    mesh: DeviceMesh | None = None

    @property
    def is_first(self) -> bool:
        """Whether this process writes files and reports progress."""
        return self.rank == 0

    def check(self, batch: int, accumulate: int) -> None:
        """Raise InvalidInputError unless a batch can be divided into parts of each process."""
        if batch % (self.count * accumulate):
            raise InvalidInputError(
                f"training: got batches of {batch} windows for {self.count} processes with "
                f"--accumulate {accumulate}, expected a multiple of {self.count * accumulate}; "
                "change --optimizer.batch, --accumulate or --nproc-per-node"
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

    def shard(
        self, model: nn.Module, layers: nn.ModuleList, whole: Collection[nn.Module] = ()
    ) -> None:
        """Keep this process's share of every weight, gathered layer by layer, but of `whole`.

        Raises:
            InvalidInputError: learned weights of several precisions.
        """
        if self.mesh is None:
            return
        ignored = {weight for part in whole for weight in part.parameters()}
        kinds = {str(weight.dtype) for weight in learned_weights(model).values()}
        if len(kinds) > 1:
            raise InvalidInputError(
                f"training: got learned weights of {', '.join(sorted(kinds))} in {self.count} "
                "processes, expected one precision; use --network.wan.precision float32, or freeze "
                "the video expert with --lora.rank or --freeze-video"
            )
        for module in (*layers, model):
            fully_shard(module, mesh=self.mesh, ignored_params=ignored)


ALONE = Processes()
# Counters are on the processor, whatever the device of the weights.
_BACKENDS: Final = {"cpu": "gloo", "cuda": "cpu:gloo,cuda:nccl"}


@contextmanager
def joined_processes(device: str = "cpu", replicas: int = 1) -> Iterator[Processes]:
    """The processes that torchrun started, on cuda each with its own GPU; `ALONE` without it.

    Raises:
        InvalidInputError: another device, or processes that are no multiple of `replicas`.
        UnavailableError: fewer GPUs than processes on this machine.
    """
    if not distributed.is_torchelastic_launched():
        if replicas > 1:
            raise InvalidInputError(
                f"training: got --replicas {replicas} for one process; start several with torchrun"
            )
        yield ALONE
        return
    if device not in _BACKENDS:
        raise InvalidInputError(
            f"training: got device {device} under torchrun, expected {' or '.join(_BACKENDS)}; "
            "each process takes the GPU of its own number"
        )
    if device == "cuda":
        own, there = int(os.environ["LOCAL_RANK"]), torch.cuda.device_count()
        if own >= there:
            raise UnavailableError(
                f"training: process {own} of this machine finds {there} GPUs; start as many with "
                "--nproc-per-node, or use --device cpu"
            )
        torch.cuda.set_device(own)
    distributed.init_process_group(_BACKENDS[device])
    try:
        count = distributed.get_world_size()
        if count % replicas:
            raise InvalidInputError(
                f"training: got {count} processes for --replicas {replicas}, expected a multiple; "
                "change --replicas, or the number of processes"
            )
        sizes = (replicas, count // replicas) if replicas > 1 else (count,)
        names = ("replicas", "shards")[-len(sizes) :]
        mesh = init_device_mesh(device, sizes, mesh_dim_names=names)
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
    """Load whole weights into a model, which may be sharded; weights that are not named stay."""
    options = StateDictOptions(full_state_dict=True, strict=False)
    set_model_state_dict(model, dict(weights), options=options)
