"""A timed reading of a sensor, and batches of consecutive readings."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Int64, Shaped

from dextouch.errors import ShapeError

# Placeholders where a device provides no time stamp or no sequence number.
NO_DEVICE_TIME = -1
NO_SEQUENCE = -1


@dataclass(frozen=True)
class Sample:
    """One reading: arrival on the host's monotonic clock, the device's own stamp and counter."""

    t_host_ns: int
    values: Shaped[np.ndarray, "..."]
    t_device_ns: int = NO_DEVICE_TIME
    sequence: int = NO_SEQUENCE


@dataclass(frozen=True)
class SampleBatch:
    """Consecutive samples of one stream; all arrays share their first axis."""

    t_host_ns: Int64[np.ndarray, " n"]
    t_device_ns: Int64[np.ndarray, " n"]
    sequence: Int64[np.ndarray, " n"]
    values: Shaped[np.ndarray, "n ..."]

    def __post_init__(self) -> None:
        sizes = {len(self.t_host_ns), len(self.t_device_ns), len(self.sequence), len(self.values)}
        if len(sizes) != 1:
            raise ShapeError(f"batch: arrays of different lengths {sorted(sizes)}")

    def __len__(self) -> int:
        return len(self.t_host_ns)

    @staticmethod
    def from_samples(samples: Sequence[Sample]) -> "SampleBatch":
        """Stack samples of one stream; the values of a single one are shared, not copied."""
        if len(samples) == 1:
            (sample,) = samples
            return SampleBatch(
                np.array([sample.t_host_ns], dtype=np.int64),
                np.array([sample.t_device_ns], dtype=np.int64),
                np.array([sample.sequence], dtype=np.int64),
                sample.values[np.newaxis],
            )
        return SampleBatch(
            np.array([s.t_host_ns for s in samples], dtype=np.int64),
            np.array([s.t_device_ns for s in samples], dtype=np.int64),
            np.array([s.sequence for s in samples], dtype=np.int64),
            np.stack([s.values for s in samples]),
        )


def encoded_values(images: Sequence[bytes]) -> Shaped[np.ndarray, " n"]:
    """Pack encoded images into the `values` of a batch of a `jpeg` or `h264` stream."""
    values = np.empty(len(images), dtype=object)
    values[:] = images
    return values
