"""Operations on torch's meta device counted in FLOPs and bytes, with quick rules for their shapes.

Torch's own rules take up to a millisecond an operation and import its compiler, which takes longer
than torch itself. They are the reference (`tests/unit/world_model/test_meta_device.py`) and serve
where there is no rule here.
"""

import math
import weakref
from collections.abc import Callable, Hashable, Iterable, Mapping, Sequence
from functools import partial, reduce
from typing import Any, ClassVar, Final

import torch
from torch import Tensor
from torch.utils._python_dispatch import TorchDispatchMode
from torch.utils._pytree import tree_leaves, tree_map_only
from torch.utils.flop_counter import flop_registry

_ATEN: Final = torch.ops.aten
_COMPARISONS: Final = (_ATEN.eq, _ATEN.ge, _ATEN.gt, _ATEN.le, _ATEN.lt, _ATEN.ne)
_KINDS: Final[dict[type, torch.dtype]] = {bool: torch.bool, int: torch.int64}
_TO_FLOATS: Final = (_ATEN.div, _ATEN.exp, _ATEN.cos, _ATEN.sin)
_OF_ANY_KIND: Final = (
    *(_ATEN.add, _ATEN.sub, _ATEN.mul, _ATEN.neg, _ATEN.clone, _ATEN.where),
    *(_ATEN.bitwise_not, _ATEN.bitwise_or, _ATEN.bitwise_and),
)


class MetaTrace(TorchDispatchMode):  # type: ignore[no-untyped-call]
    """FLOPs inside the context, and the largest sum of tensors made there and alive at one time.

    Tensors are of the meta device. Results that share nothing with what was given are made as those
    of an equal operation before.
    """

    _known: ClassVar[dict[Hashable, tuple[int, object]]] = {}

    def __init__(self, given: Iterable[Tensor] = ()) -> None:
        super().__init__()  # type: ignore[no-untyped-call]
        self.flops = self.peak_bytes = self.regarded_peak_bytes = 0
        self._now_bytes = self._regarded_bytes = 0
        # Views share the storage of their tensor. Held, since storages are known by identity.
        self._given = [tensor.untyped_storage() for tensor in given]
        # Bytes of each, and those that are regarded.
        self._alive = {weakref.ref(storage): (0, 0) for storage in self._given}

    @classmethod
    def _should_skip_dynamo(cls) -> bool:
        # Nothing is compiled here; to skip the compiler would import it.
        return False

    def __torch_dispatch__(
        self,
        func: Any,  # noqa: ANN401 - an operator, of a private class
        types: object,
        args: tuple[Any, ...] = (),
        kwargs: Mapping[str, Any] | None = None,
    ) -> object:
        """Make what an operation returns, and count its FLOPs and new tensors."""
        kwargs = kwargs or {}
        if func.is_view:
            return func(*args, **kwargs)
        name = func.overloadpacket.__name__
        if name.endswith("_") and not name.endswith("__"):
            # In place.
            return args[0]
        key = func, _form(args), _form(tuple(kwargs.items()))
        flops, recipe = self._known.get(key, (None, None))
        result = _computed(func, args, kwargs) if recipe is None else _made(recipe)
        if flops is None:
            count = flop_registry.get(func.overloadpacket)
            flops = 0 if count is None else count(*args, **kwargs, out_val=result)
            self._known[key] = flops, _recipe(result, (args, kwargs))
        self.flops += flops
        for leaf in [result] if isinstance(result, Tensor) else tree_leaves(result):
            if isinstance(leaf, Tensor):
                self._count(leaf.untyped_storage())
        return result

    def _count(self, storage: torch.UntypedStorage) -> None:
        entry = weakref.ref(storage, self._free)
        if entry in self._alive:
            return
        size = storage.nbytes()
        self._alive[entry] = size, size
        self._now_bytes += size
        self._regarded_bytes += size
        self.peak_bytes = max(self.peak_bytes, self._now_bytes)
        self.regarded_peak_bytes = max(self.regarded_peak_bytes, self._regarded_bytes)

    def disregard(self, tensor: Tensor) -> None:
        """From now on, `regarded_peak_bytes` is as if this tensor were freed."""
        entry = weakref.ref(tensor.untyped_storage())
        size, regarded = self._alive[entry]
        self._regarded_bytes -= regarded
        self._alive[entry] = size, 0

    def _free(self, entry: weakref.ref[torch.UntypedStorage]) -> None:
        size, regarded = self._alive.pop(entry)
        self._now_bytes -= size
        self._regarded_bytes -= regarded


def _form(value: Any) -> Hashable:  # noqa: ANN401 - any argument of an operation
    """What the results of an operation depend on, but for their values."""
    if isinstance(value, Tensor):
        return value.shape, value.stride(), value.dtype
    if isinstance(value, tuple | list):
        return tuple(map(_form, value))
    # One, True and 1.0 are equal.
    return type(value), value


def _recipe(result: object, given: object) -> object:
    """How to make tensors as those of a result; None if they share memory with what was given."""
    made = [one for one in tree_leaves(result) if isinstance(one, Tensor)]
    others = {one.untyped_storage() for one in tree_leaves(given) if isinstance(one, Tensor)}
    own = {one.untyped_storage() for one in made} - others
    is_dense = [_copy(one)().untyped_storage().nbytes() for one in made] == [
        one.untyped_storage().nbytes() for one in made
    ]
    return tree_map_only(Tensor, _copy, result) if is_dense and len(own) == len(made) > 0 else None


def _copy(tensor: Tensor) -> Callable[[], Tensor]:
    return partial(
        torch.empty_strided, tensor.shape, tensor.stride(), dtype=tensor.dtype, device="meta"
    )


def _made(recipe: object) -> object:
    if isinstance(recipe, tuple | list):
        return type(recipe)(map(_made, recipe))
    return recipe() if callable(recipe) else recipe


def _computed(func: Any, args: tuple[Any, ...], kwargs: Mapping[str, Any]) -> object:  # noqa: ANN401
    rule = _RULES.get(func.overloadpacket)
    if rule is not None:
        return rule(*args, **kwargs)
    if torch.Tag.pointwise in func.tags:
        result = _pointwise(func.overloadpacket, *args, **kwargs)
        if result is not None:
            return result
    return func(*args, **kwargs)


def _pointwise(packet: object, *args: Any, memory_format: Any = None, **_: object) -> Tensor | None:  # noqa: ANN401
    """A tensor of the broadcast shape and common kind; None where that is another."""
    tensors = [one for one in args if isinstance(one, Tensor)]
    shapes: list[Sequence[int]] = [one.shape for one in tensors]
    shape = tuple(reduce(_broadcast, shapes))
    values = args[1:] if packet is _ATEN.where else args
    numbers = [one for one in values if isinstance(one, Tensor | int | float)]
    dtype = tensors[-1].dtype if len(numbers) == 1 else _common(numbers)
    if packet in _COMPARISONS:
        dtype = torch.bool
    elif packet in _TO_FLOATS and not dtype.is_floating_point:
        dtype = torch.get_default_dtype()
    elif not dtype.is_floating_point and packet not in _OF_ANY_KIND:
        return None
    whole = [one for one in tensors if one.shape == shape and 0 not in one.stride()]
    if not whole or memory_format is torch.contiguous_format:
        return _empty(shape, dtype)
    # As the first whole operand lies in memory.
    strides, size = [0] * len(shape), 1
    for axis in sorted(range(len(shape)), key=lambda i: (whole[0].stride(i), -i)):
        strides[axis], size = size, size * shape[axis]
    return torch.empty_strided(shape, strides, dtype=dtype, device="meta")


def _common(numbers: Sequence[Any]) -> torch.dtype:
    """Kind of what several tensors and numbers are computed to."""
    first, *others = numbers
    for other in others[:-1]:
        first = _empty((1,), torch.result_type(first, other))
    return torch.result_type(first, others[-1])


def _broadcast(one: Sequence[int], other: Sequence[int]) -> Sequence[int]:
    rank = max(len(one), len(other))
    pairs = zip(*([1] * (rank - len(x)) + list(x) for x in (one, other)), strict=True)
    return [b if a == 1 else a for a, b in pairs]


def _empty(shape: Sequence[int], kind: Tensor | torch.dtype) -> Tensor:
    dtype = kind.dtype if isinstance(kind, Tensor) else kind
    return torch.empty(tuple(shape), dtype=dtype, device="meta")


def _reduced(
    x: Tensor,
    dim: Sequence[int] | None = None,
    keepdim: bool = False,  # noqa: FBT001, FBT002 - as torch calls it
    dtype: torch.dtype | None = None,
) -> Tensor:
    axes = {axis % x.ndim for axis in (dim or range(x.ndim))}
    kept = [(1 if axis in axes else n) for axis, n in enumerate(x.shape)]
    kind = dtype or (x.dtype if x.dtype.is_floating_point else torch.int64)
    return _empty(kept if keepdim else [n for i, n in enumerate(x.shape) if i not in axes], kind)


def _joined(tensors: Sequence[Tensor], dim: int = 0) -> Tensor:
    shape = list(tensors[0].shape)
    shape[dim] = sum(one.shape[dim] for one in tensors)
    return _empty(shape, reduce(torch.promote_types, (one.dtype for one in tensors)))


def _stacked(tensors: Sequence[Tensor], dim: int = 0) -> Tensor:
    shape = list(tensors[0].shape)
    shape.insert(dim % (len(shape) + 1), len(tensors))
    return _empty(shape, tensors[0])


def _counted_up(*ends: int | float, dtype: torch.dtype | None = None, **_: object) -> Tensor:
    start, end, step = (0, *ends, 1) if len(ends) == 1 else (*ends, 1)[:3]
    is_whole = all(isinstance(one, int) for one in ends)
    kind = dtype or (torch.int64 if is_whole else torch.get_default_dtype())
    return _empty((math.ceil((end - start) / step),), kind)


def _repeated(x: Tensor, times: Sequence[int]) -> Tensor:
    shape = [1] * (len(times) - x.ndim) + list(x.shape)
    return _empty([n * count for n, count in zip(shape, times, strict=True)], x)


def _filled(
    shape: Sequence[int], *_: object, dtype: torch.dtype | None = None, **__: object
) -> Tensor:
    return _empty(shape, dtype or torch.get_default_dtype())


def _like(x: Tensor, *_: object, dtype: torch.dtype | None = None, **__: object) -> Tensor:
    return _empty(x.shape, dtype or x)


def _normed(x: Tensor, shape: Sequence[int], *_: object) -> tuple[Tensor, Tensor, Tensor]:
    rows = (*x.shape[: x.ndim - len(shape)], *[1] * len(shape))
    return _empty(x.shape, x), _empty(rows, x), _empty(rows, x)


def _normed_backward(*args: Any) -> tuple[Tensor | None, ...]:  # noqa: ANN401
    _, x, shape, *_, weight, bias, mask = args
    parts = (x.shape, shape, shape)
    kinds = (x, weight, bias)
    return tuple(
        _empty(part, kind) if needed else None
        for part, kind, needed in zip(parts, kinds, mask, strict=True)
    )


_RULES: Final[dict[object, Callable[..., object]]] = {
    _ATEN.mm: lambda a, b: _empty((a.shape[0], b.shape[1]), a),
    _ATEN.bmm: lambda a, b: _empty((*a.shape[:2], b.shape[2]), a),
    _ATEN.addmm: lambda _, a, b, **__: _empty((a.shape[0], b.shape[1]), a),
    _ATEN._unsafe_view: lambda x, shape: x.view(shape),  # noqa: SLF001
    _ATEN.sum: _reduced,
    _ATEN.mean: _reduced,
    _ATEN.cat: _joined,
    _ATEN.stack: _stacked,
    _ATEN.zeros: _filled,
    _ATEN.ones: _filled,
    _ATEN.randn: _filled,
    _ATEN.full: lambda shape, value, **kind: _filled(
        shape, dtype=kind.get("dtype") or _KINDS.get(type(value))
    ),
    _ATEN.arange: _counted_up,
    _ATEN.scalar_tensor: lambda _, **kind: _filled((), **kind),
    _ATEN.new_empty_strided: lambda x, shape, stride, **_: torch.empty_strided(
        shape, stride, dtype=x.dtype, device="meta"
    ),
    _ATEN.new_zeros: lambda x, shape, **__: _empty(shape, x),
    _ATEN.zeros_like: _like,
    _ATEN.ones_like: _like,
    _ATEN.native_layer_norm: _normed,
    _ATEN.native_layer_norm_backward: _normed_backward,
    _ATEN._safe_softmax: _like,  # noqa: SLF001
    _ATEN._softmax_backward_data: lambda gradient, *_: _empty(gradient.shape, gradient),  # noqa: SLF001
    _ATEN.slice_backward: lambda gradient, shape, *_: _empty(shape, gradient),
    _ATEN.select_backward: lambda gradient, shape, *_: _empty(shape, gradient),
    _ATEN.flip: _like,
    _ATEN.repeat: _repeated,
    _ATEN.embedding: lambda weight, rows, *_: _empty((*rows.shape, weight.shape[1]), weight),
    _ATEN.embedding_dense_backward: lambda gradient, _, num, *__: _empty(
        (num, gradient.shape[-1]), gradient
    ),
}
