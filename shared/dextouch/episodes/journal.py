"""Append-only log of storage chunks: a `part` file of payloads and a `journal` of checksummed rows.

A payload counts once its row exists: the payload is written first, then the row, each with a
crc32c. Rows have one length, so a torn tail is found from the file's size alone. The rows have a
separate file because the part file becomes the shard unchanged.
"""

import os
import struct
from pathlib import Path

import google_crc32c
import numpy as np

from dextouch.episodes.files import disk_errors, write_all
from dextouch.errors import CorruptDataError, StorageError

_CRC = struct.Struct("<I")


JOURNAL_MAGIC = b"DXTJRNL\x02"
_BODY = struct.Struct("<QIII")
JOURNAL_ROW = np.dtype(
    [
        ("offset", "<u8"),
        ("num_rows", "<u4"),
        ("length", "<u4"),
        ("payload_crc32c", "<u4"),
        ("row_crc32c", "<u4"),
    ]
)


def part_path(folder: Path, name: str) -> Path:
    """Path of a log's payload file."""
    return folder / f"{name}.part"


def journal_path(folder: Path, name: str) -> Path:
    """Path of a log's journal."""
    return folder / f"{name}.journal"


def read_rows(folder: Path, name: str) -> np.ndarray:
    """All valid rows of a journal whose payloads are complete in the part file.

    An incomplete tail, which is what a crash leaves, is ignored. An invalid row before a valid one
    is damage, and refused.

    Raises:
        CorruptDataError: damage in the middle, or a missing journal.
    """
    with disk_errors(f"read journal of {name}"):
        data = journal_path(folder, name).read_bytes()
        part_bytes = part_path(folder, name).stat().st_size
    size = len(JOURNAL_MAGIC)
    if len(data) < size:
        return np.empty(0, dtype=JOURNAL_ROW)
    if data[:size] != JOURNAL_MAGIC:
        raise CorruptDataError(
            f"journal of {name!r}: begins with {data[:size]!r}, expected {JOURNAL_MAGIC!r}"
        )
    num_rows = (len(data) - size) // JOURNAL_ROW.itemsize
    rows = np.frombuffer(data, dtype=JOURNAL_ROW, count=num_rows, offset=size)
    good = _rows_hold(rows, part_bytes)
    num_good = int(np.flatnonzero(good)[-1]) + 1 if good.any() else 0
    if not good[:num_good].all():
        bad = int(np.flatnonzero(~good[:num_good])[0])
        raise CorruptDataError(
            f"journal of {name!r}: row {bad} of {num_good} is invalid, but later ones are valid; "
            "this is damage, not a torn tail: restore the file from a copy"
        )
    return rows[:num_good]


def _rows_hold(rows: np.ndarray, part_bytes: int) -> np.ndarray:
    data, size = rows.tobytes(), rows.dtype.itemsize
    crcs = np.array(
        [
            google_crc32c.value(data[i * size : (i + 1) * size - _CRC.size])
            for i in range(len(rows))
        ],
        dtype=np.uint32,
    )
    ends = rows["offset"] + rows["length"]
    follows = rows["offset"] == np.concatenate([np.zeros(1, dtype="<u8"), ends])[: len(rows)]
    return np.asarray((crcs == rows["row_crc32c"]) & follows & (ends <= part_bytes), dtype=bool)


def read_payloads(folder: Path, name: str, rows: np.ndarray) -> list[bytes]:
    """Read the payloads of consecutive rows and verify their checksums.

    Raises:
        CorruptDataError: a payload does not match its checksum.
    """
    if not len(rows):
        return []
    first = int(rows["offset"][0])
    length = int(rows["offset"][-1]) + int(rows["length"][-1]) - first
    with disk_errors(f"read {name}"), part_path(folder, name).open("rb") as file:
        file.seek(first)
        data = file.read(length)
    payloads = []
    for row in rows:
        start = int(row["offset"]) - first
        payload = data[start : start + int(row["length"])]
        if google_crc32c.value(payload) != int(row["payload_crc32c"]):
            raise CorruptDataError(
                f"stream {name!r}: payload at byte {int(row['offset'])} does not match its "
                "checksum; the part file is damaged"
            )
        payloads.append(payload)
    return payloads


class JournalWriter:
    """Appends payloads to a log's two files; each append is two writes.

    Args:
        folder: of the log.
        name: of the log.
        num_rows: None for new files; otherwise the number of rows to keep and append to.

    Raises:
        StorageError: the files exist already, or cannot be created.
    """

    def __init__(self, folder: Path, name: str, *, num_rows: int | None = None) -> None:
        self.name, self._folder = name, folder
        self._part = self._journal = -1
        self.num_rows = 0
        self._part_bytes = 0
        flags = os.O_RDWR | os.O_CREAT | (os.O_EXCL if num_rows is None else 0)
        with disk_errors(f"open log {name}"):
            self._part = os.open(part_path(folder, name), flags, 0o644)
            self._journal = os.open(journal_path(folder, name), flags, 0o644)
            if os.fstat(self._journal).st_size < len(JOURNAL_MAGIC):
                os.ftruncate(self._journal, 0)
                os.pwrite(self._journal, JOURNAL_MAGIC, 0)
                os.lseek(self._journal, len(JOURNAL_MAGIC), os.SEEK_SET)
            if num_rows is not None:
                self.truncate(num_rows)

    def append(self, payload: bytes, num_rows: int) -> None:
        """Append a storage chunk of `num_rows` rows of the array, atomically.

        Raises:
            StorageFullError: no space; the files are unchanged.
        """
        crc = google_crc32c.value(payload)
        body = _BODY.pack(self._part_bytes, num_rows, len(payload), crc)
        try:
            with disk_errors(f"log {self.name}", advice="free space on the disk of the store"):
                write_all(self._part, payload)
                write_all(self._journal, body + _CRC.pack(google_crc32c.value(body)))
        except BaseException:
            # Truncating needs no space, so acknowledged data stays readable. Without it, an
            # interrupt between the two writes would misplace the next payload.
            self._cut()
            raise
        self.num_rows += 1
        self._part_bytes += len(payload)

    def sync(self) -> None:
        """Sync everything appended to disk: payloads first, then rows."""
        with disk_errors(f"sync log {self.name}"):
            os.fdatasync(self._part)
            os.fdatasync(self._journal)

    def truncate(self, num_rows: int) -> np.ndarray:
        """Keep the first `num_rows` rows, drop the rest, and return the kept rows.

        Raises:
            StorageError: fewer rows exist.
        """
        rows = read_rows(self._folder, self.name)
        if num_rows > len(rows):
            raise StorageError(
                f"stream {self.name!r}: got {len(rows)} rows, expected at least {num_rows}"
            )
        rows = rows[:num_rows]
        self.num_rows = num_rows
        self._part_bytes = int(rows["offset"][-1]) + int(rows["length"][-1]) if num_rows else 0
        with disk_errors(f"truncate log {self.name}"):
            self._cut()
        return rows

    def write_tail(self, data: bytes) -> None:
        """Write a trailer after the last payload; nothing may be appended afterwards."""
        with disk_errors(f"close log {self.name}"):
            write_all(self._part, data)

    def close(self) -> None:
        """Close the files."""
        # Forgotten before it is closed: after an interrupt between the two the number may already
        # be that of another file.
        for field in ("_part", "_journal"):
            descriptor: int = getattr(self, field)
            setattr(self, field, -1)
            if descriptor >= 0:
                os.close(descriptor)

    def _cut(self) -> None:
        for descriptor, size in (
            (self._part, self._part_bytes),
            (self._journal, len(JOURNAL_MAGIC) + self.num_rows * JOURNAL_ROW.itemsize),
        ):
            os.ftruncate(descriptor, size)
            os.lseek(descriptor, size, os.SEEK_SET)
