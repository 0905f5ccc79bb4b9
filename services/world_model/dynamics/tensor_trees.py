"""Operations on all tensors of nested dataclasses, and traces of functions that take such trees.

All but traces are of arrays of numpy, too.

A trace (torch.jit) has the same operations, which calls from Python make twice as slow.
"""

import warnings
from collections import Counter
from collections.abc import Callable, Hashable, Iterator, Sequence
from dataclasses import fields
from functools import cache
from typing import Any, Final, Generic, TypeVar

import numpy as np
import torch
from jaxtyping import Bool
from torch import Tensor, nn

# Tracing takes about a second: worth it for shapes that come again and again.
_CALLS_BEFORE: Final = 4
_MOST_TRACES: Final = 16
_WARM_UP_CALLS: Final = 3
_LEAF_TYPES: Final = (Tensor, np.ndarray)
Part = TypeVar("Part")
Outputs = TypeVar("Outputs")


def combined(parts: Sequence[Part], change: Callable[[list[Any]], Any]) -> Part:
    """One tensor or dataclass from several of a kind: each tensor from theirs of the same name."""
    return named(parts, lambda _, tensors: change(tensors))


def named(parts: Sequence[Part], change: Callable[[str, list[Tensor]], Tensor]) -> Part:
    """`combined` with names such as `start.objects.axes`."""
    each = zip(_names(parts[0]), *map(_tensors, parts), strict=True)
    made: Part = _rebuilt(parts[0], (change(name, tensors) for name, *tensors in each))
    return made


def by_name(part: object, name: str = "") -> dict[str, Any]:
    """All tensors of a dataclass by names as those of `named`, below a name."""
    return dict(zip(_names(part, name), _tensors(part), strict=True))


def mapped(part: Part, change: Callable[[Any], Any]) -> Part:
    """A copy with every tensor changed."""
    return combined([part], lambda tensors: change(tensors[0]))


def chosen(rows: Bool[Tensor, " batch"], these: Part, others: Part) -> Part:
    """Some rows of these, the other ones of others."""
    return combined(
        [these, others],
        lambda pair: torch.where(rows.view(-1, *[1] * (pair[0].ndim - 1)), pair[0], pair[1]),
    )


def folded(part: Part) -> Part:
    """[members, batch, …] as [members · batch, …]."""
    return mapped(part, lambda tensor: tensor.flatten(0, 1))


def unfolded(part: Part, members: int) -> Part:
    """Inverse of `folded`."""
    return mapped(part, lambda tensor: tensor.reshape(members, -1, *tensor.shape[1:]))


def stacked(parts: Sequence[Part]) -> Part:
    """Parts stacked along a new first axis."""
    return combined(parts, torch.stack)


class Traced(Generic[Outputs]):
    """A function of a model whose weights do not change any more, and become constants of traces.

    From the fourth call of a kind on, a trace computes it; at most sixteen are kept. Calls of one
    kind, as `kind_of` says, have the same shapes and the same way through its code.
    """

    def __init__(
        self, model: nn.Module, function: Callable[..., Outputs], kind_of: Callable[..., Hashable]
    ) -> None:
        self._model, self._function, self._kind_of = model, function, kind_of
        self._calls: Counter[Hashable] = Counter()
        self._traces: dict[Hashable, tuple[Callable[..., tuple[Tensor, ...]], Outputs]] = {}

    def __call__(self, *inputs: Any) -> Outputs:  # noqa: ANN401 - those of the function
        """The function's outputs."""
        kind = self._kind_of(*inputs)
        if kind not in self._traces:
            self._calls[kind] += 1
            if self._calls[kind] < _CALLS_BEFORE or len(self._traces) >= _MOST_TRACES:
                return self._function(*inputs)
            self._traces[kind] = self._traced(inputs)
        trace, form = self._traces[kind]
        outputs: Outputs = _rebuilt(form, iter(trace(*_tensors(inputs))))
        return outputs

    def _traced(self, inputs: tuple[Any, ...]) -> tuple[Callable[..., tuple[Tensor, ...]], Outputs]:
        forms: list[Outputs] = []
        function = self._function

        class Flat(nn.Module):
            def __init__(self, model: nn.Module) -> None:
                super().__init__()
                self.model = model

            def forward(self, *tensors: Tensor) -> tuple[Tensor, ...]:
                outputs = function(*_rebuilt(inputs, iter(tensors)))
                forms.append(outputs)
                return tuple(_tensors(outputs))

        given = tuple(_tensors(inputs))
        with warnings.catch_warnings(), torch.no_grad():
            # Numbers that become constants depend on the kind alone.
            warnings.simplefilter("ignore")
            whole = torch.jit.trace(  # type: ignore[no-untyped-call]
                Flat(self._model).eval(), given, check_trace=False
            )
            trace = torch.jit.freeze(whole)
            for _ in range(_WARM_UP_CALLS):
                trace(*given)
        return trace, forms[0]


def _tensors(part: Any) -> Iterator[Any]:  # noqa: ANN401 - any nesting of dataclasses
    """All tensors of dataclasses and tuples of these, in the order of their fields."""
    if isinstance(part, _LEAF_TYPES):
        yield part
    else:
        for one in _parts(part):
            yield from _tensors(one)


def _rebuilt(form: Any, tensors: Iterator[Any]) -> Any:  # noqa: ANN401 - any nesting of dataclasses
    if isinstance(form, _LEAF_TYPES):
        return next(tensors)
    parts = [_rebuilt(one, tensors) for one in _parts(form)]
    return tuple(parts) if isinstance(form, tuple) else type(form)(*parts)


def _names(part: Any, name: str = "") -> Iterator[str]:  # noqa: ANN401 - as above
    """Names of the tensors of dataclasses and tuples, in the order of `_tensors`."""
    if isinstance(part, _LEAF_TYPES):
        yield name
        return
    named_by = map(str, range(len(part))) if isinstance(part, tuple) else _fields(part.__class__)
    for field, one in zip(named_by, _parts(part), strict=True):
        yield from _names(one, f"{name}.{field}" if name else field)


def _parts(part: Any) -> Sequence[Any]:  # noqa: ANN401 - as above
    if isinstance(part, tuple):
        return part
    return [getattr(part, field) for field in _fields(part.__class__)]


@cache
def _fields(kind: type) -> tuple[str, ...]:
    return tuple(field.name for field in fields(kind))
