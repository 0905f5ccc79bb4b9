"""Audit log of the dashboard: who changed what and when, as JSON lines in files that rotate.

A line is on the disk before the browser learns the result. Lines of people without a session
(refused sign-ins) rotate in files of their own, so that they cannot displace the others.
"""

import heapq
import os
import threading
from collections import deque
from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import Final

import structlog
from pydantic import AwareDatetime, ValidationError

from dextouch.errors import InvalidInputError
from dextouch.frozen_model import FrozenModel

logger = structlog.get_logger(__name__)

MAX_IN_MEMORY: Final = 1000
# Of the newest file and the older ones; the oldest is deleted when a new one begins.
NUM_FILES: Final = 8
NOT_SIGNED_IN: Final = "not signed in"


class AuditEntry(FrozenModel):
    """One request that changes something.

    `person` is the name of the key that signed in, "open access" where no key is needed, or "not
    signed in". `status` is that of the HTTP response, `request_id` that of the logs.
    """

    at: AwareDatetime
    person: str
    action: str
    target: str = ""
    status: int
    client: str = ""
    request_id: str = ""


class AuditPage(FrozenModel):
    """The newest entries, newest first.

    Attributes:
        has_more: whether older entries match, too.
        actions: all that there are.
        people: whose entries were read on the way.
        folder: where the log is kept; None if only in memory, until the dashboard ends.
        num_damaged: unreadable lines among those that were read.
        num_lost: entries that could not be written since the dashboard started.
        no_used_tokens: why the entries of enrolled stations are missing; empty if they are not.
    """

    entries: tuple[AuditEntry, ...]
    has_more: bool
    actions: tuple[str, ...] = ()
    people: tuple[str, ...]
    folder: str | None
    num_damaged: int
    num_lost: int
    no_used_tokens: str = ""


class RotatedLines:
    """Lines in numbered files of a folder, of which old ones are deleted.

    Args:
        folder: of the files.
        name: their beginning.
        max_bytes: of all files together.
        sync: whether a line survives a power loss, not only the end of the process.
    """

    def __init__(self, folder: Path, name: str, *, max_bytes: int, sync: bool) -> None:
        self._folder, self._name, self._sync = folder, name, sync
        self._max_file_bytes = max_bytes // NUM_FILES

    def _paths(self) -> list[Path]:
        """Oldest first."""
        return sorted(self._folder.glob(f"{self._name}-" + "[0-9]" * 9 + ".jsonl"))

    def append(self, line: bytes) -> None:
        """Add a line, after the rest of one that could not be finished; raises OSError."""
        paths = self._paths()
        path = paths[-1] if paths else self._path(1)
        if paths and path.stat().st_size + len(line) > self._max_file_bytes:
            path = self._path(int(path.stem[-9:]) + 1)
            for old in paths[: max(0, len(paths) + 1 - NUM_FILES)]:
                old.unlink(missing_ok=True)
        is_new = not path.exists()
        descriptor = os.open(path, os.O_RDWR | os.O_CREAT | os.O_APPEND, 0o640)
        try:
            size = os.fstat(descriptor).st_size
            is_torn = size > 0 and os.pread(descriptor, 1, size - 1) != b"\n"
            rest = memoryview((b"\n" if is_torn else b"") + line + b"\n")
            while rest:
                rest = rest[os.write(descriptor, rest) :]
            if self._sync:
                os.fsync(descriptor)
        finally:
            os.close(descriptor)
        if is_new and self._sync:
            _sync_folder(self._folder)

    def _path(self, number: int) -> Path:
        return self._folder / f"{self._name}-{number:09}.jsonl"

    def newest_first(self) -> Iterator[bytes]:
        """All lines, also damaged ones."""
        for path in reversed(self._paths()):
            try:
                content = path.read_bytes()
            except FileNotFoundError:
                continue  # just rotated away
            yield from (line for line in reversed(content.split(b"\n")) if line)


class AuditLog:
    """Entries of the requests that change something, in a folder or in memory; thread-safe.

    Args:
        folder: of the files; None keeps the newest entries in memory.
        max_bytes: of all files together.
    """

    def __init__(self, folder: Path | None, *, max_bytes: int) -> None:
        self.folder = folder
        self.num_lost = 0
        self._lock = threading.Lock()
        self._in_memory: deque[AuditEntry] = deque(maxlen=MAX_IN_MEMORY)
        self._of_people: RotatedLines | None = None
        self._of_others: RotatedLines | None = None
        if folder is not None:
            _prepare(folder)
            half = max_bytes // 2
            self._of_people = RotatedLines(folder, "audit", max_bytes=half, sync=True)
            self._of_others = RotatedLines(folder, "not_signed_in", max_bytes=half, sync=False)

    def write(self, entry: AuditEntry) -> None:
        """Keep an entry; if the disk refuses it, it is counted, logged and kept in memory."""
        files = self._of_others if entry.person == NOT_SIGNED_IN else self._of_people
        with self._lock:
            try:
                if files is None:
                    self._in_memory.append(entry)
                else:
                    # Escapes make it one line of ASCII, whatever the texts hold.
                    files.append(entry.model_dump_json(ensure_ascii=True).encode())
            except OSError:
                self.num_lost += 1
                self._in_memory.append(entry)
                logger.exception("audit_not_written", entry=entry.model_dump(mode="json"))

    def newest(
        self,
        limit: int,
        *,
        action: str | None = None,
        person: str | None = None,
        others: Iterable[AuditEntry] = (),
    ) -> AuditPage:
        """The newest entries, those of an action and of a person only if these are given.

        `others` are entries that are kept elsewhere.
        """
        damaged = 0

        def readable(lines: RotatedLines | None) -> Iterator[AuditEntry]:
            nonlocal damaged
            for line in () if lines is None else lines.newest_first():
                try:
                    yield AuditEntry.model_validate_json(line)
                except ValidationError:
                    damaged += 1

        with self._lock:
            remembered = list(reversed(self._in_memory))
        elsewhere = sorted(others, key=lambda one: one.at, reverse=True)
        logged = (readable(self._of_people), readable(self._of_others))
        sources = (*logged, iter(remembered), iter(elsewhere))
        found: list[AuditEntry] = []
        people: dict[str, None] = {}
        for entry in heapq.merge(*sources, key=lambda one: one.at, reverse=True):
            people[entry.person] = None
            if action in (None, entry.action) and person in (None, entry.person):
                found.append(entry)
                if len(found) > limit:
                    break
        return AuditPage(
            entries=tuple(found[:limit]),
            has_more=len(found) > limit,
            people=tuple(sorted(people)),
            folder=None if self.folder is None else str(self.folder),
            num_damaged=damaged,
            num_lost=self.num_lost,
        )


def _prepare(folder: Path) -> None:
    try:
        folder.mkdir(parents=True, exist_ok=True)
        writable = os.access(folder, os.W_OK | os.X_OK)
    except OSError as error:
        raise InvalidInputError(f"audit_folder {folder}: cannot be created ({error})") from error
    if not writable:
        raise InvalidInputError(
            f"audit_folder {folder}: cannot be written by this user; choose another folder, or "
            "none to keep the audit log in memory only"
        )


def _sync_folder(folder: Path) -> None:
    descriptor = os.open(folder, os.O_RDONLY)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)
