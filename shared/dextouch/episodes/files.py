"""Crash-safe file operations: full writes, fsync, atomic replacement, and mapped disk errors."""

import errno
import fcntl
import os
from collections.abc import Iterable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from pathlib import Path

from dextouch.errors import StorageError, StorageFullError

_SYNC_THREADS = 16
# EFBIG: the file size limit of the process or file system; handled like a full disk.
_FULL = (errno.ENOSPC, errno.EDQUOT, errno.EFBIG)


@contextmanager
def disk_errors(what: str, *, advice: str = "free space and try again") -> Iterator[None]:
    """Context manager that maps OSError to DexTouch errors, naming the operation `what`.

    `advice` ends the message about a full disk.

    Raises:
        StorageFullError: no space, quota or file size left.
        StorageError: any other I/O error.
    """
    try:
        yield
    except OSError as error:
        if error.errno in _FULL:
            raise StorageFullError(f"{what}: no space left ({error.strerror}); {advice}") from error
        raise StorageError(f"{what}: {error}") from error


def write_all(descriptor: int, data: bytes | memoryview) -> None:
    """Write every byte to an open file."""
    view = memoryview(data)
    while view:
        view = view[os.write(descriptor, view) :]


def write_parts(descriptor: int, parts: Sequence[bytes]) -> None:
    """Write all parts in order without joining them first (writev)."""
    views = [memoryview(part) for part in parts if part]
    while views:
        num_written = os.writev(descriptor, views)
        while views and num_written >= len(views[0]):
            num_written -= len(views.pop(0))
        if views:
            views[0] = views[0][num_written:]


def sync_folder(path: Path) -> None:
    """Sync a folder, so that its entries survive a power loss."""
    descriptor = os.open(path, os.O_RDONLY)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)


def make_held_folder(path: Path) -> int:
    """Create and lock a folder; the returned descriptor holds the lock until it is closed."""
    while True:
        path.mkdir(parents=True)
        descriptor = os.open(path, os.O_RDONLY)
        fcntl.flock(descriptor, fcntl.LOCK_EX)
        if is_folder_at(descriptor, path):
            return descriptor
        # A sweep removed it before it was locked.
        os.close(descriptor)


def try_lock(folder: Path) -> int | None:
    """Lock a folder, as `make_held_folder` does; None if a writer holds its lock."""
    descriptor = os.open(folder, os.O_RDONLY)
    try:
        fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except OSError as error:
        os.close(descriptor)
        if isinstance(error, BlockingIOError):
            return None
        raise
    return descriptor


def is_folder_at(descriptor: int, path: Path) -> bool:
    """Whether an open folder is still the one at `path`."""
    try:
        there = path.stat()
    except FileNotFoundError:
        return False
    return there.st_ino == os.fstat(descriptor).st_ino


def write_file(path: Path, data: bytes, *, sync: bool = True, mode: int = 0o644) -> None:
    """Write a new file; it is durable on return unless `sync` is false."""
    descriptor = os.open(path, os.O_WRONLY | os.O_CREAT | os.O_EXCL, mode)
    try:
        write_all(descriptor, data)
        if sync:
            os.fdatasync(descriptor)
    finally:
        os.close(descriptor)


def sync_files(paths: Iterable[Path]) -> None:
    """Sync many files, so that they survive a power loss.

    In parallel, because the file system then commits its journal once for many of them.
    """
    with ThreadPoolExecutor(_SYNC_THREADS, thread_name_prefix="sync") as threads:
        for _ in threads.map(_sync_file, paths):
            pass


def _sync_file(path: Path) -> None:
    descriptor = os.open(path, os.O_RDONLY)
    try:
        os.fdatasync(descriptor)
    finally:
        os.close(descriptor)


def replace_file(path: Path, data: bytes, *, mode: int = 0o644) -> None:
    """Replace the contents of a file atomically; `mode` are its permissions."""
    partial = path.with_name(path.name + ".partial")
    partial.unlink(missing_ok=True)
    write_file(partial, data, mode=mode)
    partial.replace(path)
    sync_folder(path.parent)


def folder_bytes(folder: Path) -> int:
    """Total size of all files below a folder; files that vanish meanwhile are ignored."""
    total = 0
    with disk_errors(f"measure {folder.name}"):
        for here, _, names in os.walk(folder):
            for name in names:
                try:
                    total += Path(here, name).lstat().st_size
                except FileNotFoundError:
                    continue
    return total
