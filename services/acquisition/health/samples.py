"""Samples and counters of the last seconds, as the health checks look at them."""

import threading
from collections import Counter, deque
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float64, Int64, Shaped

from dextouch.streams import Sample, StreamDescriptor

WINDOW_NS = 10_000_000_000
# What is kept between two evaluations, which are a second apart.
KEPT_S = 4.0
MIN_ROLLING = 64
JUDGED_VALUES = ("tactile", "pose", "keypoints")


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


class SampleQueue:
    """A ring of one stream's newest stamps and values; any thread may add and take.

    A reader appends and goes on; when nobody evaluates, the oldest samples fall out and are
    counted in `num_dropped`. It takes its memory once, whatever waits in it.
    """

    def __init__(self, descriptor: StreamDescriptor) -> None:
        self.num_dropped = 0
        self._size = max(16, round(KEPT_S * descriptor.nominal_rate_hz))
        self._keeps_values = descriptor.kind in JUDGED_VALUES
        self._stamps = np.zeros((self._size, 4), dtype=np.int64)
        # Made of the first sample: its device decides on their type.
        self._values: np.ndarray | None = None
        self._num_added = self._num_taken = 0
        self._lock = threading.Lock()

    def add(self, samples: Sequence[Sample], now_ns: int) -> None:
        """Append a delivery (called by the reader thread, after its samples were spooled)."""
        if self._values is None and self._keeps_values:
            first = samples[0].values
            self._values = np.zeros((self._size, *first.shape), dtype=first.dtype)
        with self._lock:
            for sample in samples:
                place, t_host_ns = self._num_added % self._size, sample.t_host_ns
                stamps = (t_host_ns, sample.t_device_ns, sample.sequence, now_ns - t_host_ns)
                self._stamps[place] = stamps
                if self._values is not None:
                    self._values[place] = sample.values
                self._num_added += 1
            num_dropped = max(0, self._num_added - self._num_taken - self._size)
            self._num_taken += num_dropped
            self.num_dropped += num_dropped

    def take(self) -> Block:
        """Everything that waits, oldest first."""
        with self._lock:
            places = np.arange(self._num_taken, self._num_added) % self._size
            stamps = np.ascontiguousarray(self._stamps[places].T)
            values = None
            if self._values is not None and len(places):
                values = self._values[places]
            self._num_taken = self._num_added
        return Block(stamps[0], stamps[1], stamps[2], stamps[3], values)


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
