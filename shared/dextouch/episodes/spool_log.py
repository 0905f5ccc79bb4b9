"""Files of a spool: its checksummed record file, attributes, and the seal of a closed one.

A record is a header with its own offset and checksum, followed by the body of a batch
(`dextouch.streams.batch`). All streams share one file, so that a single sync covers them. A torn
tail differs from damage in that no valid header follows it.
"""

import hashlib
import os
import re
import struct
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import BinaryIO, Final, Literal

import google_crc32c
import numpy as np
from pydantic import Field, ValidationError

from dextouch.episodes.files import disk_errors, write_parts
from dextouch.episodes.format import sha256_hex
from dextouch.errors import CorruptDataError, NotFoundError, StorageError
from dextouch.frozen_model import FrozenModel
from dextouch.schemas import RecordingAttributes, first_problems
from dextouch.streams import ENCODED_UNITS, EncodedBatch, SampleBatch, StreamDescriptor, decode_body

LOG_FILE = "batches.log"
LOG_MAGIC = b"DXTBLOG\x02"
_RECORD_MAGIC = b"DXTS"
# Magic, offset of the record, samples of its stream before it, stream, samples, length and crc32c
# of the body; then the crc32c of the header.
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
        # Always 0; the seal of a closed spool covers it.
        ("zero", "<u4"),
    ]
)
_ROW = struct.Struct("<QQIIIII")
_BLOCK_BYTES = 1 << 14
_SEARCH_BYTES = 1 << 20
RECORDING_FILE: Final = "recording.json"
CLOSED_FILE: Final = "closed"
# The last member of `recording.json`: of the bytes before it, closed by a brace.
_CHECKSUM = re.compile(rb',"sha256":"([0-9a-f]{64})"\}\Z')


@dataclass(frozen=True)
class LogRecords:
    """The records of a log with valid headers, and the byte spans in between that are not records.

    `rows` is [n] of RECORD_ROW; a span at the end of the file is a torn tail.
    """

    rows: np.ndarray
    gaps: tuple[tuple[int, int], ...]
    num_bytes: int

    @property
    def end(self) -> int:
        """Offset of the next record, after the last one."""
        if not len(self.rows):
            return len(LOG_MAGIC)
        return int(self.rows["offset"][-1]) + HEADER_BYTES + int(self.rows["length"][-1])

    @property
    def damage(self) -> tuple[tuple[int, int], ...]:
        """Invalid spans that are followed by valid records, which no crash leaves."""
        return tuple(gap for gap in self.gaps if gap[1] < self.num_bytes)


class LogBytes:
    """Snapshot of a log, up to its length at the time of opening.

    Read and not memory-mapped: a writer that undoes its last append truncates the file, and access
    beyond the end of a mapping kills the process (SIGBUS).
    """

    def __init__(self, file: BinaryIO, what: str) -> None:
        self.what = what
        self._file, self._num_bytes = file, os.fstat(file.fileno()).st_size

    def __len__(self) -> int:
        return self._num_bytes

    def read(self, start: int, length: int) -> bytes:
        """Bytes start … start + length − 1, fewer at the end."""
        self._file.seek(start)
        return self._file.read(length)

    def find(self, mark: bytes, start: int) -> int:
        """Offset of the next occurrence of `mark`; -1 if there is none."""
        while start < self._num_bytes:
            block = self.read(start, _SEARCH_BYTES)
            place = block.find(mark)
            if place >= 0:
                return start + place
            if len(block) < len(mark):
                break
            start += len(block) - len(mark) + 1
        return -1


@contextmanager
def open_log(folder: Path) -> Iterator[LogBytes]:
    """Open a spool's log for reading; raises CorruptDataError if it is missing."""
    with disk_errors(f"read log of spool {folder.name!r}"):
        if not (folder / LOG_FILE).is_file():
            raise CorruptDataError(f"spool {folder.name!r}: {LOG_FILE} is missing")
        with (folder / LOG_FILE).open("rb", buffering=_BLOCK_BYTES) as file:
            yield LogBytes(file, f"log of spool {folder.name!r}")


def find_records(data: LogBytes) -> LogRecords:
    """Find all records of a log, continuing after damage.

    Raises CorruptDataError for other bytes, StorageError for another version of the format.
    """
    magic = data.read(0, len(LOG_MAGIC))
    # Written and synced before the spool appears, so that no crash leaves less of it.
    if magic[:-1] == LOG_MAGIC[:-1] and magic != LOG_MAGIC:
        raise StorageError(
            f"{data.what}: {LOG_FILE} has format version {magic[-1]}, expected {LOG_MAGIC[-1]}; "
            "read it with the release that wrote it",
            format_version=magic[-1],
        )
    if magic != LOG_MAGIC:
        raise CorruptDataError(f"{data.what}: begins with {magic!r}, expected {LOG_MAGIC!r}")
    # Packed rows: those of one minute of a station take 2 MB, against 14 MB as tuples.
    rows, gaps, place = bytearray(), [], len(LOG_MAGIC)
    while place < len(data):
        row = _header_at(data, place)
        if row is None:
            following = data.find(_RECORD_MAGIC, place + 1)
            while following >= 0 and _header_at(data, following) is None:
                following = data.find(_RECORD_MAGIC, following + 1)
            gaps.append((place, following if following >= 0 else len(data)))
            place = gaps[-1][1]
        else:
            rows += _ROW.pack(*row)
            place += HEADER_BYTES + row[4]
    return LogRecords(np.frombuffer(rows, dtype=RECORD_ROW), tuple(gaps), len(data))


def read_records(folder: Path) -> LogRecords:
    """The records of a spool's log; a torn tail is ignored.

    Raises as `find_records`, and CorruptDataError for damage other than a torn tail.
    """
    with open_log(folder) as data:
        records = find_records(data)
    if records.damage:
        start, stop = records.damage[0]
        raise CorruptDataError(
            f"log of spool {folder.name!r}: bytes {start} … {stop - 1} are not a record, but valid "
            "ones follow; this is damage, not a torn tail: restore the file from a copy"
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
    """The body of a record; None if its checksum does not match."""
    start = int(row["offset"]) + HEADER_BYTES
    body = data.read(start, int(row["length"]))
    whole = len(body) == row["length"] and google_crc32c.value(body) == row["body_crc32c"]
    return body if whole else None


def read_bodies(folder: Path, rows: np.ndarray) -> Iterator[bytes]:
    """Iterate over the bodies of records of one stream.

    Raises CorruptDataError if one does not match its checksum.
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


def read_batch(folder: Path, descriptor: StreamDescriptor, rows: np.ndarray) -> SampleBatch:
    """The samples in consecutive records of one stream, verified.

    Raises as `read_bodies`, and CorruptDataError for a body of another stream.
    """
    where, counts = f"spool {folder.name!r}", rows["num_samples"].tolist()
    bodies = read_bodies(folder, rows)
    if descriptor.unit not in ENCODED_UNITS or not counts:
        return decode_body(descriptor, b"".join(bodies), sum(counts), where=where)
    # Images are large, and not copied once more.
    found = map(partial(decode_body, descriptor, where=where), bodies, counts)
    return SampleBatch(*map(np.concatenate, zip(*(vars(b).values() for b in found), strict=True)))


def _header_at(data: LogBytes, place: int) -> tuple[int, ...] | None:
    """The header at an offset as a row of RECORD_ROW; None if invalid or its body is truncated."""
    header = data.read(place, HEADER_BYTES)
    if len(header) < HEADER_BYTES or header[:4] != _RECORD_MAGIC:
        return None
    _, offset, first, stream, num_samples, length, crc = _HEADER.unpack_from(header)
    holds = google_crc32c.value(header[: _HEADER.size]) == _CRC.unpack_from(header, _HEADER.size)[0]
    if not holds or offset != place or place + HEADER_BYTES + length > len(data):
        return None
    return offset, first, stream, num_samples, length, crc, 0


class SpoolLogWriter:
    """Appends records to a spool's log, each by one write; `end` is its length in bytes.

    It continues after `records`, where the file is truncated. Raises StorageError if it cannot be
    opened.
    """

    def __init__(self, folder: Path, records: LogRecords) -> None:
        self._what, self.end = f"log of spool {folder.name!r}", records.end
        # Of the rows of all records, and of those before the last one, for `undo`.
        self._rows = self._rows_before = hashlib.sha256(records.rows.tobytes())
        self._file = -1
        with disk_errors(f"open {self._what}"):
            self._file = os.open(folder / LOG_FILE, os.O_RDWR)
            self._cut(self.end)

    def append(self, batch: EncodedBatch, *, stream: int, first_sample: int) -> int:
        """Append a batch atomically and return its offset, for `undo`.

        Raises StorageFullError without space; the file is unchanged.
        """
        place, length = self.end, len(batch.body)
        counts = (first_sample, stream, batch.num_samples, length, batch.body_crc32c)
        header = _HEADER.pack(_RECORD_MAGIC, place, *counts)
        parts = (header, _CRC.pack(google_crc32c.value(header)), batch.body)
        try:
            with disk_errors(
                self._what, advice="what was recorded stays, free space and try again"
            ):
                write_parts(self._file, *parts)
        except StorageError:
            # Truncating needs no space, so acknowledged records stay readable.
            self._cut(place)
            raise
        self.end = place + HEADER_BYTES + length
        self._rows_before = self._rows.copy()
        row = (place, first_sample, stream, batch.num_samples, length, batch.body_crc32c)
        self._rows.update(_ROW.pack(*row, 0))
        return place

    @property
    def records_sha256(self) -> str:
        """The sha256 of the rows of all records (`RECORD_ROW`), which hold their checksums."""
        return self._rows.hexdigest()

    def undo(self, place: int) -> None:
        """Remove the last record, at the given offset."""
        with disk_errors(f"cut {self._what}"):
            self._cut(place)
        self.end, self._rows = place, self._rows_before

    def sync(self) -> None:
        """Sync all appended records to disk."""
        with disk_errors(f"sync {self._what}"):
            os.fdatasync(self._file)

    def close(self) -> None:
        """Close the file."""
        if self._file >= 0:
            os.close(self._file)
            self._file = -1

    def _cut(self, size: int) -> None:
        os.ftruncate(self._file, size)
        os.lseek(self._file, size, os.SEEK_SET)


def trusted_records(folder: Path, records: LogRecords) -> LogRecords:
    """The records of a log without those at its end whose body never reached the disk."""
    num_rows = len(records.rows)
    with open_log(folder) as data:
        while num_rows and body_at(data, records.rows[num_rows - 1]) is None:
            num_rows -= 1
    return replace(records, rows=records.rows[:num_rows])


class Seal(FrozenModel):
    """What a spool had when it was closed: samples by stream, its log, attributes.

    `records_sha256` is of the rows of the log's records (`RECORD_ROW`), each with the checksum of
    its body: it tells the log from another one that is as long.
    """

    format_version: Literal[1] = 1
    num_samples: dict[str, int]
    log_bytes: int = Field(ge=0)
    records_sha256: str
    recording_sha256: str


def has_checksum(text: bytes) -> bool:
    """Whether a `recording.json` has its sha256, which earlier releases did not write."""
    return _CHECKSUM.search(text) is not None


def encode_attributes(attributes: RecordingAttributes) -> bytes:
    """The bytes of `recording.json`: the attributes, and the sha256 of their JSON."""
    text = attributes.model_dump_json().encode()
    return text[:-1] + f',"sha256":"{sha256_hex(text)}"}}'.encode()


def decode_attributes(text: bytes, *, what: str) -> RecordingAttributes:
    """Inverse of `encode_attributes`; files of earlier releases have no checksum.

    Raises CorruptDataError for damaged bytes.
    """
    found = _CHECKSUM.search(text)
    if found is not None:
        text = text[: found.start()] + b"}"
        if sha256_hex(text).encode() != found[1]:
            raise CorruptDataError(
                f"{what}: {RECORDING_FILE} does not match its sha256; restore it from a copy"
            )
    try:
        return RecordingAttributes.model_validate_json(text)
    except ValidationError as error:
        raise CorruptDataError(f"{what}: {RECORDING_FILE}: {error}") from error


def read_recording_file(path: Path) -> bytes:
    """The bytes of a spool's `recording.json`.

    Raises NotFoundError without a spool, CorruptDataError if there is its log alone.
    """
    with disk_errors(f"open spool {path.name}"):
        if not (path / RECORDING_FILE).is_file():
            if (path / LOG_FILE).is_file():
                raise CorruptDataError(
                    f"spool {path.name!r}: {RECORDING_FILE} is missing; restore it from a copy, or "
                    "remove the folder"
                )
            raise NotFoundError(f"spool {path.name!r}: there is none in {path.parent}")
        return (path / RECORDING_FILE).read_bytes()


def read_seal(path: Path) -> Seal | None:
    """The seal of a closed spool; None for an empty file, which earlier releases wrote.

    Raises FileNotFoundError if the spool is not closed, CorruptDataError if the seal is damaged.
    """
    text = (path / CLOSED_FILE).read_bytes()
    try:
        return Seal.model_validate_json(text) if text else None
    except ValidationError as error:
        raise CorruptDataError(
            f"spool {path.name!r}: the file {CLOSED_FILE!r} is damaged ({first_problems(error)}); "
            "restore it from a copy, or remove it: then the take is recovered as an interrupted one"
        ) from error
