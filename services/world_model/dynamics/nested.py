"""Operations on all tensors of a dataclass, also of dataclasses within it."""

from collections.abc import Callable, Sequence
from dataclasses import fields
from functools import cache
from typing import Any, TypeVar

import torch
from torch import Tensor

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
