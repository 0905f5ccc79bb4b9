"""Layers and structures of all members of an ensemble at once."""

from collections.abc import Callable, Sequence
from dataclasses import fields
from functools import cache
from typing import Any, TypeVar

import torch
from jaxtyping import Float32
from torch import Tensor, nn
from torch.nn import functional

# Operations on all tensors of a dataclass, also of dataclasses within it.

Part = TypeVar("Part")


def combined(parts: Sequence[Part], change: Callable[[list[Tensor]], Tensor]) -> Part:
    """One tensor or dataclass from several of a kind: each tensor from theirs of the same name."""
    return named(parts, lambda _, tensors: change(tensors))


def named(
    parts: Sequence[Part], change: Callable[[str, list[Tensor]], Tensor], name: str = ""
) -> Part:
    """`combined` with names such as `start.objects.axes`."""
    first: Any = parts[0]
    made: Any
    if isinstance(first, Tensor):
        made = change(name, list[Any](parts))
    else:
        made = type(first)(
            **{
                field: named(
                    [getattr(part, field) for part in parts],
                    change,
                    f"{name}.{field}" if name else field,
                )
                for field in _names(first.__class__)
            }
        )
    result: Part = made
    return result


@cache
def _names(kind: type) -> tuple[str, ...]:
    return tuple(field.name for field in fields(kind))


def mapped(part: Part, change: Callable[[Tensor], Tensor]) -> Part:
    """A copy with every tensor changed."""
    return combined([part], lambda tensors: change(tensors[0]))


def folded(part: Part) -> Part:
    """[members, batch, …] as [members · batch, …]."""
    return mapped(part, lambda tensor: tensor.flatten(0, 1))


def unfolded(part: Part, members: int) -> Part:
    """Inverse of `folded`."""
    return mapped(part, lambda tensor: tensor.reshape(members, -1, *tensor.shape[1:]))


def stacked(parts: Sequence[Part]) -> Part:
    """Parts stacked along a new first axis."""
    return combined(parts, torch.stack)


# Layers with separate weights for every member of an ensemble, computed for all members at once.
#
# Inputs and outputs have one batch axis in which each member's entries follow each other, all
# members with equally many. At the sizes of a single rollout a small network takes as long as its
# number of operations, so that an ensemble costs about as much as one of its members.


class MemberLinear(nn.Module):
    """A linear layer; initialized as `nn.Linear`.

    Args:
        members: number of members.
        inputs: size of the input's last axis.
        outputs: size of the output's last axis.
    """

    def __init__(self, members: int, inputs: int, outputs: int) -> None:
        super().__init__()
        bound = inputs**-0.5
        self.weight = nn.Parameter(torch.empty(members, inputs, outputs).uniform_(-bound, bound))
        self.bias = nn.Parameter(torch.empty(members, outputs).uniform_(-bound, bound))

    def forward(self, x: Float32[Tensor, "entries *shape inputs"]) -> Tensor:
        """The outputs [entries, *shape, outputs]."""
        members, inputs, outputs = self.weight.shape
        rows = x.reshape(members, -1, inputs)
        return torch.baddbmm(self.bias[:, None], rows, self.weight).view(*x.shape[:-1], outputs)


class MemberNorm(nn.Module):
    """A layer normalization of the last axis (Ba et al. 2016).

    Args:
        members: number of members.
        width: size of the last axis.
    """

    def __init__(self, members: int, width: int) -> None:
        super().__init__()
        self.weight = nn.Parameter(torch.ones(members, width))
        self.bias = nn.Parameter(torch.zeros(members, width))

    def forward(self, x: Float32[Tensor, "entries width"]) -> Float32[Tensor, "entries width"]:
        """The normalized entries."""
        rows = functional.layer_norm(x, x.shape[-1:]).view(len(self.weight), -1, x.shape[-1])
        return torch.addcmul(self.bias[:, None], rows, self.weight[:, None]).view(x.shape)


class MemberGRU(nn.Module):
    """A gated recurrent cell (Cho et al. 2014), as `nn.GRUCell`.

    Args:
        members: number of members.
        inputs: size of an input.
        width: size of the state.
    """

    def __init__(self, members: int, inputs: int, width: int) -> None:
        super().__init__()
        self.input = MemberLinear(members, inputs, 3 * width)
        self.recurrent = MemberLinear(members, width, 3 * width)

    def forward(
        self, x: Float32[Tensor, "entries inputs"], state: Float32[Tensor, "entries width"]
    ) -> Float32[Tensor, "entries width"]:
        """The next state."""
        width = state.shape[-1]
        fresh, kept = self.input(x), self.recurrent(state)
        reset, update = (fresh[:, : 2 * width] + kept[:, : 2 * width]).sigmoid().chunk(2, dim=1)
        new = torch.addcmul(fresh[:, 2 * width :], reset, kept[:, 2 * width :]).tanh()
        return torch.lerp(new, state, update)
