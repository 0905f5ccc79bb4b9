"""Values kept for the next chunks, the least recently used ones dropped: contexts and texts."""

from collections.abc import Callable, Hashable, Sequence
from typing import Generic, TypeVar

Value = TypeVar("Value")


class LastUsed(Generic[Value]):
    """At most `size` values by key; not for several threads."""

    def __init__(self, size: int) -> None:
        self._size = size
        self._values: dict[Hashable, Value] = {}

    def of(
        self, keys: Sequence[Hashable], compute: Callable[[list[int]], Sequence[Value]]
    ) -> list[Value]:
        """Values of the keys; `compute` is given the first index of each key that is not kept."""
        missing = {key: keys.index(key) for key in dict.fromkeys(keys) if key not in self._values}
        made = compute(list(missing.values())) if missing else []
        values = {**self._values, **dict(zip(missing, made, strict=True))}
        used = {key: values.pop(key) for key in dict.fromkeys(keys)}
        self._values = dict([*values.items(), *used.items()][-self._size :])
        return [used[key] for key in keys]
