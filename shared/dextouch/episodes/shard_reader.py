"""One Zarr v3 shard file → rows of its array, or the encoded storage chunks as they are.

A shard is the standard `sharding_indexed` layout: encoded storage chunks one after the other, then
(offset, length) of each as uint64, then crc32c of that index. Every storage chunk ends in its own
crc32c, so a flipped bit or a torn file is refused and never becomes a number.
"""

import math

import google_crc32c
import numpy as np
from jaxtyping import Shaped
from numcodecs.zstd import Zstd

from dextouch.episodes.format import ArrayEntry
from dextouch.episodes.sources import ByteSource
from dextouch.errors import CorruptDataError, InvalidInputError

CRC_BYTES = 4
INDEX_ENTRY_BYTES = 16
_ZSTD = Zstd()
_ZSTD_MAGIC = bytes.fromhex("28b52ffd")


def with_crc(data: bytes) -> bytes:
    """Bytes and their crc32c behind them."""
    return data + google_crc32c.value(data).to_bytes(CRC_BYTES, "little")


def _without_crc(data: memoryview | bytes, what: str) -> bytes:
    body, crc = bytes(data[:-CRC_BYTES]), data[-CRC_BYTES:]
    if len(data) < CRC_BYTES or google_crc32c.value(body) != int.from_bytes(crc, "little"):
        raise CorruptDataError(
            f"{what}: checksum does not hold ({len(data)} bytes read); "
            "the file is damaged or truncated, restore it from a copy"
        )
    return body


class ShardReader:
    """Reads rows or storage chunks of one array; the index is read once and kept.

    Args:
        source: the shard file, or the part file of a shard that is being written.
        entry: what is known of the array.
        what: names the array in errors.
        index: (offset, length) of each storage chunk where the file has no index yet.
    """

    def __init__(
        self, source: ByteSource, entry: ArrayEntry, *, what: str, index: np.ndarray | None = None
    ) -> None:
        self._source, self._entry, self._what = source, entry, what
        self._dtype = np.dtype(entry.dtype).newbyteorder("<")
        self._num_chunks = -(-entry.shape[0] // entry.chunk_rows)
        self._index = index

    def read(self, start: int = 0, stop: int | None = None) -> Shaped[np.ndarray, "n ..."]:
        """Rows start … stop-1; only the storage chunks that hold them are read and decoded.

        Raises:
            InvalidInputError: rows outside the array.
            CorruptDataError: a checksum does not hold, or bytes are missing.
        """
        num_rows, rows_each = self._entry.shape[0], self._entry.chunk_rows
        stop = num_rows if stop is None else stop
        if not 0 <= start <= stop <= num_rows:
            raise InvalidInputError(
                f"{self._what}: got rows {start} … {stop}, expected within 0 … {num_rows}"
            )
        rows = np.empty((stop - start, *self._entry.shape[1:]), dtype=self._dtype)
        for number in range(start // rows_each, -(-stop // rows_each) if stop > start else 0):
            chunk = self._decode(number)
            first = number * rows_each
            low, high = max(start, first), min(stop, first + rows_each)
            rows[low - start : high - start] = chunk[low - first : high - first]
        return rows

    def payload(self, number: int) -> bytes:
        """The encoded bytes of one storage chunk, without their checksum, which was compared.

        Raises:
            CorruptDataError: a checksum does not hold, or bytes are missing.
        """
        size = self._source.size()
        if size is None:
            raise CorruptDataError(f"{self._what}: its shard file is missing")
        if self._index is None:
            self._index = self._read_index(size)
        offset, length = (int(value) for value in self._index[number])
        what = f"{self._what}: storage chunk {number}"
        if offset + length > size:
            raise CorruptDataError(f"{what} lies outside the file")
        return _without_crc(self._source.read(offset, length), what)

    def check_whole(self) -> None:
        """Refuse a file with bytes that belong to nothing, which reading would never notice.

        Raises:
            CorruptDataError: storage chunks that do not follow each other up to the index.
        """
        size = self._source.size()
        if size is None:
            raise CorruptDataError(f"{self._what}: its shard file is missing")
        index = self._read_index(size).astype(np.int64)
        ends = index.sum(axis=1)
        follows = index[:, 0] == np.concatenate([[0], ends])[: len(index)]
        end = int(ends[-1]) if len(index) else 0
        if not follows.all() or end + len(index) * INDEX_ENTRY_BYTES + CRC_BYTES != size:
            raise CorruptDataError(
                f"{self._what}: file holds {size} bytes that do not fit its index"
            )

    def _read_index(self, file_size: int) -> np.ndarray:
        size = self._num_chunks * INDEX_ENTRY_BYTES + CRC_BYTES
        start = file_size - size
        if start < 0:
            raise CorruptDataError(f"{self._what}: file is too short for its index of {size} bytes")
        body = _without_crc(self._source.read(start, size), f"{self._what}: shard index")
        return np.frombuffer(body, dtype="<u8").reshape(-1, 2)

    def _decode(self, number: int) -> np.ndarray:
        what = f"{self._what}: storage chunk {number}"
        return decode_rows(self.payload(number), self._entry, what=what)


def decode_rows(payload: bytes, entry: ArrayEntry, *, what: str) -> Shaped[np.ndarray, "n ..."]:
    """The rows of one `zstd` storage chunk, those that pad it included.

    Raises:
        CorruptDataError: not that many rows.
    """
    dtype = np.dtype(entry.dtype).newbyteorder("<")
    shape = (entry.chunk_rows, *entry.shape[1:])
    expected = math.prod(shape) * dtype.itemsize
    # Asked before anything is unpacked: a bomb says a size that we never allocate.
    if (size := zstd_content_size(payload)) != expected:
        raise CorruptDataError(f"{what}: holds {size} bytes, expected {expected}")
    try:
        data = _ZSTD.decode(payload)
    except (RuntimeError, ValueError) as error:
        raise CorruptDataError(f"{what}: no zstd data ({error})") from error
    return np.frombuffer(data, dtype=dtype).reshape(shape)


def zstd_content_size(frame: bytes) -> int | None:
    """How many bytes a zstd frame says it unpacks to (RFC 8878, 3.1.1); None if it does not say."""
    if len(frame) < 6 or frame[:4] != _ZSTD_MAGIC:
        return None
    descriptor = frame[4]
    single_segment = bool(descriptor & 0x20)
    start = 5 + (not single_segment) + (0, 1, 2, 4)[descriptor & 0x03]
    length = (int(single_segment), 2, 4, 8)[descriptor >> 6]
    if length == 0 or len(frame) < start + length:
        return None
    size = int.from_bytes(frame[start : start + length], "little")
    return size + 256 if length == 2 else size
