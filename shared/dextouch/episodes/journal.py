"""Payloads of one stream ↔ a `part` file and a `journal` whose fixed rows vouch for them.

A sample is there when its row is there: the payload is written first, then the row, each with a
crc32c. Rows have one length, so a torn tail is found from the file's size alone.
"""

import os
from collections.abc import Sequence
from pathlib import Path

import google_crc32c
import numpy as np

from dextouch.episodes.files import disk_errors, write_all
from dextouch.errors import CorruptDataError, StorageError

MAGIC = b"DXTJRNL\x01"
ROW = np.dtype(
    [
        ("offset", "<u8"),
        ("t_host_ns", "<i8"),
        ("t_device_ns", "<i8"),
        ("sequence", "<i8"),
        ("length", "<u4"),
        ("payload_crc32c", "<u4"),
        ("row_crc32c", "<u4"),
    ]
)
_ROW_BODY_BYTES = ROW.itemsize - 4


def part_path(folder: Path, name: str) -> Path:
    """The file of a stream's payloads."""
    return folder / f"{name}.part"


def journal_path(folder: Path, name: str) -> Path:
    """The file of a stream's rows."""
    return folder / f"{name}.journal"


def read_rows(folder: Path, name: str) -> np.ndarray:
    """All good rows of a journal, whose payloads are wholly in the part file.

    Rows that are not whole at the end are left out: that is what a crash leaves. A bad row before
    a good one is damage, and refused.

    Raises:
        CorruptDataError: damage in the middle, or no journal of this version.
    """
    with disk_errors(f"read journal of {name}"):
        data = journal_path(folder, name).read_bytes()
        part_bytes = part_path(folder, name).stat().st_size
    if len(data) < len(MAGIC):
        return np.empty(0, dtype=ROW)
    if data[: len(MAGIC)] != MAGIC:
        raise CorruptDataError(f"journal of {name!r}: got {data[:8]!r}, expected {MAGIC!r}")
    num_rows = (len(data) - len(MAGIC)) // ROW.itemsize
    rows = np.frombuffer(data, dtype=ROW, count=num_rows, offset=len(MAGIC))
    good = _rows_hold(rows, part_bytes)
    num_good = int(np.flatnonzero(good)[-1]) + 1 if good.any() else 0
    if not good[:num_good].all():
        bad = int(np.flatnonzero(~good[:num_good])[0])
        raise CorruptDataError(
            f"journal of {name!r}: row {bad} of {num_good} does not hold, yet later ones do; "
            "this is no torn end but damage, restore the file from a copy"
        )
    return rows[:num_good]


def _rows_hold(rows: np.ndarray, part_bytes: int) -> np.ndarray:
    body = rows.tobytes()
    size = ROW.itemsize
    crcs = np.array(
        [
            google_crc32c.value(body[i * size : i * size + _ROW_BODY_BYTES])
            for i in range(len(rows))
        ],
        dtype=np.uint32,
    )
    ends = rows["offset"] + rows["length"]
    follows = rows["offset"] == np.concatenate([np.zeros(1, dtype="<u8"), ends])[: len(rows)]
    return np.asarray((crcs == rows["row_crc32c"]) & follows & (ends <= part_bytes), dtype=bool)


def read_payloads(folder: Path, name: str, rows: np.ndarray) -> list[bytes]:
    """The payloads of consecutive rows, each checked.

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
                f"spool stream {name!r}: payload at byte {int(row['offset'])} does not match its "
                "checksum; the part file is damaged"
            )
        payloads.append(payload)
    return payloads


class JournalWriter:
    """Appends samples to a stream's two files; each append is two writes.

    Args:
        folder: of the spool.
        name: of the stream.
        num_rows: None for new files, else how many rows to keep and go on after.

    Raises:
        StorageError: the files exist already, or cannot be made.
    """

    def __init__(self, folder: Path, name: str, *, num_rows: int | None = None) -> None:
        self.name = name
        self._folder = folder
        self._part = self._journal = -1
        self.num_rows = 0
        self.last_t_host_ns: int | None = None
        self._part_bytes = 0
        flags = os.O_RDWR | os.O_CREAT | (os.O_EXCL if num_rows is None else 0)
        with disk_errors(f"open spool stream {name}"):
            self._part = os.open(part_path(folder, name), flags, 0o644)
            self._journal = os.open(journal_path(folder, name), flags, 0o644)
            if os.fstat(self._journal).st_size < len(MAGIC):
                os.ftruncate(self._journal, 0)
                os.pwrite(self._journal, MAGIC, 0)
            self.truncate(num_rows or 0)

    def append(self, payloads: Sequence[bytes], stamps: np.ndarray) -> None:
        """Append samples, all or none.

        Args:
            payloads: of each sample.
            stamps: [n, 3] int64: t_host_ns, t_device_ns, sequence.

        Raises:
            StorageFullError: no space; the files are as they were before this call.
        """
        rows = self._make_rows(payloads, stamps)
        try:
            with disk_errors(f"spool stream {self.name}"):
                write_all(self._part, b"".join(payloads))
                write_all(self._journal, rows.tobytes())
        except StorageError:
            # Cutting off needs no space: what was acknowledged before stays readable.
            self._cut()
            raise
        self.num_rows += len(rows)
        self._part_bytes += sum(map(len, payloads))
        if len(rows):
            self.last_t_host_ns = int(rows["t_host_ns"][-1])

    def _make_rows(self, payloads: Sequence[bytes], stamps: np.ndarray) -> np.ndarray:
        rows = np.zeros(len(payloads), dtype=ROW)
        lengths = np.fromiter(map(len, payloads), dtype=np.int64, count=len(payloads))
        rows["offset"] = self._part_bytes + np.concatenate([[0], np.cumsum(lengths)[:-1]])
        rows["t_host_ns"], rows["t_device_ns"], rows["sequence"] = stamps.T
        rows["length"] = lengths
        rows["payload_crc32c"] = [google_crc32c.value(payload) for payload in payloads]
        body, size = rows.tobytes(), ROW.itemsize
        rows["row_crc32c"] = [
            google_crc32c.value(body[i * size : i * size + _ROW_BODY_BYTES])
            for i in range(len(rows))
        ]
        return rows

    def sync(self) -> None:
        """Make everything appended survive a power loss: payloads first, then rows."""
        with disk_errors(f"sync spool stream {self.name}"):
            os.fdatasync(self._part)
            os.fdatasync(self._journal)

    def truncate(self, num_rows: int) -> None:
        """Keep the first rows and drop what follows.

        Raises:
            StorageError: fewer rows than that exist.
        """
        rows = read_rows(self._folder, self.name)
        if num_rows > len(rows):
            raise StorageError(
                f"spool stream {self.name!r}: got {len(rows)} rows, expected at least {num_rows}"
            )
        last = rows[num_rows - 1] if num_rows else None
        self.num_rows = num_rows
        self._part_bytes = 0 if last is None else int(last["offset"]) + int(last["length"])
        self.last_t_host_ns = None if last is None else int(last["t_host_ns"])
        with disk_errors(f"truncate spool stream {self.name}"):
            self._cut()

    def close(self) -> None:
        """Give the files back."""
        for descriptor in (self._part, self._journal):
            if descriptor >= 0:
                os.close(descriptor)
        self._part = self._journal = -1

    def _cut(self) -> None:
        for descriptor, size in (
            (self._part, self._part_bytes),
            (self._journal, len(MAGIC) + self.num_rows * ROW.itemsize),
        ):
            os.ftruncate(descriptor, size)
            os.lseek(descriptor, size, os.SEEK_SET)
