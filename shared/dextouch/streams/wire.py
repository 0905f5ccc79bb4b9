"""Wire format of a numbered batch of samples, sent from a station to the store.

Layout (little endian): magic `DXTB`, version u16, flags u16 (0), body length u32, crc32c of the
body u32, then the body: `dextouch.streams.packing` of fields and arrays. See docs/wire_format.md.
"""

import struct
from itertools import pairwise

import google_crc32c
import numpy as np

from dextouch.errors import InvalidInputError, LimitExceededError, PacketError
from dextouch.streams.checks import ENCODED_UNITS, check_batch
from dextouch.streams.descriptors import StreamDescriptor
from dextouch.streams.packing import pack, unpack
from dextouch.streams.samples import SampleBatch, encoded_values

MAGIC = b"DXTB"
VERSION = 1
HEADER = struct.Struct("<4sHHII")
MAX_BATCH_BYTES = 16 * 2**20
MAX_BATCH_SAMPLES = 65_536
_STAMPS = ("t_host_ns", "t_device_ns", "sequence")
_FIELDS = {"stream", "number"}


def encode_batch(descriptor: StreamDescriptor, batch: SampleBatch, *, number: int) -> bytes:
    """Encode a batch; equal batches give equal bytes.

    Args:
        descriptor: of the stream.
        batch: 1 … MAX_BATCH_SAMPLES samples; values of `jpeg` and `h264` streams are bytes.
        number: of the batch within its stream, from 0.

    Raises:
        InvalidInputError: an empty batch, or one of another stream.
        LimitExceededError: more samples or bytes than one batch may hold.
    """
    check_batch(descriptor, batch)
    _check_count(descriptor, len(batch))
    if number < 0:
        raise InvalidInputError(f"{descriptor.name}: got batch number {number}, expected ≥ 0")
    arrays = {stamp: getattr(batch, stamp) for stamp in _STAMPS}
    if descriptor.unit in ENCODED_UNITS:
        arrays["image_bytes"] = np.frombuffer(b"".join(batch.values), dtype=np.uint8)
        arrays["image_end"] = np.cumsum([len(data) for data in batch.values], dtype=np.int64)
    else:
        arrays["values"] = batch.values
    body = pack({"stream": descriptor.name, "number": number}, arrays)
    if HEADER.size + len(body) > MAX_BATCH_BYTES:
        raise LimitExceededError(
            f"{descriptor.name}: batch {number} has {HEADER.size + len(body)} bytes, expected at "
            f"most {MAX_BATCH_BYTES}; send fewer samples a batch"
        )
    return HEADER.pack(MAGIC, VERSION, 0, len(body), google_crc32c.value(body)) + body


def decode_batch(data: bytes, descriptor: StreamDescriptor, *, number: int) -> SampleBatch:
    """Decode and validate a batch from an untrusted source.

    Args:
        data: of `encode_batch`.
        descriptor: of the expected stream.
        number: expected batch number.

    Raises:
        PacketError: not a batch of this version, or damaged in transit.
        LimitExceededError: larger than allowed.
        InvalidInputError: a batch of another stream or number, or inconsistent arrays.
    """
    fields, arrays = unpack(_checked_body(data), max_bytes=MAX_BATCH_BYTES)
    where = f"batch of {descriptor.name!r}"
    if set(fields) != _FIELDS:
        raise InvalidInputError(f"{where}: got fields {sorted(fields)}, expected {sorted(_FIELDS)}")
    if (fields["stream"], fields["number"]) != (descriptor.name, number):
        raise InvalidInputError(
            f"{where}: bytes are batch {fields['number']!r} of stream {fields['stream']!r}, "
            f"expected batch {number} of {descriptor.name!r}"
        )
    is_encoded = descriptor.unit in ENCODED_UNITS
    payload = {"image_bytes", "image_end"} if is_encoded else {"values"}
    if set(arrays) != payload | set(_STAMPS):
        raise InvalidInputError(
            f"{where}: got arrays {sorted(arrays)}, expected {sorted(payload | set(_STAMPS))}"
        )
    values = _images(arrays, where) if is_encoded else arrays["values"]
    _check_columns(arrays, values, where)
    batch = SampleBatch(arrays["t_host_ns"], arrays["t_device_ns"], arrays["sequence"], values)
    _check_count(descriptor, len(batch))
    check_batch(descriptor, batch)
    return batch


def _checked_body(data: bytes) -> bytes:
    if len(data) > MAX_BATCH_BYTES:
        raise LimitExceededError(
            f"batch: got {len(data)} bytes, expected at most {MAX_BATCH_BYTES}"
        )
    if len(data) < HEADER.size:
        raise PacketError(f"batch: got {len(data)} bytes, expected a header of {HEADER.size}")
    magic, version, flags, length, crc32c = HEADER.unpack_from(data)
    if magic != MAGIC:
        raise PacketError(f"batch: begins with {magic!r}, expected {MAGIC!r}")
    if (version, flags) != (VERSION, 0):
        raise PacketError(
            f"batch: got version {version} with flags {flags}, expected version {VERSION} with 0"
        )
    body = data[HEADER.size :]
    if len(body) != length:
        raise PacketError(f"batch: got {len(body)} bytes after the header, expected {length}")
    if google_crc32c.value(body) != crc32c:
        raise PacketError("batch: checksum mismatch; it was damaged in transit, send it again")
    return body


def _check_count(descriptor: StreamDescriptor, count: int) -> None:
    if count == 0:
        raise InvalidInputError(f"{descriptor.name}: an empty batch, expected at least one sample")
    _check_limit(descriptor.name, count)


def _check_limit(what: str, count: int) -> None:
    if count > MAX_BATCH_SAMPLES:
        raise LimitExceededError(
            f"{what}: got {count} samples in a batch, expected at most {MAX_BATCH_SAMPLES}"
        )


def _check_columns(arrays: dict[str, np.ndarray], values: np.ndarray, where: str) -> None:
    shapes = {stamp: (arrays[stamp].dtype, arrays[stamp].shape) for stamp in _STAMPS}
    count = len(values) if values.ndim else 0
    for stamp, (dtype, shape) in shapes.items():
        if dtype != np.int64 or shape != (count,):
            raise InvalidInputError(
                f"{where}: {stamp} is {dtype} {shape}, expected int64 [{count}] like the values"
            )


def _images(arrays: dict[str, np.ndarray], where: str) -> np.ndarray:
    data, ends = arrays["image_bytes"], arrays["image_end"]
    if data.dtype != np.uint8 or data.ndim != 1 or ends.dtype != np.int64 or ends.ndim != 1:
        raise InvalidInputError(f"{where}: image_bytes must be uint8 [bytes], image_end int64 [n]")
    _check_limit(where, len(ends))
    bounds = np.concatenate([np.zeros(1, dtype=np.int64), ends])
    # Compared, not subtracted: the difference of two forged numbers can overflow.
    if (bounds[1:] <= bounds[:-1]).any() or int(bounds[-1]) != len(data):
        raise InvalidInputError(
            f"{where}: image_end must rise and end at {len(data)}, the number of bytes"
        )
    whole = data.tobytes()
    return encoded_values([whole[start:end] for start, end in pairwise(bounds)])
