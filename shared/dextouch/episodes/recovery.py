"""A spool that a crash left behind → the same spool cut back to its last good samples."""

import fcntl
import os
from dataclasses import dataclass
from pathlib import Path

from dextouch.episodes.files import disk_errors
from dextouch.episodes.journal import (
    SAMPLE_JOURNAL,
    JournalWriter,
    journal_path,
    part_path,
    read_payloads,
    read_rows,
)
from dextouch.episodes.spool_reader import read_attributes
from dextouch.errors import ConflictError, CorruptDataError


@dataclass(frozen=True)
class RecoveryReport:
    """What was found in one stream of a spool, and what had to go."""

    stream: str
    num_samples: int
    dropped_journal_bytes: int
    dropped_part_bytes: int


def recover(path: Path) -> list[RecoveryReport]:
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
        return [
            _recover_stream(path, name) for name in [stream.name for stream in attributes.streams]
        ]
    finally:
        os.close(lock)


def _recover_stream(path: Path, name: str) -> RecoveryReport:
    part, journal = part_path(path, name), journal_path(path, name)
    with disk_errors(f"recover {name}"):
        part.touch()
        journal.touch()
        before = part.stat().st_size, journal.stat().st_size
    num_rows = _num_trusted_rows(path, name)
    JournalWriter(path, name, SAMPLE_JOURNAL, num_rows=num_rows).close()
    after = part.stat().st_size, journal.stat().st_size
    return RecoveryReport(name, num_rows, max(0, before[1] - after[1]), before[0] - after[0])


def _num_trusted_rows(path: Path, name: str) -> int:
    """Rows left when those at the end are dropped whose payload never reached the disk."""
    rows = read_rows(path, name, SAMPLE_JOURNAL)
    num_rows = len(rows)
    while num_rows:
        try:
            read_payloads(path, name, rows[num_rows - 1 : num_rows])
        except CorruptDataError:
            num_rows -= 1
        else:
            break
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
