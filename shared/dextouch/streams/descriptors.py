"""Descriptor of a stream: rate, shape, unit, coordinate frame and clock capabilities."""

import math
from typing import Annotated, Literal

import numpy as np
from pydantic import Field, model_validator

from dextouch.frozen_model import FrozenModel

# Batches and windows add an axis to those of a sample, and a packed array has at most eight.
MAX_SAMPLE_AXES = 7
# More than the largest H.264 picture (level 6.2) at three bytes per pixel.
MAX_SAMPLE_BYTES = 1 << 27
MIN_RATE_HZ = 1e-6
# Limit for new recordings and episodes, since each stream keeps up to eight files open while it is
# written. Those of older releases may have more.
MAX_STREAMS = 100
StreamKind = Literal["tactile", "keypoints", "pose", "image", "robot_state", "scalar"]


class ClockCapabilities(FrozenModel):
    """Time stamps and sequence numbers that a device provides; timing quality depends on them."""

    crc: bool = False
    sequence: bool = False
    sequence_bits: int = Field(default=32, ge=8, le=64)
    device_time: bool = False
    tick_ns: int = Field(default=1, ge=1)
    device_time_bits: int = Field(default=64, ge=16, le=64)


class StreamDescriptor(FrozenModel):
    """One stream of a recording or an episode.

    `shape` is that of one sample's payload, at most MAX_SAMPLE_BYTES; `unit` that of its values
    (`counts`, `kPa`, `m`, `rad`, `pose_m_wxyz`, `rgb8`, …); `frame` their coordinate system, if
    any.
    """

    name: str = Field(pattern=r"^[a-z][a-z0-9_]{0,63}$")
    kind: StreamKind
    shape: tuple[Annotated[int, Field(ge=1)], ...] = Field(max_length=MAX_SAMPLE_AXES)
    dtype: Literal["uint8", "uint16", "int64", "float32", "float64"]
    unit: str
    nominal_rate_hz: float = Field(ge=MIN_RATE_HZ, le=10_000)
    frame: str | None = None
    side: Literal["left", "right"] | None = None
    device: str | None = None
    capabilities: ClockCapabilities = ClockCapabilities()

    @model_validator(mode="after")
    def _fits_in_memory(self) -> "StreamDescriptor":
        if self.sample_bytes() > MAX_SAMPLE_BYTES:
            raise ValueError(
                f"{self.name}: a sample of shape {self.shape} takes {self.sample_bytes()} bytes, "
                f"expected at most {MAX_SAMPLE_BYTES}"
            )
        return self

    def sample_bytes(self) -> int:
        """Size of one sample in memory."""
        return math.prod(self.shape) * self.numpy_dtype().itemsize

    def numpy_dtype(self) -> np.dtype[np.generic]:
        """The payload's dtype, little endian."""
        return np.dtype(self.dtype).newbyteorder("<")

    def period_ns(self) -> int:
        """Nominal sample period."""
        return round(1e9 / self.nominal_rate_hz)
