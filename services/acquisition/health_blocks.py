"""Samples come in from the reader threads; blocks of stamps and values go out, for the judges."""

from collections import deque
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float64, Int64, Shaped

from dextouch.streams.descriptors import StreamDescriptor
from dextouch.streams.samples import Sample
from services.acquisition.clock import StationClock

# What is kept between two evaluations, which are a second apart.
KEPT_S = 4.0
MIN_ROLLING = 64
JUDGED_VALUES = ("tactile", "pose", "keypoints")


@dataclass(frozen=True)
class Block:
    """Consecutive samples of one stream since the last evaluation.

    `values` is None for streams whose values no judge looks at; `latency_ns` are times from a
    read's stamp until its samples were spooled, one a delivery.
    """

    t_host_ns: Int64[np.ndarray, " n"]
    t_device_ns: Int64[np.ndarray, " n"]
    sequence: Int64[np.ndarray, " n"]
    latency_ns: Int64[np.ndarray, " k"]
    values: Shaped[np.ndarray, "n ..."] | None = None

    def __len__(self) -> int:
        return len(self.t_host_ns)


class _Queue:
    def __init__(self, descriptor: StreamDescriptor) -> None:
        size = max(16, round(KEPT_S * descriptor.nominal_rate_hz))
        self.keeps_values = descriptor.kind in JUDGED_VALUES
        self.samples: deque[tuple[int, int, int, np.ndarray | None]] = deque(maxlen=size)
        self.latencies_ns: deque[int] = deque(maxlen=size)


class SampleBlocks:
    """Bounded queues between the readers and the health thread.

    A reader appends and goes on; when nobody evaluates, the oldest samples fall out and are
    counted in `dropped`.
    """

    def __init__(self, descriptors: Mapping[str, StreamDescriptor]) -> None:
        self._queues = {name: _Queue(descriptor) for name, descriptor in descriptors.items()}
        self._clock: StationClock | None = None
        self.dropped = 0

    def time_by(self, clock: StationClock) -> None:
        """Measure latencies from now on."""
        self._clock = clock

    def add(self, stream: str, samples: Sequence[Sample]) -> None:
        """Append (called by the reader threads, after the samples were spooled)."""
        queue = self._queues[stream]
        if self._clock is not None:
            queue.latencies_ns.append(self._clock.now_ns() - samples[-1].t_host_ns)
        kept = queue.samples
        self.dropped += max(0, len(kept) + len(samples) - (kept.maxlen or 0))
        if queue.keeps_values:
            kept.extend((s.t_host_ns, s.t_device_ns, s.sequence, s.values) for s in samples)
        else:
            kept.extend((s.t_host_ns, s.t_device_ns, s.sequence, None) for s in samples)

    def take(self, stream: str) -> Block:
        """What came since the last call."""
        queue = self._queues[stream]
        taken = [queue.samples.popleft() for _ in range(len(queue.samples))]
        latencies = [queue.latencies_ns.popleft() for _ in range(len(queue.latencies_ns))]
        values = [value for *_, value in taken if value is not None]
        return Block(
            np.array([item[0] for item in taken], dtype=np.int64),
            np.array([item[1] for item in taken], dtype=np.int64),
            np.array([item[2] for item in taken], dtype=np.int64),
            np.array(latencies, dtype=np.int64),
            np.stack(values) if values else None,
        )


class Rolling:
    """Numbers with their times, those of the last `span_ns` only.

    Its arrays grow to what a full span needs and stay as they are: windows that come and go in
    ever other sizes leave holes that nothing else fits into.
    """

    def __init__(self, span_ns: int) -> None:
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
        kept = self._t_ns[:stop] >= now_ns - self._span_ns
        self._count = int(np.count_nonzero(kept))
        if self._count < stop:
            self._t_ns[: self._count] = self._t_ns[:stop][kept]
            self._values[: self._count] = self._values[:stop][kept]
        return self.values

    @property
    def values(self) -> Float64[np.ndarray, " n"]:
        """What is kept."""
        return self._values[: self._count]

    @property
    def t_ns(self) -> Int64[np.ndarray, " n"]:
        """Times of what is kept."""
        return self._t_ns[: self._count]
