"""Rows of one array ↔ one Zarr v3 shard file: appended chunk by chunk, read back slice by slice.

A shard is the standard `sharding_indexed` layout: encoded storage chunks one after the other, then
(offset, length) of each as uint64, then crc32c of that index. Every storage chunk ends in its own
crc32c, so a flipped bit or a torn file is refused and never becomes a number.
"""

import hashlib
import math
import os
from pathlib import Path

import google_crc32c
import numpy as np
from jaxtyping import Shaped
from numcodecs.zstd import Zstd

from dextouch.episodes.files import disk_errors, write_all
from dextouch.episodes.format import ZSTD_LEVEL, ArrayEntry
from dextouch.errors import CorruptDataError, InvalidInputError

_CRC_BYTES = 4
_INDEX_ENTRY_BYTES = 16


def _with_crc(data: bytes) -> bytes:
    return data + google_crc32c.value(data).to_bytes(_CRC_BYTES, "little")


def _without_crc(data: bytes, what: str) -> bytes:
    body, crc = data[:-_CRC_BYTES], data[-_CRC_BYTES:]
    if len(data) < _CRC_BYTES or google_crc32c.value(body) != int.from_bytes(crc, "little"):
        raise CorruptDataError(
            f"{what}: checksum does not hold ({len(data)} bytes read); "
            "the file is damaged or truncated, restore it from a copy"
        )
    return body


class ShardWriter:
    """Appends rows to a new shard file; memory holds one storage chunk at most.

    Args:
        path: of the new file; its folder is created.
        dtype: of the rows, little endian.
        row_shape: of one row.
        chunk_rows: rows a storage chunk.
    """

    def __init__(
        self,
        path: Path,
        *,
        dtype: np.dtype[np.generic],
        row_shape: tuple[int, ...],
        chunk_rows: int,
    ) -> None:
        self.num_rows = 0
        self._dtype, self._row_shape, self._chunk_rows = dtype, row_shape, chunk_rows
        self._zstd = Zstd(level=ZSTD_LEVEL)
        self._pending: list[np.ndarray] = []
        self._num_pending = 0
        self._index: list[tuple[int, int]] = []
        self._offset = 0
        self._sha256 = hashlib.sha256()
        with disk_errors(f"create {path}"):
            path.parent.mkdir(parents=True, exist_ok=True)
            self._file = os.open(path, os.O_WRONLY | os.O_CREAT | os.O_EXCL, 0o644)

    def append(self, rows: np.ndarray) -> None:
        """Append rows [n, *row_shape] of the shard's dtype (checked by the caller)."""
        rows = np.ascontiguousarray(rows, dtype=self._dtype)
        self._sha256.update(rows.tobytes())
        self.num_rows += len(rows)
        while len(rows):
            taken = rows[: self._chunk_rows - self._num_pending]
            # A copy, because the caller may reuse its buffer before the chunk is full.
            self._pending.append(taken.copy())
            self._num_pending += len(taken)
            rows = rows[len(taken) :]
            if self._num_pending == self._chunk_rows:
                self._write_chunk()

    def finish(self) -> str:
        """Write the rest and the index, sync, close; the sha256 of all rows comes back."""
        if self._num_pending:
            missing = self._chunk_rows - self._num_pending
            self._pending.append(np.zeros((missing, *self._row_shape), dtype=self._dtype))
            self._write_chunk()
        index = np.array(self._index, dtype="<u8").reshape(-1, 2)
        with disk_errors("write shard index"):
            write_all(self._file, _with_crc(index.tobytes()))
            os.fdatasync(self._file)
        self.close()
        return self._sha256.hexdigest()

    def close(self) -> None:
        """Give the file back; without `finish` it holds no index and is no shard."""
        if self._file >= 0:
            os.close(self._file)
            self._file = -1

    def _write_chunk(self) -> None:
        data = np.concatenate(self._pending).tobytes()
        encoded = _with_crc(self._zstd.encode(data))
        with disk_errors("write storage chunk"):
            write_all(self._file, encoded)
        self._index.append((self._offset, len(encoded)))
        self._offset += len(encoded)
        self._pending, self._num_pending = [], 0


class ShardReader:
    """Reads slices of rows from a shard file; it keeps no file open.

    Args:
        path: the shard file.
        entry: what the commit record says about the array.
        what: names the array in errors.
    """

    def __init__(self, path: Path, entry: ArrayEntry, *, what: str) -> None:
        self._path, self._entry, self._what = path, entry, what
        self._dtype = np.dtype(entry.dtype).newbyteorder("<")
        self._num_chunks = -(-entry.shape[0] // entry.chunk_rows)
        self._index: np.ndarray | None = None

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
        if start == stop:
            return rows
        with disk_errors(f"read {self._what}"):
            if not self._path.is_file():
                raise CorruptDataError(f"{self._what}: its shard file is missing")
            descriptor = os.open(self._path, os.O_RDONLY)
            try:
                for number in range(start // rows_each, -(-stop // rows_each)):
                    chunk = self._decode(self._read_chunk(descriptor, number), number)
                    first = number * rows_each
                    low, high = max(start, first), min(stop, first + rows_each)
                    rows[low - start : high - start] = chunk[low - first : high - first]
            finally:
                os.close(descriptor)
        return rows

    def _read_chunk(self, descriptor: int, number: int) -> bytes:
        if self._index is None:
            self._index = self._read_index(descriptor)
        offset, length = (int(value) for value in self._index[number])
        if offset + length > os.fstat(descriptor).st_size:
            raise CorruptDataError(f"{self._what}: storage chunk {number} lies outside the file")
        return os.pread(descriptor, length, offset)

    def _read_index(self, descriptor: int) -> np.ndarray:
        size = self._num_chunks * _INDEX_ENTRY_BYTES + _CRC_BYTES
        start = os.fstat(descriptor).st_size - size
        if start < 0:
            raise CorruptDataError(f"{self._what}: file is too short for its index of {size} bytes")
        body = _without_crc(os.pread(descriptor, size, start), f"{self._what}: shard index")
        return np.frombuffer(body, dtype="<u8").reshape(-1, 2)

    def _decode(self, data: bytes, number: int) -> np.ndarray:
        what = f"{self._what}: storage chunk {number}"
        body = _without_crc(data, what)
        shape = (self._entry.chunk_rows, *self._entry.shape[1:])
        expected = math.prod(shape) * self._dtype.itemsize
        try:
            body = Zstd().decode(body)
        except (RuntimeError, ValueError) as error:
            raise CorruptDataError(f"{what}: no zstd data ({error})") from error
        if len(body) != expected:
            raise CorruptDataError(f"{what}: got {len(body)} bytes, expected {expected}")
        return np.frombuffer(body, dtype=self._dtype).reshape(shape)
