"""Traces of a model's operations, for worlds that are asked for many chunks.

A chunk of one rollout has a thousand small operations, and calling them from Python takes as
long as computing them. A trace (torch.jit) has the same operations in the same order, so that its
numbers are those of the model, bit for bit.
"""

import warnings
from collections import Counter
from collections.abc import Callable, Hashable, Iterator
from dataclasses import fields
from typing import Any, Final, Generic, TypeVar

import torch
from torch import Tensor, nn

# Tracing takes about a second: worth it for shapes that come again and again.
_CALLS_BEFORE: Final = 4
_MOST_TRACES: Final = 16
_WARM_UP_CALLS: Final = 3

Outputs = TypeVar("Outputs")


class Traced(Generic[Outputs]):
    """Stands in for a function of a model whose weights do not change any more.

    From the fourth call of a kind on, a call is computed by a trace; at most sixteen are kept, and
    further kinds are computed by the function.

    Args:
        model: its weights become constants of the traces.
        function: takes and returns tensors, or dataclasses and tuples of tensors.
        kind_of: kind of a call. Calls of one kind have the same shapes, and the function takes the
            same way through its code.
    """

    def __init__(
        self,
        model: nn.Module,
        function: Callable[..., Outputs],
        kind_of: Callable[..., Hashable],
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
        """A trace for inputs of these shapes, and outputs of its form."""
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


def _tensors(part: Any) -> Iterator[Tensor]:  # noqa: ANN401 - any nesting of dataclasses
    """All tensors of dataclasses and tuples of these, in the order of their fields."""
    if isinstance(part, Tensor):
        yield part
    elif isinstance(part, tuple):
        for one in part:
            yield from _tensors(one)
    else:
        for field in fields(part):
            yield from _tensors(getattr(part, field.name))


def _rebuilt(form: Any, tensors: Iterator[Tensor]) -> Any:  # noqa: ANN401 - any nesting of dataclasses
    """The form with other tensors."""
    if isinstance(form, Tensor):
        return next(tensors)
    if isinstance(form, tuple):
        return tuple(_rebuilt(one, tensors) for one in form)
    return type(form)(*[_rebuilt(getattr(form, field.name), tensors) for field in fields(form)])
