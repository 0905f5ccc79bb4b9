"""Alignment jobs of a service, whose steps are committed to SQLite before anyone hears of them."""

import asyncio
import sqlite3
import threading
from collections.abc import Callable, Collection, Iterable, Iterator, Sequence
from contextlib import contextmanager
from datetime import UTC, datetime
from pathlib import Path

import google_crc32c
import structlog
from pydantic import ValidationError

from dextouch.episodes import disk_errors
from dextouch.errors import (
    ConflictError,
    CorruptDataError,
    LimitExceededError,
    NotFoundError,
    StorageError,
    StorageFullError,
    UnavailableError,
)
from services.alignment.schemas import ENDED, AlignmentJob, AlignmentList, JobState
from services.alignment.synchronization import Progress

logger = structlog.get_logger(__name__)

DATABASE_FILE = "jobs.sqlite3"
SCHEMA_VERSION = 1
SCHEMA = """
CREATE TABLE jobs (
    position INTEGER PRIMARY KEY AUTOINCREMENT,
    alignment_id TEXT NOT NULL UNIQUE,
    crc32c INTEGER NOT NULL,
    job TEXT NOT NULL
) STRICT
"""
UPSERT = """
INSERT INTO jobs (alignment_id, crc32c, job) VALUES (?, ?, ?)
ON CONFLICT (alignment_id) DO UPDATE SET crc32c = excluded.crc32c, job = excluded.job
"""
DAMAGED = (sqlite3.SQLITE_CORRUPT, sqlite3.SQLITE_NOTADB)
MOVE_AWAY = (
    f"episodes are not affected: move the file away, with {DATABASE_FILE}-wal if there is one, and "
    "ask for the alignments that are missing"
)
RETRY_AFTER_S = 5


class JobQueue:
    """All jobs of one service in the order of submission; belongs to one event loop.

    Change jobs only while holding `lock`; a change that cannot be saved raises `StorageError` and
    leaves them as they were. `max_open` jobs may wait or run; of more than `max_kept` the oldest
    ended ones are forgotten. `problem` is why the jobs could not be opened: none are listed or
    accepted then.
    """

    def __init__(self, *, max_open: int, max_kept: int) -> None:
        self.lock = asyncio.Lock()
        self.max_open, self._max_kept = max_open, max_kept
        self.problem: str | None = None
        self._jobs: dict[str, AlignmentJob] = {}
        self._database: JobDatabase | None = None

    async def open(self, folder: Path) -> list[AlignmentJob]:
        """Load the jobs kept in a folder; returns those that were running when it was left.

        Raises ConflictError: another service uses it; CorruptDataError; StorageError.
        """
        try:
            self._database, self._jobs = await asyncio.to_thread(_open_jobs, folder)
        except (ConflictError, StorageError) as error:
            self.problem = error.message
            raise
        self.problem = None
        return [job for job in self._jobs.values() if job.state == "running"]

    def close(self) -> None:
        """Release the folder."""
        if self._database is not None:
            self._database.close()
            self._database = None

    def get(self, alignment_id: str) -> AlignmentJob:
        """The current state of a job; raises NotFoundError: never submitted, or ended long ago."""
        self._require_open()
        if alignment_id not in self._jobs:
            raise NotFoundError(
                f"alignment {alignment_id!r}: not known here; POST /v1/alignments starts one"
            )
        return self._jobs[alignment_id].with_eta()

    def page(
        self,
        *,
        state: JobState | None,
        after: str | None,
        limit: int,
        recording_ids: Collection[str] = (),
    ) -> AlignmentList:
        """Some jobs, oldest first, after an id; raises NotFoundError if there is no such job."""
        self._require_open()
        jobs = [
            (position, job)
            for position, job in enumerate(self._jobs.values())
            if job.state == (state or job.state)
            and (not recording_ids or job.recording_id in recording_ids)
        ]
        last = -1 if after is None else list(self._jobs).index(self.get(after).alignment_id)
        remaining = [job for position, job in jobs if position > last]
        page = remaining[:limit]
        return AlignmentList(
            alignments=tuple(job.with_eta() for job in page),
            num_matching=len(jobs),
            next_after=page[-1].alignment_id if len(remaining) > limit else None,
        )

    def num_jobs(self, state: JobState) -> int:
        """Number of jobs in a state."""
        return sum(job.state == state for job in list(self._jobs.values()))

    def oldest_waiting_s(self) -> float:
        """For how long the oldest waiting job has waited; 0 without one."""
        waits = [job.submitted_at for job in list(self._jobs.values()) if job.state == "waiting"]
        times = [since for since in waits if since is not None]
        return (datetime.now(UTC) - min(times)).total_seconds() if times else 0.0

    @property
    def recording_ids(self) -> set[str]:
        """Recordings that have a job."""
        return {job.recording_id for job in self._jobs.values()}

    def next(self) -> AlignmentJob | None:
        """The job that has waited longest."""
        return next((job for job in self._jobs.values() if job.state == "waiting"), None)

    def out_of_space(self, *, for_s: float) -> list[AlignmentJob]:
        """Jobs that failed at least `for_s` ago because no space was left."""
        return [job for job in self._jobs.values() if job.is_out_of_space(for_s=for_s)]

    def is_current(self, job: AlignmentJob) -> bool:
        """Whether this attempt still runs: the job was neither cancelled nor started again."""
        known = self._jobs.get(job.alignment_id)
        return known is not None and known.state == "running" and known.started_at == job.started_at

    async def add(self, jobs: Sequence[AlignmentJob]) -> None:
        """Append jobs that are new or failed; raises LimitExceededError if too many are open."""
        known = {key for key, job in self._jobs.items() if job.state not in {"failed", "cancelled"}}
        new = {job.alignment_id: job for job in jobs if job.alignment_id not in known}
        num_open = sum(job.state not in ENDED for job in self._jobs.values())
        if new and num_open + len(new) > self.max_open:
            raise LimitExceededError(
                f"alignments: {num_open} are running or waiting and {len(new)} more were asked "
                f"for, expected at most {self.max_open} in all; try again later",
                retry_after_s=RETRY_AFTER_S,
            )
        kept = {key: job for key, job in self._jobs.items() if key not in new} | new
        ended = [key for key, job in kept.items() if job.state in ENDED]
        forgotten = ended[: max(0, len(kept) - self._max_kept)]
        # Those submitted again are removed first, so that they go to the end of the queue.
        await self._commit([*new, *forgotten], [j for k, j in new.items() if k not in forgotten])
        self._jobs = {key: job for key, job in kept.items() if key not in forgotten}

    async def save(self, job: AlignmentJob) -> None:
        """Replace a job by its next state."""
        await self._commit([], [job])
        self._jobs[job.alignment_id] = job

    async def save_if_possible(self, job: AlignmentJob) -> None:
        """Replace a job by a state that is a fact, even if the disk is full."""
        try:
            await self._commit([], [job])
        except StorageError as error:
            # After a restart the job runs once more and finds its episode in the store.
            logger.warning("job_not_saved", alignment_id=job.alignment_id, reason=error.message)
        self._jobs[job.alignment_id] = job

    def set_progress(self, job: AlignmentJob, progress: Progress) -> None:
        """Record how far a job is, in memory only."""
        if self.is_current(job):
            self._jobs[job.alignment_id] = self._jobs[job.alignment_id].with_progress(progress)

    def _require_open(self) -> None:
        if self.problem is not None:
            raise UnavailableError(f"alignments: the service runs without its jobs: {self.problem}")

    async def _commit(self, removed: Sequence[str], saved: Sequence[AlignmentJob]) -> None:
        self._require_open()
        if self._database is None:
            raise UnavailableError("alignments: the service has not started or is stopping")
        await asyncio.to_thread(self._database.commit, removed, saved)


def _open_jobs(folder: Path) -> tuple["JobDatabase", dict[str, AlignmentJob]]:
    database = JobDatabase(folder)
    try:
        return database, database.load()
    except StorageError:
        database.close()
        raise


class JobDatabase:
    """The table of jobs in SQLite, in a folder that is made if needed; for one process at a time.

    Every commit is on disk when it returns. Raises ConflictError: another process has it open;
    CorruptDataError: it is damaged; StorageError: it cannot be read or written.
    """

    def __init__(self, folder: Path) -> None:
        self._path, self._guard = folder / DATABASE_FILE, threading.Lock()
        with disk_errors(f"open the jobs in {folder}"):
            folder.mkdir(parents=True, exist_ok=True)
            self._check_emptied()
        with self._errors("open"):
            self._connection = sqlite3.connect(self._path, check_same_thread=False, timeout=0)
            try:
                self._prepare(self._connection.execute)
            except (sqlite3.Error, StorageError):
                self._connection.close()
                raise

    def _check_emptied(self) -> None:
        """Refuse a file that was cut to nothing beside its log, which SQLite would delete."""
        log = self._path.with_name(f"{DATABASE_FILE}-wal")
        is_empty = self._path.is_file() and not self._path.stat().st_size
        if is_empty and log.is_file() and log.stat().st_size:
            raise CorruptDataError(f"{self._path}: damaged (it is empty); {MOVE_AWAY}")

    def load(self) -> dict[str, AlignmentJob]:
        """Jobs by id, in order of submission; raises CorruptDataError for a damaged row."""
        select = "SELECT position, crc32c, CAST(job AS BLOB) FROM jobs ORDER BY position"
        with self._errors("read"), self._guard:
            rows = self._connection.execute(select).fetchall()
        jobs = {}
        for position, crc32c, body in rows:
            where = f"{self._path}, job {position}"
            # A table of others may hold anything, such as nothing at all.
            if not isinstance(body, bytes) or google_crc32c.value(body) != crc32c:
                raise CorruptDataError(f"{where}: does not match its checksum; {MOVE_AWAY}")
            try:
                job = AlignmentJob.model_validate_json(body)
            except ValidationError as error:
                raise CorruptDataError(
                    f"{where}: not a job of this version ({error.error_count()} fields do not "
                    f"fit); {MOVE_AWAY}"
                ) from error
            jobs[job.alignment_id] = job
        return jobs

    def commit(self, removed: Iterable[str], saved: Iterable[AlignmentJob]) -> None:
        """Remove jobs and write others in one transaction; raises StorageFullError."""
        delete = "DELETE FROM jobs WHERE alignment_id = ?"
        with self._errors("write"), self._guard, self._connection as connection:
            connection.executemany(delete, [(key,) for key in removed])
            for job in saved:
                body = job.model_dump_json(exclude_none=True)
                crc32c = google_crc32c.value(body.encode())
                connection.execute(UPSERT, (job.alignment_id, crc32c, body))

    def close(self) -> None:
        """Close the database, so that another process may open it."""
        with self._guard:
            self._connection.close()

    def _prepare(self, execute: Callable[[str], sqlite3.Cursor]) -> None:
        # One process has the database, so the log's index need not be in shared memory, which
        # network file systems lack.
        execute("PRAGMA locking_mode = EXCLUSIVE")
        execute("PRAGMA journal_mode = WAL")
        execute("PRAGMA synchronous = FULL")
        (version,) = execute("PRAGMA user_version").fetchone()
        if version == 0:
            execute("BEGIN")
            execute(SCHEMA)
            execute(f"PRAGMA user_version = {SCHEMA_VERSION}")
            execute("COMMIT")
        elif version != SCHEMA_VERSION:
            raise CorruptDataError(
                f"{self._path}: got schema version {version}, expected {SCHEMA_VERSION}; use the "
                f"version of DexTouch that wrote it, or: {MOVE_AWAY}"
            )
        (found,) = execute("PRAGMA quick_check(1)").fetchone()
        if found != "ok":
            raise CorruptDataError(f"{self._path}: damaged ({found}); {MOVE_AWAY}")

    @contextmanager
    def _errors(self, verb: str) -> Iterator[None]:
        what = f"{verb} {self._path}"
        try:
            yield
        except sqlite3.Error as error:
            # Extended codes carry the primary one in their lowest byte.
            code = getattr(error, "sqlite_errorcode", 0) & 0xFF
            if code == sqlite3.SQLITE_BUSY:
                raise ConflictError(
                    f"alignment jobs in {self._path.parent}: another alignment service uses them; "
                    "stop it, or give this one a --jobs-folder of its own"
                ) from error
            if code == sqlite3.SQLITE_FULL:
                raise StorageFullError(
                    f"{what}: no space left; free space and try again"
                ) from error
            if code in DAMAGED:
                raise CorruptDataError(f"{what}: damaged ({error}); {MOVE_AWAY}") from error
            raise StorageError(f"{what}: {error}; {MOVE_AWAY}") from error
