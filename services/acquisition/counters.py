"""What a reader thread counts about its device and streams; cheap to write, safe to read."""

from collections.abc import Sequence
from dataclasses import dataclass, field

from dextouch.streams.samples import Sample
from services.acquisition.drivers.base import Driver, Readings


@dataclass
class StreamCounters:
    """One stream's counts; written by its reader thread alone."""

    num_samples: int = 0
    first_t_host_ns: int | None = None
    last_t_host_ns: int | None = None
    largest_gap_ns: int = 0

    def add(self, samples: Sequence[Sample]) -> None:
        """Count new samples."""
        for sample in samples:
            if self.last_t_host_ns is None:
                self.first_t_host_ns = sample.t_host_ns
            else:
                gap_ns = sample.t_host_ns - self.last_t_host_ns
                self.largest_gap_ns = max(self.largest_gap_ns, gap_ns)
            self.last_t_host_ns = sample.t_host_ns
        self.num_samples += len(samples)


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
