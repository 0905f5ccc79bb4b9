"""Binary encoding of a batch of samples as the body of a record in a spool's log.

Little endian, n samples: t_host_ns int64 [n], t_device_ns int64 [n], sequence int64 [n], then of a
numeric stream the values as they lie in memory, of an encoded one the length of each image as
u32 [n] and the images end to end.
"""

from collections.abc import Iterable
from itertools import accumulate, pairwise

import numpy as np

from dextouch.errors import CorruptDataError
from dextouch.streams import ENCODED_UNITS, SampleBatch, StreamDescriptor, encoded_values

_STAMP_BYTES = 8


def batch_bytes(descriptor: StreamDescriptor, batch: SampleBatch) -> bytes:
    """Encode a batch, which the caller has checked against the descriptor."""
    stamps = (batch.t_host_ns, batch.t_device_ns, batch.sequence)
    parts: list[bytes | memoryview] = [
        np.ascontiguousarray(column, dtype="<i8").data for column in stamps
    ]
    if descriptor.unit in ENCODED_UNITS:
        parts.append(np.array([len(image) for image in batch.values], dtype="<u4").data)
        parts.extend(batch.values)
    else:
        dtype = descriptor.numpy_dtype().newbyteorder("<")
        parts.append(np.ascontiguousarray(batch.values, dtype=dtype).data)
    # Buffers are joined without conversion, so an image is copied once.
    return b"".join(parts)


def batch_of_bytes(
    descriptor: StreamDescriptor, bodies: Iterable[bytes], counts: Iterable[int], *, what: str
) -> SampleBatch:
    """Decode consecutive bodies of one stream to one batch, the inverse of `batch_bytes`.

    `counts` are the samples in each; `what` names the log in errors.

    Raises:
        CorruptDataError: the size of a body does not match its number of samples.
    """
    columns: list[list[bytes]] = [[], [], []]
    values: list[bytes] = []
    encoded = descriptor.unit in ENCODED_UNITS
    for body, count in zip(bodies, counts, strict=True):
        size = count * _STAMP_BYTES
        for number, column in enumerate(columns):
            column.append(body[number * size : (number + 1) * size])
        rest = body[3 * size :]
        got = _images(rest, count) if encoded else [rest]
        if got is None or (not encoded and len(rest) != count * descriptor.sample_bytes()):
            raise CorruptDataError(
                f"{what}: a record of {len(body)} bytes is not that of {count} samples of "
                f"{descriptor.name!r}; it was written for another stream"
            )
        values += got
    hosts, devices, sequence = (
        np.frombuffer(b"".join(column), dtype="<i8").astype(np.int64) for column in columns
    )
    if encoded:
        return SampleBatch(hosts, devices, sequence, encoded_values(values))
    numbers = np.frombuffer(b"".join(values), dtype=descriptor.numpy_dtype().newbyteorder("<"))
    numbers = numbers.astype(descriptor.numpy_dtype(), copy=False)
    return SampleBatch(hosts, devices, sequence, numbers.reshape(-1, *descriptor.shape))


def _images(data: bytes, count: int) -> list[bytes] | None:
    """Split images by their length prefixes; None where these are inconsistent."""
    start = 4 * count
    if len(data) < start:
        return None
    lengths = np.frombuffer(data, dtype="<u4", count=count).tolist()
    bounds = list(accumulate(lengths, initial=start))
    if bounds[-1] != len(data):
        return None
    return [data[low:high] for low, high in pairwise(bounds)]
