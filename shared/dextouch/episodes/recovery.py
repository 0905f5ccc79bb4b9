"""A spool that a crash left behind → the same spool cut back to its last good samples."""

import fcntl
import os
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from dextouch.episodes.spool_log import LOG_FILE, BatchLogWriter, body_at, open_log, read_records
from dextouch.episodes.spool_reader import read_attributes
from dextouch.errors import ConflictError


@dataclass(frozen=True)
class RecoveryReport:
    """What is left of a spool: samples by stream, and how many bytes had to go."""

    num_samples: dict[str, int]
    dropped_bytes: int


def recover(path: Path) -> RecoveryReport:
    """Cut a spool back to its last good samples after a crash, and say how much went.

    Everything that `append` had acknowledged stays. Calling it again changes nothing.

    Raises:
        NotFoundError: no spool there.
        ConflictError: it is being written.
        CorruptDataError: damage that is no torn end; nothing is changed.
    """
    attributes = read_attributes(path)
    lock = lock_spool(path)
    try:
        if not (path / LOG_FILE).exists():
            # The process died before it had made the log.
            BatchLogWriter(path).close()
        records = read_records(path)
        rows = records.rows[: _num_trusted(path, records.rows)]
        kept = (
            records.end
            if len(rows) == len(records.rows)
            else int(records.rows["offset"][len(rows)])
        )
        BatchLogWriter(path, end=kept).close()
    finally:
        os.close(lock)
    counts = {
        stream.name: int(rows["num_samples"][rows["stream"] == number].sum())
        for number, stream in enumerate(attributes.streams)
    }
    return RecoveryReport(counts, max(0, records.num_bytes - kept))


def _num_trusted(path: Path, rows: np.ndarray) -> int:
    """Records left when those at the end are dropped whose body never reached the disk."""
    num_rows = len(rows)
    with open_log(path) as data:
        while num_rows and body_at(data, rows[num_rows - 1]) is None:
            num_rows -= 1
    return num_rows


def lock_spool(path: Path) -> int:
    """A descriptor that keeps every other writer out until it is closed.

    Raises:
        ConflictError: a writer or a recovery is at work.
    """
    descriptor = os.open(path, os.O_RDONLY)
    try:
        fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError as error:
        os.close(descriptor)
        raise ConflictError(f"spool {path.name!r}: another process is writing it") from error
    return descriptor
