"""Ring buffers of the newest samples, which wait there for the next evaluation."""

import threading
from collections.abc import Sequence

import numpy as np

from dextouch.streams import Sample, StreamDescriptor
from services.acquisition.health.evaluation import Block

# What is kept between two evaluations, which are a second apart.
KEPT_S = 4.0
JUDGED_VALUES = ("tactile", "pose", "keypoints")


class SampleQueue:
    """A ring of one stream's newest stamps and values; any thread may add and take.

    A reader appends and goes on; when nobody evaluates, the oldest samples fall out and are
    counted in `num_dropped`. It takes its memory once, whatever waits in it.
    """

    def __init__(self, descriptor: StreamDescriptor) -> None:
        self.num_dropped = 0
        self.capacity = max(16, round(KEPT_S * descriptor.nominal_rate_hz))
        self._keeps_values = descriptor.kind in JUDGED_VALUES
        self._stamps = np.zeros((self.capacity, 4), dtype=np.int64)
        # Made of the first sample: its device decides on their type.
        self._values: np.ndarray | None = None
        self._num_added = self._num_taken = 0
        self._lock = threading.Lock()

    def add(self, samples: Sequence[Sample], now_ns: int) -> None:
        """Append a delivery (called by the reader thread, after its samples were spooled)."""
        if self._values is None and self._keeps_values:
            first = samples[0].values
            self._values = np.zeros((self.capacity, *first.shape), dtype=first.dtype)
        with self._lock:
            for sample in samples:
                place, t_host_ns = self._num_added % self.capacity, sample.t_host_ns
                stamps = (t_host_ns, sample.t_device_ns, sample.sequence, now_ns - t_host_ns)
                self._stamps[place] = stamps
                if self._values is not None:
                    self._values[place] = sample.values
                self._num_added += 1
            num_dropped = max(0, self._num_added - self._num_taken - self.capacity)
            self._num_taken += num_dropped
            self.num_dropped += num_dropped

    def take(self) -> Block:
        """Everything that waits, oldest first."""
        with self._lock:
            places = np.arange(self._num_taken, self._num_added) % self.capacity
            stamps = np.ascontiguousarray(self._stamps[places].T)
            values = None
            if self._values is not None and len(places):
                values = self._values[places]
            self._num_taken = self._num_added
        return Block(stamps[0], stamps[1], stamps[2], stamps[3], values)
