"""Crash recovery of a spool: truncation to its last valid record."""

import fcntl
import os
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from dextouch.episodes.spool_log import LOG_FILE, SpoolLogWriter, body_at, open_log, read_records
from dextouch.episodes.spool_reader import read_attributes
from dextouch.errors import ConflictError


@dataclass(frozen=True)
class RecoveryReport:
    """Result of a recovery: samples by stream, and the number of bytes dropped."""

    num_samples: dict[str, int]
    dropped_bytes: int


def recover(path: Path) -> RecoveryReport:
    """Truncate a spool to its last valid record after a crash.

    Everything that `append` acknowledged is kept. The operation is idempotent.

    Raises:
        NotFoundError: no spool there.
        ConflictError: it is being written.
        CorruptDataError: damage other than a torn tail; nothing is changed.
    """
    attributes = read_attributes(path)
    lock = lock_spool(path)
    try:
        if not (path / LOG_FILE).exists():
            # The process died before it created the log.
            SpoolLogWriter(path).close()
        records = read_records(path)
        rows = records.rows[: _num_trusted(path, records.rows)]
        kept = (
            records.end
            if len(rows) == len(records.rows)
            else int(records.rows["offset"][len(rows)])
        )
        SpoolLogWriter(path, end=kept).close()
    finally:
        os.close(lock)
    counts = {
        stream.name: int(rows["num_samples"][rows["stream"] == number].sum())
        for number, stream in enumerate(attributes.streams)
    }
    return RecoveryReport(counts, max(0, records.num_bytes - kept))


def _num_trusted(path: Path, rows: np.ndarray) -> int:
    """Number of records after dropping those at the end whose body never reached the disk."""
    num_rows = len(rows)
    with open_log(path) as data:
        while num_rows and body_at(data, rows[num_rows - 1]) is None:
            num_rows -= 1
    return num_rows


def lock_spool(path: Path) -> int:
    """Lock a spool exclusively; the returned descriptor holds the lock until it is closed.

    Raises:
        ConflictError: another process is writing or recovering it.
    """
    descriptor = os.open(path, os.O_RDONLY)
    try:
        fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError as error:
        os.close(descriptor)
        raise ConflictError(f"spool {path.name!r}: another process is writing it") from error
    return descriptor
