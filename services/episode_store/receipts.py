"""Batches that the store has acknowledged ↔ one small file a stream, a fixed row a batch."""

import hashlib
import os
from dataclasses import dataclass
from pathlib import Path

import google_crc32c

from dextouch.episodes.files import disk_errors, write_all
from dextouch.errors import CorruptDataError

# sha256 of the batch's bytes (32), end sample (u64), crc32c of both (u32), little endian.
_BODY_BYTES = 40
ROW_BYTES = _BODY_BYTES + 4


@dataclass(frozen=True)
class Receipt:
    """One acknowledged batch: the digest of its bytes, and how many samples there are after it."""

    sha256: bytes
    end_sample: int


class Receipts:
    """The receipts of one stream, in memory and in a file; row n belongs to batch n.

    Args:
        path: of the file, which need not exist. A torn last row is forgotten: its batch was never
            acknowledged.

    Raises:
        CorruptDataError: a row before the last does not hold.
    """

    def __init__(self, path: Path) -> None:
        self._path = path
        with disk_errors(f"read {path.name}"):
            data = path.read_bytes() if path.exists() else b""
        self._receipts: list[Receipt] = []
        self._descriptor = -1
        size = ROW_BYTES
        for start in range(0, len(data) - size + 1, size):
            row = data[start : start + size]
            if google_crc32c.value(row[:_BODY_BYTES]).to_bytes(4, "little") != row[_BODY_BYTES:]:
                if start + 2 * size > len(data):
                    break
                raise CorruptDataError(f"{path.name}: receipt {start // size} does not hold")
            end_sample = int.from_bytes(row[32:40], "little")
            self._receipts.append(Receipt(row[:32], end_sample))

    def __len__(self) -> int:
        return len(self._receipts)

    def __getitem__(self, number: int) -> Receipt:
        return self._receipts[number]

    @property
    def num_samples(self) -> int:
        """Samples in all acknowledged batches."""
        return self._receipts[-1].end_sample if self._receipts else 0

    def append(self, data: bytes, *, end_sample: int, sync: bool) -> None:
        """Acknowledge the next batch.

        Raises:
            StorageFullError: no space; the batch is not acknowledged.
        """
        receipt = Receipt(hashlib.sha256(data).digest(), end_sample)
        body = receipt.sha256 + end_sample.to_bytes(8, "little")
        row = body + google_crc32c.value(body).to_bytes(4, "little")
        with disk_errors(f"acknowledge in {self._path.name}"):
            if self._descriptor < 0:
                self._descriptor = os.open(self._path, os.O_WRONLY | os.O_CREAT, 0o644)
            # At its own place: what a failed attempt left there is written over.
            os.lseek(self._descriptor, len(self._receipts) * ROW_BYTES, os.SEEK_SET)
            write_all(self._descriptor, row)
            if sync:
                os.fdatasync(self._descriptor)
        self._receipts.append(receipt)

    def close(self) -> None:
        """Give the file back."""
        if self._descriptor >= 0:
            os.close(self._descriptor)
            self._descriptor = -1
