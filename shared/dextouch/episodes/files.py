"""Bytes to files that survive a crash: whole writes, atomic replacement, and honest disk errors."""

import errno
import fcntl
import os
from collections.abc import Iterable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from pathlib import Path

from dextouch.errors import StorageError, StorageFullError

_SYNC_THREADS = 16
# EFBIG: the file size limit of the process or file system; for a recording the same decision.
_FULL = (errno.ENOSPC, errno.EDQUOT, errno.EFBIG)


@contextmanager
def disk_errors(what: str, *, advice: str = "free space and try again") -> Iterator[None]:
    """Turn the operating system's errors into ours, naming `what` was being done.

    `advice` ends the message about a full disk.

    Raises:
        StorageFullError: no space, quota or file size left.
        StorageError: any other failure of the disk.
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
    """Write every byte of the parts, one behind the other, without joining them first."""
    views = [memoryview(part) for part in parts if part]
    while views:
        num_written = os.writev(descriptor, views)
        while views and num_written >= len(views[0]):
            num_written -= len(views.pop(0))
        if views:
            views[0] = views[0][num_written:]


def sync_folder(path: Path) -> None:
    """Make the names in a folder survive a power loss."""
    descriptor = os.open(path, os.O_RDONLY)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)


def make_held_folder(path: Path) -> int:
    """Make a new folder and lock it; a descriptor that holds the lock until it is closed."""
    while True:
        path.mkdir(parents=True)
        descriptor = os.open(path, os.O_RDONLY)
        fcntl.flock(descriptor, fcntl.LOCK_EX)
        if is_folder_at(descriptor, path):
            return descriptor
        # A sweep found it before it was locked, and removed it.
        os.close(descriptor)


def is_folder_at(descriptor: int, path: Path) -> bool:
    """Whether an open folder is still the one at a path."""
    try:
        there = path.stat()
    except FileNotFoundError:
        return False
    return there.st_ino == os.fstat(descriptor).st_ino


def write_file(path: Path, data: bytes, *, sync: bool = True) -> None:
    """A new file with these bytes, on the disk when this returns unless `sync` is off."""
    descriptor = os.open(path, os.O_WRONLY | os.O_CREAT | os.O_EXCL, 0o644)
    try:
        write_all(descriptor, data)
        if sync:
            os.fdatasync(descriptor)
    finally:
        os.close(descriptor)


def sync_files(paths: Iterable[Path]) -> None:
    """Make many files survive a power loss.

    At the same time, because a file system then writes its journal once for many of them.
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


def partial_name(name: str) -> str:
    """What a file is called while `replace_file` writes it."""
    return name + ".partial"


def replace_file(path: Path, data: bytes) -> None:
    """Put these bytes in place of a file, whole or not at all."""
    partial = path.with_name(partial_name(path.name))
    partial.unlink(missing_ok=True)
    write_file(partial, data)
    partial.replace(path)
    sync_folder(path.parent)


def folder_bytes(folder: Path) -> int:
    """Bytes of all files below a folder; what vanishes meanwhile counts nothing."""
    total = 0
    with disk_errors(f"measure {folder.name}"):
        for here, _, names in os.walk(folder):
            for name in names:
                try:
                    total += Path(here, name).stat().st_size
                except FileNotFoundError:
                    continue
    return total
