"""Zarr v3 shard files: reader and writer of rows, encoded storage chunks or bytes.

A shard has the standard `sharding_indexed` layout: concatenated encoded storage chunks, then
(offset, length) of each as uint64, then crc32c of that index. Every storage chunk ends in its own
crc32c, so a flipped bit or a truncated file is always detected.
"""

import base64
import binascii
import hashlib
import math
import os
import threading
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager, nullcontext
from pathlib import Path
from typing import Any

import google_crc32c
import numpy as np
import zstandard
from jaxtyping import Shaped

from dextouch.episodes.files import ByteSource, OpenedGroup, disk_errors, write_parts
from dextouch.episodes.format import ZSTD_LEVEL, ArrayEntry, shard_path, with_rows
from dextouch.errors import CorruptDataError, InvalidInputError

CRC_BYTES = 4
INDEX_ENTRY_BYTES = 16
# The four bytes of a block that repeats one byte unpack to 128 KiB (RFC 8878, 3.1.1.2).
_ZSTD_MAX_RATIO = 1 << 15
# The length of an access unit, a start code and the header of its first unit.
_H264_MIN_BYTES = 4 + 3 + 1
# Adjacent storage chunks are fetched together up to this many bytes: enough for most windows in one
# request, while whole arrays are still read in pieces.
_SPAN_BYTES = 1 << 21
# A writer collects storage chunks up to this many bytes.
_WRITE_BYTES = 1 << 18
# At most IOV_MAX of Linux, 1024.
_WRITE_PARTS = 512
# Far above current chunks (1 MiB, or one sample), and above the half second of raw images that
# earlier releases wrote.
MAX_CHUNK_BYTES = 1 << 29


class _Contexts(threading.local):
    """Contexts of zstd: creating one costs as much as decompressing a storage chunk."""

    def __init__(self) -> None:
        self.compressor = zstandard.ZstdCompressor(level=ZSTD_LEVEL)
        self.decompressor = zstandard.ZstdDecompressor()


_CONTEXTS = _Contexts()


def compress(data: bytes) -> bytes:
    """Compress bytes to one zstd frame."""
    return _CONTEXTS.compressor.compress(data)


def decompress(frame: bytes, *, size: int, what: str) -> bytes:
    """Decompress a single zstd frame of exactly `size` bytes; `what` names it in errors.

    Raises CorruptDataError for another size or trailing data, or more than MAX_CHUNK_BYTES.
    """
    if size > MAX_CHUNK_BYTES:
        raise CorruptDataError(f"{what}: is of {size} bytes, expected at most {MAX_CHUNK_BYTES}")
    try:
        # Checked before decompression, so that the size that a bomb declares is never allocated.
        said = zstandard.get_frame_parameters(frame).content_size
        if said != size:
            raise CorruptDataError(f"{what}: holds {said} bytes, expected {size}")
        return _CONTEXTS.decompressor.decompress(frame, allow_extra_data=False)
    except zstandard.ZstdError as error:
        raise CorruptDataError(f"{what}: no zstd frame of {size} bytes ({error})") from error


def with_crc(data: bytes) -> bytes:
    """Append the crc32c to bytes."""
    return data + google_crc32c.value(data).to_bytes(CRC_BYTES, "little")


def _without_crc(
    data: memoryview | bytes, start: int, length: int, what: str, expected: bytes | None = None
) -> bytes:
    """Verify the checksum of `length` bytes from `start` on, and return the bytes without it.

    `expected` is the checksum that the commit record says they have.
    """
    stop = start + length
    if len(data) < stop:
        raise CorruptDataError(
            f"{what} lies outside the file ({max(0, len(data) - start)} of {length} bytes there); "
            "the file is truncated, restore it from a copy"
        )
    # Copied before it is verified, so that a concurrent change of the file has no effect.
    body, crc = bytes(data[start : stop - CRC_BYTES]), data[stop - CRC_BYTES : stop]
    if length < CRC_BYTES or google_crc32c.value(body) != int.from_bytes(crc, "little"):
        raise CorruptDataError(
            f"{what}: checksum mismatch ({length} bytes read); "
            "the file is damaged or truncated, restore it from a copy"
        )
    if expected is not None and expected != crc:
        raise CorruptDataError(
            f"{what}: is intact, but its checksum is not that in the commit record; the file is "
            "another one of the same size, restore the right one from a copy"
        )
    return body


class ShardReader:
    """Reads rows or storage chunks of one array; the index is cached.

    `what` names the array in errors. `index` is (offset, length) of each storage chunk, for a file
    whose own index is damaged; without its `group` a file's deletion cannot be told from damage.
    """

    def __init__(
        self,
        source: ByteSource,
        entry: ArrayEntry,
        *,
        what: str,
        index: np.ndarray | None = None,
        group: OpenedGroup | None = None,
    ) -> None:
        self._source, self._entry, self._what = source, entry, what
        self._dtype, self._row_bytes = _row_layout(entry)
        self._chunk_bytes = entry.chunk_rows * self._row_bytes
        self.num_rows, self.chunk_rows = entry.shape[0], entry.chunk_rows
        self.num_chunks = -(-entry.shape[0] // entry.chunk_rows)
        self._index = index
        self._present: Callable[[], AbstractContextManager[None]] = (
            nullcontext if group is None else group.present
        )
        self._crcs = _committed_crcs(entry, self.num_chunks, what)

    def read(self, start: int = 0, stop: int | None = None) -> Shaped[np.ndarray, "n ..."]:
        """Rows start … stop-1; only the storage chunks that contain them are read and decoded.

        Raises InvalidInputError for rows outside the array, CorruptDataError for missing bytes or a
        checksum mismatch, NotFoundError if the group was deleted or replaced since it was opened.
        """
        with self._present():
            return self._read(start, stop)

    def _read(self, start: int, stop: int | None) -> Shaped[np.ndarray, "n ..."]:
        num_rows, rows_each = self.num_rows, self.chunk_rows
        stop = num_rows if stop is None else stop
        if not 0 <= start <= stop <= num_rows:
            raise InvalidInputError(
                f"{self._what}: got rows {start} … {stop}, expected within 0 … {num_rows}"
            )
        first = start // rows_each
        places = self._checked_index()[first : -(-stop // rows_each) if stop > start else first]
        rows = np.empty((stop - start) * self._row_bytes, dtype=np.uint8)
        # As plain bytes, which are cheaper to copy than rows for small windows.
        wanted, skip = rows.data, start % rows_each * self._row_bytes
        for what, payload in self._payloads(first, places.tolist()):
            data = decompress(payload, size=self._chunk_bytes, what=what)
            part = memoryview(data)[skip : skip + len(wanted)]
            wanted[: len(part)] = part
            wanted, skip = wanted[len(part) :], 0
        if wanted:
            raise CorruptDataError(
                f"{self._what}: its index names {len(places)} storage chunks of rows {start} … "
                f"{stop}, expected all of them; the last {len(wanted)} bytes are missing"
            )
        return rows.view(self._dtype).reshape(stop - start, *self._entry.shape[1:])

    def rows_of(self, payload: bytes, number: int) -> Shaped[np.ndarray, "n ..."]:
        """The rows of a storage chunk of numbers, without padding; raises as `decompress`."""
        rows = decode_rows(payload, self._entry, what=f"{self._what}: storage chunk {number}")
        return rows[: self.num_rows - number * self.chunk_rows]

    def payload(self, number: int) -> bytes:
        """The encoded bytes of one storage chunk, verified, without checksum; raises as `read`."""
        what = f"{self._what}: storage chunk {number}"
        with self._present():
            offset, length = self._checked_index()[number].tolist()
            data = self._source.read(offset, length)
            return _without_crc(data, 0, length, what, self._crc(number))

    def read_bytes(self, start: int, stop: int) -> bytes:
        """Bytes start … stop−1 of a `bytes` array, which the caller verifies.

        The checksums of the storage chunks are not looked at, since an index has those of images.
        Raises as `read`.
        """
        rows, step = self.chunk_rows, self.chunk_rows + CRC_BYTES
        first, last = start // rows, (stop - 1) // rows
        begin, end = start + first * CRC_BYTES, stop + last * CRC_BYTES
        with self._present():
            self._checked_index()
            data = self._source.read(begin, end - begin)
            if len(data) != end - begin:
                raise CorruptDataError(
                    f"{self._what}: bytes {start} … {stop - 1} lie outside the file; the file is "
                    "truncated, restore it from a copy"
                )
        head = (first + 1) * rows - start
        if first == last:
            return bytes(data)
        later = range(head + CRC_BYTES, len(data), step)
        return b"".join([data[:head], *(data[place : place + rows] for place in later)])

    def _crc(self, number: int) -> bytes | None:
        place = number * CRC_BYTES
        return None if self._crcs is None else self._crcs[place : place + CRC_BYTES]

    def _payloads(self, number: int, places: list[list[int]]) -> Iterator[tuple[str, bytes]]:
        """Error label and payload of storage chunks from `number` on, by offset and length.

        Adjacent ones are fetched together.
        """
        while places:
            begin, end, count = places[0][0], places[0][0], 0
            for offset, length in places:
                if count and (offset != end or end + length - begin > _SPAN_BYTES):
                    break
                end, count = end + length, count + 1
            data = self._source.read(begin, end - begin)
            for offset, length in places[:count]:
                what = f"{self._what}: storage chunk {number}"
                yield what, _without_crc(data, offset - begin, length, what, self._crc(number))
                number += 1
            places = places[count:]

    def check_index(self) -> np.ndarray:
        """Read and validate the (offset, length) of every storage chunk, cached; raises as `read`.

        They must be contiguous up to the index, and long enough for the rows in the commit record.
        """
        with self._present():
            return self._checked_index()

    def _checked_index(self) -> np.ndarray:
        if self._index is None:
            size = self._source.size()
            if size is None:
                raise CorruptDataError(f"{self._what}: its shard file is missing")
            index_bytes = self.num_chunks * INDEX_ENTRY_BYTES + CRC_BYTES
            if size < index_bytes:
                raise CorruptDataError(
                    f"{self._what}: file is too short for its index of {index_bytes} bytes"
                )
            data = self._source.read(size - index_bytes, index_bytes)
            body = _without_crc(data, 0, index_bytes, f"{self._what}: shard index")
            index = np.frombuffer(body, dtype="<u8").reshape(-1, 2)
            self._check_follows(index, size - len(index) * INDEX_ENTRY_BYTES - CRC_BYTES)
            self._check_claim(index)
            self._index = index
        return self._index

    def _check_follows(self, index: np.ndarray, end: int) -> None:
        """Refuse overlaps, gaps and unreferenced bytes."""
        # Checked separately, since the sum of two forged numbers could overflow.
        inside = bool((index <= end).all())
        ends = np.concatenate([np.zeros(1, "<u8"), index.sum(axis=1)])
        if not inside or int(ends[-1]) != end or not np.array_equal(index[:, 0], ends[:-1]):
            raise CorruptDataError(
                f"{self._what}: shard index is inconsistent with the {end} bytes of its chunks"
            )

    def _check_claim(self, index: np.ndarray) -> None:
        """Refuse more rows than the chunks' bytes can encode."""
        entry, lengths = self._entry, index[:, 1].astype(np.int64)
        rows = np.full(len(lengths), entry.chunk_rows)
        rows[-1:] = entry.shape[0] - (len(lengths) - 1) * entry.chunk_rows
        needed = rows * (_H264_MIN_BYTES if entry.codec == "h264" else 1)
        if entry.codec == "bytes":
            needed[:] = entry.chunk_rows + CRC_BYTES
        elif entry.codec == "zstd":
            needed[:] = -(-self._chunk_bytes // _ZSTD_MAX_RATIO)
        if len(bad := np.flatnonzero(lengths < needed)):
            raise CorruptDataError(
                f"{self._what}: storage chunks of {entry.chunk_rows} rows need at least "
                f"{needed[bad[0]]} bytes, got one of {lengths[bad[0]]}"
            )


def _committed_crcs(entry: ArrayEntry, num_chunks: int, what: str) -> bytes | None:
    if entry.crc32c is None:
        return None
    try:
        crcs = base64.b64decode(entry.crc32c, validate=True)
    except binascii.Error as error:
        raise CorruptDataError(f"{what}: checksums in the commit record: {error}") from error
    if len(crcs) != num_chunks * CRC_BYTES:
        raise CorruptDataError(
            f"{what}: commit record has {len(crcs)} bytes of checksums, expected {CRC_BYTES} for "
            f"each of {num_chunks} storage chunks"
        )
    return crcs


def _row_layout(entry: ArrayEntry) -> tuple[np.dtype[Any], int]:
    dtype = np.dtype(entry.dtype).newbyteorder("<")
    return dtype, math.prod(entry.shape[1:]) * dtype.itemsize


def decode_rows(payload: bytes, entry: ArrayEntry, *, what: str) -> Shaped[np.ndarray, "n ..."]:
    """The rows of one `zstd` storage chunk, padding included; raises as `decompress`."""
    dtype, row_bytes = _row_layout(entry)
    data = decompress(payload, size=entry.chunk_rows * row_bytes, what=what)
    return np.frombuffer(data, dtype=dtype).reshape(entry.chunk_rows, *entry.shape[1:])


class ShardWriter:
    """Appends rows to a new shard of a stage; buffers at most one storage chunk and 256 KiB.

    The entry of the array has 0 rows and no hash yet. Raises StorageError if a file cannot be
    created, StorageFullError without space; nothing can be appended afterwards.
    """

    def __init__(self, stage: Path, name: str, entry: ArrayEntry) -> None:
        self.num_rows = 0
        self._name, self._entry = name, entry
        self._dtype = np.dtype(entry.dtype).newbyteorder("<")
        self._chunk = (
            np.zeros((entry.chunk_rows, *entry.shape[1:]), dtype=self._dtype)
            if entry.codec == "zstd"
            else np.zeros(0, dtype=self._dtype)
        )
        # Rows of a storage chunk that is not full yet; of a `bytes` array its crc32c so far.
        self._num_pending = self._crc = 0
        self._crcs = bytearray()
        # Not written yet.
        self._parts: list[bytes | memoryview] = []
        self._num_waiting = 0
        self._sha256 = hashlib.sha256()
        # Offset and length of each storage chunk.
        self._index: list[tuple[int, int]] = []
        path = stage / name / shard_path(len(entry.shape))
        with disk_errors(f"create array {name}"):
            path.parent.mkdir(parents=True)
            self._file = os.open(path, os.O_WRONLY | os.O_CREAT | os.O_EXCL, 0o644)

    def append(self, rows: np.ndarray) -> None:
        """Append rows [n, *row_shape] of the array's dtype (checked by the caller)."""
        self.num_rows += len(rows)
        while len(rows):
            taken = rows[: len(self._chunk) - self._num_pending]
            self._chunk[self._num_pending : self._num_pending + len(taken)] = taken
            self._num_pending += len(taken)
            rows = rows[len(taken) :]
            if self._num_pending == len(self._chunk):
                self._write_rows()

    def append_bytes(self, data: bytes) -> None:
        """Append to a `bytes` array, whose sha256 is the caller's to compute."""
        self.num_rows += len(data)
        self._append_bytes(data)

    def _append_bytes(self, data: bytes) -> None:
        size, pending, crc, start = self._entry.chunk_rows, self._num_pending, self._crc, 0
        # Cut as an array, without copies.
        view = np.frombuffer(data, dtype=np.uint8)
        for end in (*range(size - pending, len(data), size), len(data)):
            part, pending = view[start:end], pending + end - start
            crc = google_crc32c.extend(crc, part)
            self._parts.append(part.data)
            if pending == size:
                self._parts.append(crc.to_bytes(CRC_BYTES, "little"))
                pending = crc = 0
            start = end
        self._num_pending, self._crc = pending, crc
        self._num_waiting += len(data)
        self._flush_much()

    def finish(self) -> ArrayEntry:
        """Complete the shard and return the array's entry of the commit record."""
        if self._num_pending and self._entry.codec == "zstd":
            self._chunk[self._num_pending :] = 0
            self._write_rows()
        index = np.array(self._index, dtype="<u8").reshape(-1, 2)
        if self._entry.codec == "bytes":
            self._append_bytes(bytes(-self._num_pending % self._entry.chunk_rows))
            step = self._entry.chunk_rows + CRC_BYTES
            numbers = np.arange(-(-self.num_rows // self._entry.chunk_rows), dtype="<u8")
            index = np.stack([numbers * step, np.full_like(numbers, step)], axis=1)
        self._write(with_crc(index.tobytes()))
        self._flush()
        self.close()
        update: dict[str, object] = {"sha256": self._sha256.hexdigest()}
        if self._entry.codec == "zstd":
            update["crc32c"] = base64.b64encode(self._crcs).decode()
        return with_rows(self._entry, self.num_rows).model_copy(update=update)

    def close(self) -> None:
        """Close the file; without a prior `finish` it is no shard."""
        # Forgotten before it is closed: after an interrupt between the two the number may already
        # be that of another file.
        file, self._file = self._file, -1
        if file >= 0:
            os.close(file)

    def _write_rows(self) -> None:
        data = self._chunk.tobytes()
        num_rows = self._num_pending
        chunk = with_crc(compress(data))
        self._crcs += chunk[-CRC_BYTES:]
        self._index.append((sum(self._index[-1]) if self._index else 0, len(chunk)))
        self._write(chunk)
        self._sha256.update(memoryview(data)[: num_rows * (len(data) // len(self._chunk))])
        self._num_pending = 0

    def _write(self, part: bytes | memoryview) -> None:
        self._parts.append(part)
        self._num_waiting += len(part)
        self._flush_much()

    def _flush_much(self) -> None:
        if self._num_waiting >= _WRITE_BYTES or len(self._parts) >= _WRITE_PARTS:
            self._flush()

    def _flush(self) -> None:
        parts, self._parts, self._num_waiting = self._parts, [], 0
        with disk_errors(f"write array {self._name}", advice="free space on the disk of the store"):
            write_parts(self._file, *parts)
