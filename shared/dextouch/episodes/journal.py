"""Payloads ↔ a `part` file and a `journal` whose fixed rows vouch for them: the one log.

A payload is there when its row is there: the payload is written first, then the row, each with a
crc32c. Rows have one length, so a torn tail is found from the file's size alone. The station's
spool keeps samples this way, an episode that is being written its storage chunks.
"""

import os
import struct
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

import google_crc32c
import numpy as np

from dextouch.episodes.files import disk_errors, write_all
from dextouch.errors import CorruptDataError, StorageError

_CRC = struct.Struct("<I")


@dataclass(frozen=True)
class JournalLayout:
    """What a journal says about each payload besides where it lies.

    A row is offset u64, then these numbers, then length u32, payload crc32c u32 and the crc32c of
    all that as u32; little endian.
    """

    magic: bytes
    numbers: tuple[tuple[str, str], ...]

    @cached_property
    def dtype(self) -> np.dtype[np.void]:
        """A row as numpy reads it."""
        crcs = [("payload_crc32c", "<u4"), ("row_crc32c", "<u4")]
        return np.dtype([("offset", "<u8"), *self.numbers, ("length", "<u4"), *crcs])

    @cached_property
    def body(self) -> struct.Struct:
        """A row without its own crc32c, as struct packs it: much faster than numpy for one row."""
        codes = {"<i8": "q", "<u4": "I"}
        return struct.Struct("<Q" + "".join(codes[kind] for _, kind in self.numbers) + "II")


SAMPLE_JOURNAL = JournalLayout(
    b"DXTJRNL\x01", (("t_host_ns", "<i8"), ("t_device_ns", "<i8"), ("sequence", "<i8"))
)
CHUNK_JOURNAL = JournalLayout(b"DXTJRNL\x02", (("num_rows", "<u4"),))


def part_path(folder: Path, name: str) -> Path:
    """The file of a log's payloads."""
    return folder / f"{name}.part"


def journal_path(folder: Path, name: str) -> Path:
    """The file of a log's rows."""
    return folder / f"{name}.journal"


def read_rows(folder: Path, name: str, layout: JournalLayout) -> np.ndarray:
    """All good rows of a journal, whose payloads are wholly in the part file.

    Rows that are not whole at the end are left out: that is what a crash leaves. A bad row before
    a good one is damage, and refused.

    Raises:
        CorruptDataError: damage in the middle, or no journal of this layout.
    """
    with disk_errors(f"read journal of {name}"):
        data = journal_path(folder, name).read_bytes()
        part_bytes = part_path(folder, name).stat().st_size
    size = len(layout.magic)
    if len(data) < size:
        return np.empty(0, dtype=layout.dtype)
    if data[:size] != layout.magic:
        raise CorruptDataError(
            f"journal of {name!r}: begins with {data[:size]!r}, expected {layout.magic!r}"
        )
    num_rows = (len(data) - size) // layout.dtype.itemsize
    rows = np.frombuffer(data, dtype=layout.dtype, count=num_rows, offset=size)
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
        layout: of its rows.
        num_rows: None for new files, else how many rows to keep and go on after.

    Raises:
        StorageError: the files exist already, or cannot be made.
    """

    def __init__(
        self, folder: Path, name: str, layout: JournalLayout, *, num_rows: int | None = None
    ) -> None:
        self.name, self._layout, self._folder = name, layout, folder
        self._part = self._journal = -1
        self.num_rows = 0
        self._part_bytes = 0
        flags = os.O_RDWR | os.O_CREAT | (os.O_EXCL if num_rows is None else 0)
        with disk_errors(f"open log {name}"):
            self._part = os.open(part_path(folder, name), flags, 0o644)
            self._journal = os.open(journal_path(folder, name), flags, 0o644)
            if os.fstat(self._journal).st_size < len(layout.magic):
                os.ftruncate(self._journal, 0)
                os.pwrite(self._journal, layout.magic, 0)
                os.lseek(self._journal, len(layout.magic), os.SEEK_SET)
            if num_rows is not None:
                self.truncate(num_rows)

    def append(self, payloads: Sequence[bytes], numbers: Sequence[Sequence[int]]) -> None:
        """Append payloads, all or none.

        Args:
            payloads: the bytes.
            numbers: of each payload, in the layout's order.

        Raises:
            StorageFullError: no space; the files are as they were before this call.
        """
        pack, offset, rows = self._layout.body.pack, self._part_bytes, []
        for payload, values in zip(payloads, numbers, strict=True):
            body = pack(offset, *values, len(payload), google_crc32c.value(payload))
            rows.append(body + _CRC.pack(google_crc32c.value(body)))
            offset += len(payload)
        try:
            with disk_errors(f"log {self.name}"):
                write_all(self._part, payloads[0] if len(payloads) == 1 else b"".join(payloads))
                write_all(self._journal, b"".join(rows))
        except StorageError:
            # Cutting off needs no space: what was acknowledged before stays readable.
            self._cut()
            raise
        self.num_rows += len(rows)
        self._part_bytes = offset

    def sync(self) -> None:
        """Make everything appended survive a power loss: payloads first, then rows."""
        with disk_errors(f"sync log {self.name}"):
            os.fdatasync(self._part)
            os.fdatasync(self._journal)

    def truncate(self, num_rows: int) -> np.ndarray:
        """Keep the first rows, drop what follows; the kept rows come back.

        Raises:
            StorageError: fewer rows than that exist.
        """
        rows = read_rows(self._folder, self.name, self._layout)
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
        """Put bytes behind the last payload that belong to no row; nothing is appended after."""
        with disk_errors(f"close log {self.name}"):
            write_all(self._part, data)

    def close(self) -> None:
        """Give the files back."""
        for descriptor in (self._part, self._journal):
            if descriptor >= 0:
                os.close(descriptor)
        self._part = self._journal = -1

    def _cut(self) -> None:
        for descriptor, size in (
            (self._part, self._part_bytes),
            (self._journal, len(self._layout.magic) + self.num_rows * self._layout.dtype.itemsize),
        ):
            os.ftruncate(descriptor, size)
            os.lseek(descriptor, size, os.SEEK_SET)
