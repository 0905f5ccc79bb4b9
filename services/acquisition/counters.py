"""Counters of a reader thread for its device and streams; cheap to write, safe to read."""

from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np
from jaxtyping import UInt16

from dextouch.streams import Sample
from services.acquisition.drivers.base import Driver, Readings


@dataclass
class TaxelExtremes:
    """Least and greatest count of each raw cell: what a dead or pinned cell shows."""

    low_counts: UInt16[np.ndarray, " n"]
    high_counts: UInt16[np.ndarray, " n"]

    def add(self, counts: np.ndarray) -> None:
        """Take in one reading."""
        np.minimum(self.low_counts, counts, out=self.low_counts)
        np.maximum(self.high_counts, counts, out=self.high_counts)


@dataclass
class StreamCounters:
    """One stream's counts; written by its reader thread alone.

    `num_bytes` are those of the payloads. `extremes` are kept where samples are raw counts of a
    glove, the only unsigned 16-bit rows there are.
    """

    num_samples: int = 0
    num_bytes: int = 0
    first_t_host_ns: int | None = None
    last_t_host_ns: int | None = None
    largest_gap_ns: int = 0
    extremes: TaxelExtremes | None = None

    def add(self, samples: Sequence[Sample]) -> None:
        """Count new samples."""
        for sample in samples:
            if self.last_t_host_ns is None:
                self._start(sample)
            else:
                gap_ns = sample.t_host_ns - self.last_t_host_ns
                self.largest_gap_ns = max(self.largest_gap_ns, gap_ns)
            self.last_t_host_ns = sample.t_host_ns
            values = sample.values
            encoded = values.dtype == np.object_
            self.num_bytes += len(values.item()) if encoded else values.nbytes
            if self.extremes is not None:
                self.extremes.add(values)
        self.num_samples += len(samples)

    def _start(self, sample: Sample) -> None:
        self.first_t_host_ns = sample.t_host_ns
        if sample.values.dtype == np.uint16 and sample.values.ndim == 1:
            counts = sample.values.astype(np.uint16)
            self.extremes = TaxelExtremes(counts.copy(), counts.copy())


@dataclass
class DeviceCounters:
    """One device's counts; the decoder's statistics stand beside them."""

    reconnects: int = 0
    failures: int = 0
    is_connected: bool = False
    last_error: str | None = None
    streams: dict[str, StreamCounters] = field(default_factory=dict)

    @staticmethod
    def of(driver: Driver) -> "DeviceCounters":
        """Zero for every stream of the driver."""
        return DeviceCounters(streams={d.name: StreamCounters() for d in driver.descriptors})

    def add(self, readings: Readings) -> None:
        """Count new samples."""
        for name, samples in readings.items():
            self.streams[name].add(samples)
