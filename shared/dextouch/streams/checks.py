"""Validation of sample batches against the descriptor of their stream."""

import numpy as np

from dextouch.errors import CorruptDataError, InvalidInputError, ShapeError
from dextouch.images import jpeg_size
from dextouch.streams.descriptors import StreamDescriptor
from dextouch.streams.samples import SampleBatch

JPEG_UNIT = "jpeg"
H264_UNIT = "h264"
# Values of these units are encoded images (bytes).
ENCODED_UNITS = (JPEG_UNIT, H264_UNIT)
# Start code of H.264 access units (ITU-T H.264, Annex B), optionally preceded by a zero byte.
_START_CODES = (b"\x00\x00\x00\x01", b"\x00\x00\x01")


def check_batch(descriptor: StreamDescriptor, batch: SampleBatch) -> None:
    """Check that a batch matches its stream.

    Args:
        descriptor: of the stream.
        batch: values of the descriptor's dtype and shape; for the units `jpeg` and `h264` an
            object array of bytes; `t_host_ns` is non-decreasing.

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
    """Check that a batch does not start before the last sample of its stream.

    Raises:
        InvalidInputError: it does.
    """
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
    """Check an encoded image of a stream with the unit `jpeg` or `h264`.

    For H.264 only the start code is checked; the size is known after decoding.

    Raises:
        ShapeError: not bytes, or an image of another size.
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
