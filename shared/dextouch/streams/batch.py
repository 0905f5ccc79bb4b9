"""A batch of samples as bytes, the same in a spool's log, on the wire and in the store's upload.

A body is samples end to end: t_host_ns, t_device_ns and sequence as int64, then the values, or the
length (u32) and bytes of an encoded image; little endian. See docs/wire_format.md.
"""

import struct
from dataclasses import dataclass
from functools import lru_cache
from itertools import chain

import google_crc32c
import numpy as np

from dextouch.errors import CorruptDataError, InvalidInputError, LimitExceededError, PacketError
from dextouch.streams.samples import (
    ENCODED_UNITS,
    SampleBatch,
    StreamDescriptor,
    check_batch,
    encoded_values,
)

MAGIC = b"DXTB"
VERSION = 2
MAX_BATCH_BYTES = 16 * 2**20
MAX_BATCH_SAMPLES = 65_536
_VERSION = struct.Struct("<4sH")
# Magic, version, bytes of the stream's name, number of the batch, samples, length and crc32c of the
# body; then the name, and the crc32c of all this.
_HEADER = struct.Struct("<4sHHIIII")
_CRC = struct.Struct("<I")
_STAMPS = ("t_host_ns", "t_device_ns", "sequence")
_IMAGE = struct.Struct("<qqqI")


@dataclass(frozen=True)
class EncodedBatch:
    """A batch of one stream as bytes with their crc32c, checked against the stream."""

    stream_name: str
    body: bytes
    body_crc32c: int
    num_samples: int
    first_t_host_ns: int
    last_t_host_ns: int


def encode_samples(descriptor: StreamDescriptor, batch: SampleBatch) -> EncodedBatch:
    """Check and encode a batch of at least one sample; raises as `check_batch`."""
    check_batch(descriptor, batch)
    body = encode_body(descriptor, batch)
    return _encoded(descriptor, body, google_crc32c.value(body), batch)


def encode_body(descriptor: StreamDescriptor, batch: SampleBatch) -> bytes:
    """The samples of a batch end to end, which the caller has checked."""
    if descriptor.unit in ENCODED_UNITS:
        stamps = (getattr(batch, stamp).tolist() for stamp in _STAMPS)
        samples = zip(*stamps, batch.values, strict=True)
        parts = ((_IMAGE.pack(*times, len(image)), image) for *times, image in samples)
        return b"".join(chain.from_iterable(parts))
    rows = np.empty(len(batch), _row(descriptor.dtype, descriptor.shape))
    for name, column in vars(batch).items():
        rows[name] = column
    return rows.tobytes()


def decode_body(
    descriptor: StreamDescriptor, body: bytes, num_samples: int, *, where: str = "batch"
) -> SampleBatch:
    """The batch in a body, whose stamps and images are not checked; arrays may be read-only.

    `body` is of `encode_body`, or several end to end; `where` says in errors where it lies.

    Raises:
        CorruptDataError: the size of the body is not that of so many samples of the stream.
    """
    if descriptor.unit in ENCODED_UNITS:
        ends = sample_ends(descriptor, body, num_samples, where=where)
        starts = [0, *ends][:num_samples]
        heads = [_IMAGE.unpack_from(body, start)[:3] for start in starts]
        hosts, devices, numbers = np.array(heads, dtype=np.int64).reshape(-1, 3).T.copy()
        images = [body[a + _IMAGE.size : b] for a, b in zip(starts, ends, strict=True)]
        return SampleBatch(hosts, devices, numbers, encoded_values(images))
    row = _row(descriptor.dtype, descriptor.shape)
    if len(body) != num_samples * row.itemsize:
        raise _wrong_size(descriptor, body, num_samples, where)
    rows = np.frombuffer(body, row)
    return SampleBatch(*(np.ascontiguousarray(rows[name]) for name in row.names or ()))


def sample_ends(
    descriptor: StreamDescriptor, body: bytes, num_samples: int, *, where: str = "batch"
) -> list[int]:
    """Offset of the end of each sample of a body; arguments and errors of `decode_body`."""
    if descriptor.unit not in ENCODED_UNITS:
        size = _row(descriptor.dtype, descriptor.shape).itemsize
        ends = [size * number for number in range(1, num_samples + 1)]
    else:
        ends, end = [], 0
        while end + _IMAGE.size <= len(body) and len(ends) < num_samples:
            end += _IMAGE.size + _IMAGE.unpack_from(body, end)[3]
            ends.append(end)
    if len(ends) != num_samples or (ends[-1] if ends else 0) != len(body):
        raise _wrong_size(descriptor, body, num_samples, where)
    return ends


def _wrong_size(
    descriptor: StreamDescriptor, body: bytes, num_samples: int, where: str
) -> CorruptDataError:
    return CorruptDataError(
        f"{where}: {len(body)} bytes are not those of {num_samples} samples of "
        f"{descriptor.name!r}; they were written for another stream"
    )


@lru_cache
def _row(dtype: str, shape: tuple[int, ...]) -> np.dtype[np.void]:
    values = ("values", np.dtype(dtype).newbyteorder("<"), shape)
    return np.dtype([*((stamp, "<i8") for stamp in _STAMPS), values])


def _encoded(
    descriptor: StreamDescriptor, body: bytes, crc32c: int, batch: SampleBatch
) -> EncodedBatch:
    first_ns, last_ns = int(batch.t_host_ns[0]), int(batch.t_host_ns[-1])
    return EncodedBatch(descriptor.name, body, crc32c, len(batch), first_ns, last_ns)


def encode_batch(descriptor: StreamDescriptor, batch: SampleBatch, *, number: int) -> bytes:
    """Encode 1 … MAX_BATCH_SAMPLES samples for the wire; equal batches give equal bytes.

    Values of `jpeg` and `h264` streams are bytes. `number` is that of the batch within its stream,
    from 0.

    Raises:
        InvalidInputError: an empty batch, or one of another stream.
        LimitExceededError: more samples or bytes than one batch may hold.
    """
    check_batch(descriptor, batch)
    return frame_body(descriptor.name, encode_body(descriptor, batch), len(batch), number=number)


def frame_body(stream_name: str, body: bytes, num_samples: int, *, number: int) -> bytes:
    """Put the wire's header before a body, which the store checks; raises as `encode_batch`."""
    _check_count(stream_name, num_samples)
    if not 0 <= number < 1 << 32:
        raise InvalidInputError(f"{stream_name}: got batch number {number}, expected 0 … 2^32 - 1")
    name, crc = stream_name.encode(), google_crc32c.value(body)
    header = _HEADER.pack(MAGIC, VERSION, len(name), number, num_samples, len(body), crc) + name
    data = b"".join((header, _CRC.pack(google_crc32c.value(header)), body))
    if len(data) > MAX_BATCH_BYTES:
        raise LimitExceededError(
            f"{stream_name}: batch {number} has {len(data)} bytes, expected at most "
            f"{MAX_BATCH_BYTES}; send fewer samples a batch"
        )
    return data


def decode_batch(data: bytes, descriptor: StreamDescriptor, *, number: int) -> SampleBatch:
    """Decode and validate a batch from an untrusted source; errors of `read_batch`."""
    found = read_batch(data, descriptor, number=number)
    return decode_body(descriptor, found.body, found.num_samples)


def read_batch(data: bytes, descriptor: StreamDescriptor, *, number: int) -> EncodedBatch:
    """Validate bytes of an untrusted source as the expected batch of a stream.

    Raises:
        PacketError: not a batch of this version, or damaged in transit.
        LimitExceededError: larger than allowed.
        InvalidInputError: a batch of another stream or number, or with wrong contents.
    """
    if len(data) > MAX_BATCH_BYTES:
        raise LimitExceededError(
            f"batch: got {len(data)} bytes, expected at most {MAX_BATCH_BYTES}"
        )
    if len(data) < _HEADER.size:
        raise PacketError(f"batch: got {len(data)} bytes, expected a header of {_HEADER.size}")
    magic, version = _VERSION.unpack_from(data)
    if magic != MAGIC:
        raise PacketError(f"batch: begins with {magic!r}, expected {MAGIC!r}")
    if version != VERSION:
        raise PacketError(
            f"batch {number} of {descriptor.name!r}: got wire version {version}, expected "
            f"{VERSION}; use a station and a store of the same release"
        )
    _, _, name_bytes, got_number, num_samples, length, crc = _HEADER.unpack_from(data)
    place = _HEADER.size + name_bytes + _CRC.size
    header, body = data[: place - _CRC.size], data[place:]
    if data[len(header) : place] != _CRC.pack(google_crc32c.value(header)):
        raise PacketError("batch: its header was damaged in transit, send it again")
    if len(body) != length:
        raise PacketError(f"batch: got {len(body)} bytes after the header, expected {length}")
    if google_crc32c.value(body) != crc:
        raise PacketError("batch: checksum mismatch; it was damaged in transit, send it again")
    name = header[_HEADER.size :].decode(errors="replace")
    if (name, got_number) != (descriptor.name, number):
        raise InvalidInputError(
            f"batch of {descriptor.name!r}: bytes are batch {got_number!r} of stream {name!r}, "
            f"expected batch {number} of {descriptor.name!r}"
        )
    _check_count(descriptor.name, num_samples)
    try:
        batch = decode_body(descriptor, body, num_samples)
    except CorruptDataError as error:
        raise InvalidInputError(error.message) from error
    check_batch(descriptor, batch)
    return _encoded(descriptor, body, crc, batch)


def _check_count(what: str, count: int) -> None:
    if count == 0:
        raise InvalidInputError(f"{what}: an empty batch, expected at least one sample")
    if count > MAX_BATCH_SAMPLES:
        raise LimitExceededError(
            f"{what}: got {count} samples in a batch, expected at most {MAX_BATCH_SAMPLES}"
        )
