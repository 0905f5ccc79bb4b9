"""Samples and counters of the last seconds, as the health checks look at them."""

from collections import Counter, deque
from collections.abc import Callable, Mapping
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float64, Int64, Shaped

WINDOW_NS = 10_000_000_000
MIN_ROLLING = 64


@dataclass(frozen=True)
class Block:
    """Consecutive samples of one stream since the last evaluation.

    `latency_ns` is the time from a read's timestamp until its samples were spooled; `values` is
    None for streams whose values are not checked.
    """

    t_host_ns: Int64[np.ndarray, " n"]
    t_device_ns: Int64[np.ndarray, " n"]
    sequence: Int64[np.ndarray, " n"]
    latency_ns: Int64[np.ndarray, " n"]
    values: Shaped[np.ndarray, "n ..."] | None = None

    def __len__(self) -> int:
        return len(self.t_host_ns)


class CountWindow:
    """Counters that only grow, and by how much they grew within the last 10 s.

    Args:
        count: the counters at this moment, by name.
        now_ns: this moment.
    """

    def __init__(self, count: Callable[[], Mapping[str, int]], now_ns: int = 0) -> None:
        self._count = count
        self.history = deque([(now_ns, count())])

    def growth(self, now_ns: int) -> Counter[str]:
        """Look again; growth since the last look that is 10 s old, or since the first one."""
        history = self.history
        history.append((now_ns, self._count()))
        while len(history) > 2 and history[1][0] <= now_ns - WINDOW_NS:
            history.popleft()
        grown = Counter(history[-1][1])
        grown.subtract(history[0][1])
        return grown


class Rolling:
    """Numbers with their times, those of the last `span_ns` only.

    Its arrays grow to what a full span needs and stay as they are: windows that come and go in
    ever other sizes leave holes in the memory that nothing else fits into.
    """

    def __init__(self, span_ns: int = WINDOW_NS) -> None:
        self._span_ns = span_ns
        self._t_ns = np.zeros(MIN_ROLLING, dtype=np.int64)
        self._values = np.zeros(MIN_ROLLING)
        self._count = 0

    def add(self, t_ns: np.ndarray, values: np.ndarray, now_ns: int) -> np.ndarray:
        """Append, forget what is too old, and give the rest: a view that the next call changes."""
        stop = self._count + len(t_ns)
        while stop > len(self._t_ns):
            self._t_ns = np.concatenate([self._t_ns, np.zeros_like(self._t_ns)])
            self._values = np.concatenate([self._values, np.zeros_like(self._values)])
        self._t_ns[self._count : stop] = t_ns
        self._values[self._count : stop] = values
        kept = np.flatnonzero(self._t_ns[:stop] >= now_ns - self._span_ns)
        self._count = len(kept)
        if self._count < stop:
            self._t_ns[: self._count] = self._t_ns[kept]
            self._values[: self._count] = self._values[kept]
        return self.values

    @property
    def values(self) -> Float64[np.ndarray, " n"]:
        """What is kept."""
        return self._values[: self._count]

    @property
    def t_ns(self) -> Int64[np.ndarray, " n"]:
        """Times of what is kept."""
        return self._t_ns[: self._count]
