"""Alignment jobs ↔ an append-only file that a kill at any moment leaves readable.

Each line holds one job as it was at one moment, with a checksum; the last line of a job counts. A
line that is not whole at the end is what a crash leaves and is cut off; a bad one before good ones
is damage, and refused.
"""

import fcntl
import json
import os
import threading
from collections.abc import Iterable
from pathlib import Path

import google_crc32c
from pydantic import ValidationError

from dextouch.episodes.files import disk_errors, replace_file, sync_folder, write_all
from dextouch.errors import ConflictError, CorruptDataError
from services.alignment.schemas import ENDED, AlignmentJob

LOG_FILE = "jobs.jsonl"
LOCK_FILE = "lock"
# Lines for each job that the file may hold before it is written anew, and some to begin with.
LINES_A_JOB = 4
MIN_LINES = 1000


class JobLog:
    """The jobs of one service; one process at a time has them.

    Args:
        folder: of the log, made if it is not there.

    Raises:
        ConflictError: another process has it.
        CorruptDataError: damage that is no torn end.
        StorageError: it cannot be read or written.
    """

    def __init__(self, folder: Path) -> None:
        self._path = folder / LOG_FILE
        with disk_errors(f"open the jobs in {folder}"):
            folder.mkdir(parents=True, exist_ok=True)
            self._lock = os.open(folder / LOCK_FILE, os.O_RDWR | os.O_CREAT, 0o644)
            self._take_lock(folder)
        self._file = -1
        self._guard = threading.Lock()
        try:
            self.jobs = self._read()
            self._rewrite(self.jobs.values())
        except BaseException:
            os.close(self._lock)
            raise

    def append(self, jobs: Iterable[AlignmentJob]) -> None:
        """Keep what these jobs are now; it survives a power loss when this returns.

        Raises:
            StorageFullError: no space; what was kept before stays.
        """
        lines = [_line(job) for job in jobs]
        with self._guard, disk_errors("keep alignment jobs"):
            place = os.lseek(self._file, 0, os.SEEK_END)
            try:
                write_all(self._file, b"".join(lines))
                os.fdatasync(self._file)
            except OSError:
                # Cutting off needs no space: half a line must not stand before whole ones.
                os.ftruncate(self._file, place)
                raise
            self._num_lines += len(lines)

    def shorten(self, jobs: Iterable[AlignmentJob]) -> None:
        """Write the file anew with these jobs only, if it has become long."""
        kept = list(jobs)
        with self._guard:
            if self._num_lines > max(MIN_LINES, LINES_A_JOB * len(kept)):
                self._rewrite(kept)

    def close(self) -> None:
        """Give files and lock back."""
        for descriptor in (self._file, self._lock):
            if descriptor >= 0:
                os.close(descriptor)
        self._file = self._lock = -1

    def _take_lock(self, folder: Path) -> None:
        try:
            fcntl.flock(self._lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError as error:
            os.close(self._lock)
            raise ConflictError(
                f"alignment jobs in {folder}: another alignment service has them; end it, or give "
                "this one a --jobs_folder of its own"
            ) from error

    def _read(self) -> dict[str, AlignmentJob]:
        """Jobs by id in the order in which they were asked for."""
        with disk_errors(f"read {self._path}"):
            data = self._path.read_bytes() if self._path.is_file() else b""
        *lines, _torn = data.split(b"\n")
        jobs: dict[str, AlignmentJob] = {}
        for number, line in enumerate(lines, start=1):
            job = _job(line, f"{self._path}, line {number} of {len(lines)}")
            known = jobs.get(job.alignment_id)
            if known is not None and known.state in ENDED:
                # Asked for again: it stands behind those that were asked for since.
                del jobs[job.alignment_id]
            jobs[job.alignment_id] = job
        return jobs

    def _rewrite(self, jobs: Iterable[AlignmentJob]) -> None:
        lines = [_line(job) for job in jobs]
        with disk_errors(f"write {self._path}"):
            replace_file(self._path, b"".join(lines))
            if self._file >= 0:
                os.close(self._file)
            self._file = os.open(self._path, os.O_RDWR | os.O_APPEND)
            sync_folder(self._path.parent)
        self._num_lines = len(lines)


def _line(job: AlignmentJob) -> bytes:
    body = job.model_dump_json(exclude_none=True)
    crc = google_crc32c.value(body.encode())
    return f'{{"crc32c":{crc},"job":{body}}}\n'.encode()


def _job(line: bytes, where: str) -> AlignmentJob:
    try:
        found = json.loads(line)
        body = line[line.index(b'"job":') + 6 : -1]
        whole = google_crc32c.value(body) == found["crc32c"]
    except (ValueError, KeyError, TypeError, RecursionError):
        whole = False
    if not whole:
        raise CorruptDataError(
            f"{where}: the line does not match its checksum; this is no torn end but damage. "
            "Episodes are not touched by it: move the file away and ask for the alignments again"
        )
    try:
        return AlignmentJob.model_validate_json(body)
    except ValidationError as error:
        raise CorruptDataError(
            f"{where}: is no job of this version ({error.error_count()} fields do not fit); move "
            "the file away and ask for the alignments again"
        ) from error
