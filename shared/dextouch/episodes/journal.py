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


def log_paths(folder: Path, name: str) -> tuple[Path, Path]:
    """Paths of both files of a log."""
    return part_path(folder, name), journal_path(folder, name)


def forget_journal(folder: Path, name: str) -> None:
    """Remove the journal of an array whose group is about to be committed."""
    with disk_errors(f"commit array {name}"):
        journal_path(folder, name).unlink(missing_ok=True)


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
    ends = rows["offset"] + rows["length"]
    follows = rows["offset"] == np.concatenate([np.zeros(1, dtype="<u8"), ends])[: len(rows)]
    crcs_hold = _row_crcs(rows) == rows["row_crc32c"]
    return np.asarray(crcs_hold & follows & (ends <= part_bytes), dtype=bool)


def _row_crcs(rows: np.ndarray) -> np.ndarray:
    bodies = (row[: -_CRC.size] for row in rows.view(f"V{rows.itemsize}").tolist())
    return np.fromiter(map(google_crc32c.value, bodies), dtype=np.uint32, count=len(rows))


def scan_rows(folder: Path, name: str, part: Path) -> tuple[np.ndarray, np.ndarray]:
    """All rows of a journal, damaged ones too, and whether each and its payload are intact.

    `part` is the part file, or the shard that it has become.
    """
    path = journal_path(folder, name)
    with disk_errors(f"read {path.name}"):
        data = path.read_bytes()[len(JOURNAL_MAGIC) :] if path.is_file() else b""
    rows = np.frombuffer(data, JOURNAL_ROW, count=len(data) // JOURNAL_ROW.itemsize)
    hold = np.zeros(len(rows), dtype=bool)
    with disk_errors(f"read {part.name}"):
        num_bytes = part.stat().st_size if part.is_file() else 0
        inside = (rows["offset"] <= num_bytes) & (rows["offset"] + rows["length"] <= num_bytes)
        for number in np.flatnonzero(inside & (_row_crcs(rows) == rows["row_crc32c"])):
            crc = google_crc32c.value(_payload_at(part, rows[number]))
            hold[number] = crc == int(rows["payload_crc32c"][number])
    return rows, hold


def read_payload(folder: Path, name: str, row: np.void) -> bytes:
    """Read the payload of a row and verify its checksum.

    Raises:
        CorruptDataError: it does not match its checksum.
    """
    with disk_errors(f"read {name}"):
        payload = _payload_at(part_path(folder, name), row)
    if google_crc32c.value(payload) != int(row["payload_crc32c"]):
        raise CorruptDataError(damaged_payload(name, row))
    return payload


def _payload_at(part: Path, row: np.void) -> bytes:
    with part.open("rb") as file:
        file.seek(int(row["offset"]))
        return file.read(int(row["length"]))


def damaged_payload(name: str, row: np.void) -> str:
    """Message about a payload that does not match its checksum."""
    return (
        f"stream {name!r}: payload at byte {int(row['offset'])} does not match its "
        "checksum; the part file is damaged"
    )


class JournalWriter:
    """Appends payloads to a log's two files; each append is two writes.

    `num_rows` is None for new files, otherwise the number of rows to keep and append to.

    Raises:
        StorageError: the files exist already, or cannot be created.
    """

    def __init__(self, folder: Path, name: str, *, num_rows: int | None = None) -> None:
        self.name, self._folder = name, folder
        self._part = self._journal = -1
        # Offset and length of each payload.
        self.index: list[tuple[int, int]] = []
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
        place = self._part_bytes()
        body = _BODY.pack(place, num_rows, len(payload), crc)
        try:
            with disk_errors(f"log {self.name}", advice="free space on the disk of the store"):
                write_all(self._part, payload)
                write_all(self._journal, body + _CRC.pack(google_crc32c.value(body)))
        except BaseException:
            # Truncating needs no space, so acknowledged data stays readable. Without it, an
            # interrupt between the two writes would misplace the next payload.
            self._cut()
            raise
        self.index.append((place, len(payload)))

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
        self.index = list(zip(rows["offset"].tolist(), rows["length"].tolist(), strict=True))
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

    def _part_bytes(self) -> int:
        return sum(self.index[-1]) if self.index else 0

    def _cut(self) -> None:
        for descriptor, size in (
            (self._part, self._part_bytes()),
            (self._journal, len(JOURNAL_MAGIC) + len(self.index) * JOURNAL_ROW.itemsize),
        ):
            os.ftruncate(descriptor, size)
            os.lseek(descriptor, size, os.SEEK_SET)
