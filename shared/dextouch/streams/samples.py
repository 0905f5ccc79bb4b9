"""Streams of sensors: their descriptors, samples and batches, and which batches are valid."""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from operator import not_
from typing import Annotated, Final, Literal

import numpy as np
from jaxtyping import Int64, Shaped
from pydantic import Field, model_validator

from dextouch.errors import CorruptDataError, InvalidInputError, ShapeError
from dextouch.frozen_model import FrozenModel
from dextouch.images import jpeg_size
from dextouch.tactile.layout import DEXTOUCH_V1, TactileLayout

# Batches and windows add an axis to those of a sample, and a packed array has at most eight.
MAX_SAMPLE_AXES = 7
# More than the largest H.264 picture (level 6.2) at three bytes per pixel.
MAX_SAMPLE_BYTES = 1 << 27
MIN_RATE_HZ = 1e-6
# Limit for new recordings and episodes, since each stream keeps up to eight files open while it is
# written. Those of older releases may have more.
MAX_STREAMS = 100
StreamKind = Literal["tactile", "keypoints", "pose", "image", "robot_state", "scalar"]
# Stream of the camera on the head, whose images policies and world models see.
HEAD_CAMERA = "camera_head"
# Placeholders where a device provides no time stamp or no sequence number.
NO_DEVICE_TIME = -1
NO_SEQUENCE = -1
JPEG_UNIT = "jpeg"
H264_UNIT = "h264"
# Of tactile streams whose values are those of taxels; other units are raw readings of a glove.
TAXEL_UNIT = "kPa"
# Values of these units are encoded images (bytes).
ENCODED_UNITS = (JPEG_UNIT, H264_UNIT)
# Start code of H.264 access units (ITU-T H.264, Annex B), optionally preceded by a zero byte.
_START_CODES = (b"\x00\x00\x00\x01", b"\x00\x00\x01")


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
    any. `layout` is that of the taxels of a tactile stream, None of `dextouch_v1`; `names` are
    those of the numbers along the last axis, where they have any.
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
    # None is not written, so that older releases can read the streams of our own glove.
    layout: TactileLayout | None = Field(default=None, exclude_if=lambda layout: layout is None)
    names: tuple[Annotated[str, Field(max_length=128)], ...] = Field(default=(), exclude_if=not_)

    @model_validator(mode="after")
    def _fits_in_memory(self) -> "StreamDescriptor":
        if self.sample_bytes() > MAX_SAMPLE_BYTES:
            raise ValueError(
                f"{self.name}: a sample of shape {self.shape} takes {self.sample_bytes()} bytes, "
                f"expected at most {MAX_SAMPLE_BYTES}"
            )
        return self

    @model_validator(mode="after")
    def _names_each_number(self) -> "StreamDescriptor":
        if self.names and (len(self.names),) != self.shape[-1:]:
            raise ValueError(
                f"{self.name}: got {len(self.names)} names for samples of shape {self.shape}, "
                "expected one for each number of the last axis"
            )
        return self

    @model_validator(mode="after")
    def _fits_its_layout(self) -> "StreamDescriptor":
        if self.layout is None:
            return self
        is_raw = self.unit != TAXEL_UNIT
        count = self.layout.num_raw_cells if is_raw else self.layout.num_taxels
        if self.kind != "tactile" or self.shape != (count,):
            raise ValueError(
                f"{self.name}: got a {self.kind} stream with samples of {self.shape}, expected a "
                f"tactile one of ({count},), the {'raw cells' if is_raw else 'taxels'} of its "
                f"layout {self.layout.name!r}"
            )
        return self

    @property
    def tactile_layout(self) -> TactileLayout:
        """Layout of the taxels of a tactile stream; `dextouch_v1` where none is named."""
        return DEXTOUCH_V1 if self.layout is None else self.layout

    def sample_bytes(self) -> int:
        """Size of one sample in memory."""
        return math.prod(self.shape) * self.numpy_dtype().itemsize

    def numpy_dtype(self) -> np.dtype[np.generic]:
        """The payload's dtype, little endian."""
        return np.dtype(self.dtype).newbyteorder("<")

    def period_ns(self) -> int:
        """Nominal sample period."""
        return round(1e9 / self.nominal_rate_hz)


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
        values = [s.values for s in samples]
        return SampleBatch(
            np.array([s.t_host_ns for s in samples], dtype=np.int64),
            np.array([s.t_device_ns for s in samples], dtype=np.int64),
            np.array([s.sequence for s in samples], dtype=np.int64),
            values[0][np.newaxis] if len(values) == 1 else np.stack(values),
        )


def encoded_values(images: Sequence[bytes]) -> Shaped[np.ndarray, " n"]:
    """Pack encoded images into the `values` of a batch of a `jpeg` or `h264` stream."""
    values = np.empty(len(images), dtype=object)
    values[:] = images
    return values


def check_batch(descriptor: StreamDescriptor, batch: SampleBatch) -> None:
    """Check that a batch matches its stream, and that `t_host_ns` never decreases.

    Values have the descriptor's dtype and shape; for the units `jpeg` and `h264` they are an object
    array of bytes.

    Raises:
        ShapeError: another dtype or shape.
        InvalidInputError: stamps that go back, or invalid image data.
    """
    values, name = batch.values, descriptor.name
    for stamp in ("t_host_ns", "t_device_ns", "sequence"):
        column = getattr(batch, stamp)
        if column.dtype != np.int64 or column.shape != (len(batch),):
            raise ShapeError(f"{name}: {stamp} is {column.dtype} {column.shape}, expected int64")
    if descriptor.unit in ENCODED_UNITS:
        _check_images(descriptor, values)
    elif values.dtype != descriptor.numpy_dtype() or values.shape[1:] != descriptor.shape:
        raise ShapeError(
            f"{name}: got values {values.dtype} {values.shape}, expected {descriptor.dtype} "
            f"[n, {', '.join(map(str, descriptor.shape))}]"
        )
    if len(batch) < 2:
        return
    # Compared, not subtracted: the difference of two extreme stamps can overflow.
    back = np.flatnonzero(batch.t_host_ns[1:] < batch.t_host_ns[:-1])
    if len(back):
        raise InvalidInputError(
            f"{name}: t_host_ns goes back after sample {int(back[0])} of the batch; "
            "append samples in the order of their arrival"
        )


def check_follows(name: str, t_host_ns: int, last_t_host_ns: int | None) -> None:
    """Raise InvalidInputError if a batch starts before the last sample of its stream."""
    if last_t_host_ns is not None and t_host_ns < last_t_host_ns:
        raise InvalidInputError(
            f"{name}: t_host_ns goes back to {t_host_ns} from {last_t_host_ns}; "
            "append samples in the order of their arrival"
        )


def _check_images(descriptor: StreamDescriptor, values: np.ndarray) -> None:
    name = descriptor.name
    if values.dtype != object or values.ndim != 1:
        raise ShapeError(
            f"{name}: got values {values.dtype} {values.shape}, expected an object array of "
            "bytes, one an image (see dextouch.streams.samples.encoded_values)"
        )
    for index, data in enumerate(values):
        check_encoded_image(descriptor, data, where=f"{name}: image {index} of the batch")


def check_encoded_image(descriptor: StreamDescriptor, data: object, *, where: str) -> None:
    """Check an encoded image of a stream with the unit `jpeg`, or `h264` (its start code alone).

    Raises:
        ShapeError: not bytes, or a JPEG image of another size.
        InvalidInputError: another format.
    """
    if not isinstance(data, bytes):
        raise ShapeError(f"{where} is {type(data).__name__}, expected bytes")
    if descriptor.unit == H264_UNIT:
        if not data.startswith(_START_CODES):
            raise InvalidInputError(
                f"{where}: begins with {data[:4]!r}, expected an H.264 access unit with a start "
                "code (Annex B)"
            )
        return
    try:
        size = jpeg_size(data, where=where)
    except CorruptDataError as error:
        raise InvalidInputError(error.message) from error
    if size != descriptor.shape[:2]:
        raise ShapeError(f"{where} is {size} pixels, expected {descriptor.shape[:2]}")


# Limits of what a stream may deviate, the same in live health and in the review of takes.

# Deviation from the nominal rate, and so the share of a take's steps that may be missing.
RATE_WARN: Final = 0.02
RATE_ERROR: Final = 0.10
LEAST_SHARE_KEPT: Final = 1.0 - RATE_ERROR
# Scatter of arrivals about a device's clock.
RESIDUAL_WARN_S: Final = 4e-3
RESIDUAL_ERROR_S: Final = 10e-3
# Counting tolerates delays of almost a period: of streams without stamps and numbers, shares of it.
RESIDUAL_SHARES: Final = (0.25, 0.5)


def residual_limits_s(counted_period_s: float | None) -> tuple[float, float]:
    """Scatter of arrivals that is a warning and an error; of counted streams by their period."""
    warn_s, error_s = RESIDUAL_WARN_S, RESIDUAL_ERROR_S
    if counted_period_s is None:
        return warn_s, error_s
    warn_share, error_share = RESIDUAL_SHARES
    return max(warn_s, warn_share * counted_period_s), max(error_s, error_share * counted_period_s)
