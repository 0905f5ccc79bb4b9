"""One Zarr v3 shard file → rows of its array, or the encoded storage chunks as they are.

A shard is the standard `sharding_indexed` layout: encoded storage chunks one after the other, then
(offset, length) of each as uint64, then crc32c of that index. Every storage chunk ends in its own
crc32c, so a flipped bit or a torn file is refused and never becomes a number.
"""

import math

import google_crc32c
import numpy as np
from jaxtyping import Shaped

from dextouch.episodes.format import ArrayEntry
from dextouch.episodes.sources import ByteSource
from dextouch.episodes.zstd import decompress
from dextouch.errors import CorruptDataError, InvalidInputError

CRC_BYTES = 4
INDEX_ENTRY_BYTES = 16
# The four bytes of a block that repeats one byte unpack to 128 KiB (RFC 8878, 3.1.1.2).
_ZSTD_MAX_RATIO = 1 << 15
# The length of an access unit, a start code and the header of its first unit.
_H264_MIN_BYTES = 4 + 3 + 1


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
        self.check_index()
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
        offset, length = (int(value) for value in self.check_index()[number])
        what = f"{self._what}: storage chunk {number}"
        data = self._source.read(offset, length)
        if len(data) != length:
            raise CorruptDataError(f"{what} lies outside the file")
        return _without_crc(data, what)

    def check_index(self) -> np.ndarray:
        """The (offset, length) of every storage chunk, read once, before anything is allocated.

        Raises:
            CorruptDataError: a missing file; storage chunks that do not follow each other up to the
                index, or are too short for the rows that the commit record claims.
        """
        if self._index is None:
            size = self._source.size()
            if size is None:
                raise CorruptDataError(f"{self._what}: its shard file is missing")
            index = self._read_index(size)
            self._check_follows(index, size - len(index) * INDEX_ENTRY_BYTES - CRC_BYTES)
            self._check_claim(index)
            self._index = index
        return self._index

    def _check_follows(self, index: np.ndarray, end: int) -> None:
        """Refuse overlaps, gaps, and bytes that belong to nothing."""
        # First alone, since the sum of two forged numbers could come round to a small one.
        inside = bool((index <= end).all())
        ends = np.concatenate([np.zeros(1, "<u8"), index.sum(axis=1)])
        if not inside or int(ends[-1]) != end or not np.array_equal(index[:, 0], ends[:-1]):
            raise CorruptDataError(
                f"{self._what}: shard index does not fit the {end} bytes of its storage chunks"
            )

    def _check_claim(self, index: np.ndarray) -> None:
        """Refuse more rows than the bytes there can hold."""
        entry, lengths = self._entry, index[:, 1].astype(np.int64)
        if not len(lengths):
            return
        bound = int(lengths.min())
        if entry.codec == "zstd":
            claimed = -(-self._chunk_bytes() // _ZSTD_MAX_RATIO)
        elif entry.codec == "h264":
            full = lengths[: entry.shape[0] // entry.chunk_rows]
            bound = int(full.min()) if len(full) else int(lengths[-1])
            rows = entry.chunk_rows if len(full) else entry.shape[0]
            claimed = rows * _H264_MIN_BYTES
        else:
            claimed = entry.chunk_rows
        if claimed > bound:
            raise CorruptDataError(
                f"{self._what}: storage chunks of {entry.chunk_rows} rows need at least {claimed} "
                f"bytes, got one of {bound}"
            )

    def _chunk_bytes(self) -> int:
        return self._entry.chunk_rows * math.prod(self._entry.shape[1:]) * self._dtype.itemsize

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
    data = decompress(payload, size=expected, what=what)
    return np.frombuffer(data, dtype=dtype).reshape(shape)
