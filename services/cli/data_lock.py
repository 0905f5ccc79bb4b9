"""Lock of a data folder, which only one `dextouch up` may use at a time."""

import fcntl
import os
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Final

from dextouch.episodes import disk_errors
from dextouch.errors import ConflictError

LOCK_FILE: Final = "up.lock"
MAX_TOLD_BYTES: Final = 1000


class DataLock:
    """The held lock of a data folder; its file tells others who holds it."""

    def __init__(self, descriptor: int) -> None:
        self._descriptor = descriptor

    def tell(self, dashboard_url: str) -> None:
        """Write who holds the lock."""
        text = f"process {os.getpid()}, dashboard at {dashboard_url}"
        with disk_errors("write the lock of the data folder"):
            os.ftruncate(self._descriptor, 0)
            os.pwrite(self._descriptor, text.encode(), 0)


@contextmanager
def held_data_folder(folder: Path) -> Iterator[DataLock]:
    """Context manager that holds the lock of a data folder, which is created if needed.

    The kernel releases it when the process ends, however it does.

    Raises:
        ConflictError: another process holds it.
        StorageError: the folder cannot be created or written.
    """
    path = folder / LOCK_FILE
    with disk_errors(
        f"use the data folder {folder}", advice="free space, or choose another --data"
    ):
        folder.mkdir(parents=True, exist_ok=True)
        descriptor = os.open(path, os.O_RDWR | os.O_CREAT, 0o644)
    try:
        try:
            fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError as error:
            told = os.pread(descriptor, MAX_TOLD_BYTES, 0).decode(errors="replace")
            raise ConflictError(
                f"the data folder {folder.resolve()} is in use by another `dextouch up` "
                f"({told or 'which is just starting'}); stop that one with Ctrl-C or kill, or give "
                "this one a folder of its own with --data"
            ) from error
        lock = DataLock(descriptor)
        lock.tell("an address that is not known yet")
        yield lock
    finally:
        os.close(descriptor)
