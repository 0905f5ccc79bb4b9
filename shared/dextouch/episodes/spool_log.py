"""Bodies ↔ records of one append-only file: the log of a spool, whatever its streams are.

A record is a header, which says where it lies and has a checksum of its own, and a body behind it.
One file for all streams, so that one wait for the disk keeps everything. A torn end is told from
damage by what follows: behind a torn end there is no whole header.
"""

import os
import struct
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

import google_crc32c
import numpy as np

from dextouch.episodes.files import disk_errors, write_parts
from dextouch.errors import CorruptDataError, StorageError

LOG_FILE = "batches.log"
LOG_MAGIC = b"DXTBLOG\x01"
_MARK = b"DXTR"
# Mark, place of the record in the file, samples of its stream before it, stream, samples, length
# and crc32c of the body; then the crc32c of all that.
_HEADER = struct.Struct("<4sQQIIII")
_CRC = struct.Struct("<I")
HEADER_BYTES = _HEADER.size + _CRC.size
RECORD_ROW = np.dtype(
    [
        ("offset", "<u8"),
        ("first_sample", "<u8"),
        ("stream", "<u4"),
        ("num_samples", "<u4"),
        ("length", "<u4"),
        ("body_crc32c", "<u4"),
    ]
)
_ROW = struct.Struct("<QQIIII")
_BLOCK_BYTES = 1 << 14
_SEARCH_BYTES = 1 << 20


@dataclass(frozen=True)
class LogRecords:
    """The records of a log whose headers hold, and the spans of bytes that are no record.

    `rows` is [n] of RECORD_ROW; a span at the end of the file is what a crash tore off.
    """

    rows: np.ndarray
    gaps: tuple[tuple[int, int], ...]
    num_bytes: int

    @property
    def end(self) -> int:
        """Where the next record goes: behind the last one."""
        if not len(self.rows):
            return len(LOG_MAGIC)
        return int(self.rows["offset"][-1]) + HEADER_BYTES + int(self.rows["length"][-1])

    @property
    def damage(self) -> tuple[tuple[int, int], ...]:
        """Spans with whole records behind them: no crash leaves those."""
        return tuple(gap for gap in self.gaps if gap[1] < self.num_bytes)


class LogBytes:
    """The bytes of a log as long as it was when this was made.

    Read and not mapped: a writer that takes its last append back makes the file shorter, and
    touching what is gone of a mapping kills the process.
    """

    def __init__(self, descriptor: int) -> None:
        self._descriptor = descriptor
        self._num_bytes = os.fstat(descriptor).st_size
        self._block, self._block_start = b"", 0

    def __len__(self) -> int:
        return self._num_bytes

    def read(self, start: int, length: int) -> bytes:
        """Bytes start … start + length − 1, fewer at the end."""
        low = start - self._block_start
        if low < 0 or low + length > len(self._block):
            self._block = os.pread(self._descriptor, max(length, _BLOCK_BYTES), start)
            self._block_start, low = start, 0
        return self._block[low : low + length]

    def find(self, mark: bytes, start: int) -> int:
        """Where a mark next begins; -1 if nowhere."""
        while start < self._num_bytes:
            block = os.pread(self._descriptor, _SEARCH_BYTES, start)
            place = block.find(mark)
            if place >= 0:
                return start + place
            if len(block) < len(mark):
                break
            start += len(block) - len(mark) + 1
        return -1


@contextmanager
def open_log(folder: Path) -> Iterator[LogBytes]:
    """The bytes of a spool's log.

    Raises:
        CorruptDataError: there is no log.
    """
    path = folder / LOG_FILE
    with disk_errors(f"read log of spool {folder.name!r}"):
        if not path.is_file():
            raise CorruptDataError(f"spool {folder.name!r}: {LOG_FILE} is missing")
        descriptor = os.open(path, os.O_RDONLY)
    try:
        with disk_errors(f"read log of spool {folder.name!r}"):
            yield LogBytes(descriptor)
    finally:
        os.close(descriptor)


def find_records(data: LogBytes) -> LogRecords:
    """Every record of a log's bytes, going on behind damage.

    Raises:
        CorruptDataError: the bytes are no log.
    """
    magic = data.read(0, len(LOG_MAGIC))
    if not LOG_MAGIC.startswith(magic):
        raise CorruptDataError(f"log: begins with {magic!r}, expected {LOG_MAGIC!r}")
    # Rows as bytes: those of a minute of a station take 14 MB as tuples, 2 MB so.
    rows, gaps, place = bytearray(), [], len(LOG_MAGIC)
    while place < len(data):
        row = _header_at(data, place)
        if row is None:
            following = _next_header(data, place + 1)
            gaps.append((place, following))
            place = following
        else:
            rows += _ROW.pack(*row)
            place += HEADER_BYTES + row[4]
    return LogRecords(np.frombuffer(rows, dtype=RECORD_ROW), tuple(gaps), len(data))


def read_records(folder: Path) -> LogRecords:
    """The records of a spool's log; what a crash tore off is left out.

    Raises:
        CorruptDataError: damage that is no torn end, or a log that is missing or foreign.
    """
    with open_log(folder) as data:
        records = find_records(data)
    if records.damage:
        start, stop = records.damage[0]
        raise CorruptDataError(
            f"log of spool {folder.name!r}: bytes {start} … {stop - 1} are no record, yet whole "
            "ones follow; this is no torn end but damage, restore the file from a copy"
        )
    for stream in np.unique(records.rows["stream"]):
        rows = records.rows[records.rows["stream"] == stream]
        before = np.cumsum(rows["num_samples"], dtype=np.uint64) - rows["num_samples"]
        if (before != rows["first_sample"]).any():
            raise CorruptDataError(
                f"log of spool {folder.name!r}: records of stream number {int(stream)} do not "
                "follow each other; restore the file from a copy"
            )
    return records


def body_at(data: LogBytes, row: np.void) -> bytes | None:
    """The body of a record; None where it does not hold."""
    start = int(row["offset"]) + HEADER_BYTES
    body = data.read(start, int(row["length"]))
    whole = len(body) == row["length"] and google_crc32c.value(body) == row["body_crc32c"]
    return body if whole else None


def read_bodies(folder: Path, rows: np.ndarray) -> Iterator[bytes]:
    """The bodies of some records, one after the other.

    Raises:
        CorruptDataError: a body does not match its checksum.
    """
    with open_log(folder) as data:
        for row in rows:
            body = body_at(data, row)
            if body is None:
                raise CorruptDataError(
                    f"log of spool {folder.name!r}: the record at byte {int(row['offset'])} does "
                    "not match its checksum; the file is damaged, restore it from a copy"
                )
            yield body


def _header_at(data: LogBytes, place: int) -> tuple[int, int, int, int, int, int] | None:
    """The header at a place as a row of RECORD_ROW; None where none is or its body is cut off."""
    header = data.read(place, HEADER_BYTES)
    if len(header) < HEADER_BYTES or header[: len(_MARK)] != _MARK:
        return None
    _, offset, first, stream, num_samples, length, crc = _HEADER.unpack_from(header)
    holds = google_crc32c.value(header[: _HEADER.size]) == _CRC.unpack_from(header, _HEADER.size)[0]
    if not holds or offset != place or place + HEADER_BYTES + length > len(data):
        return None
    return offset, first, stream, num_samples, length, crc


def _next_header(data: LogBytes, place: int) -> int:
    """Where the next whole record begins; the end of the data where none does."""
    place = data.find(_MARK, place)
    while place >= 0 and _header_at(data, place) is None:
        place = data.find(_MARK, place + 1)
    return place if place >= 0 else len(data)


@dataclass(frozen=True)
class RecordBody:
    """The body of a record with its checksum, ready to be written."""

    data: bytes
    crc32c: int
    num_samples: int

    @staticmethod
    def of(data: bytes, *, num_samples: int) -> "RecordBody":
        """A body whose checksum is made here."""
        return RecordBody(data, google_crc32c.value(data), num_samples)


class BatchLogWriter:
    """Appends records to a spool's log; each append is one write.

    Args:
        folder: of the spool.
        end: None for a new log, else where to go on; what lies behind is cut off.

    Raises:
        StorageError: the file exists already, or cannot be made.
    """

    def __init__(self, folder: Path, *, end: int | None = None) -> None:
        self._what = f"log of spool {folder.name!r}"
        self._file = -1
        self._end = len(LOG_MAGIC) if end is None else max(end, len(LOG_MAGIC))
        flags = os.O_RDWR | os.O_CREAT | (os.O_EXCL if end is None else 0)
        with disk_errors(f"open {self._what}"):
            self._file = os.open(folder / LOG_FILE, flags, 0o644)
            os.pwrite(self._file, LOG_MAGIC, 0)
            self._cut(self._end)

    def append(self, body: RecordBody, *, stream: int, first_sample: int) -> int:
        """Append a record, whole or not at all; its place comes back, for `undo`.

        Raises:
            StorageFullError: no space; the file is as it was before this call.
        """
        place, length = self._end, len(body.data)
        header = _HEADER.pack(
            _MARK, place, first_sample, stream, body.num_samples, length, body.crc32c
        )
        parts = (header, _CRC.pack(google_crc32c.value(header)), body.data)
        try:
            with disk_errors(
                self._what, advice="what was recorded stays, free space and try again"
            ):
                write_parts(self._file, parts)
        except StorageError:
            # Cutting off needs no space: what was acknowledged before stays readable.
            self._cut(place)
            raise
        self._end = place + HEADER_BYTES + length
        return place

    def undo(self, place: int) -> None:
        """Take back the last append, whose place is given."""
        with disk_errors(f"cut {self._what}"):
            self._cut(place)
        self._end = place

    def sync(self) -> None:
        """Make everything appended survive a power loss."""
        with disk_errors(f"sync {self._what}"):
            os.fdatasync(self._file)

    def close(self) -> None:
        """Give the file back."""
        if self._file >= 0:
            os.close(self._file)
            self._file = -1

    def _cut(self, size: int) -> None:
        os.ftruncate(self._file, size)
        os.lseek(self._file, size, os.SEEK_SET)
