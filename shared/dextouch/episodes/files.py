"""Files of a store: crash-safe operations with mapped disk errors, and the sources of readers."""

import errno
import fcntl
import hashlib
import mmap
import os
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from dataclasses import dataclass
from functools import lru_cache, partial
from pathlib import Path
from typing import NamedTuple, Protocol, runtime_checkable

from dextouch.data_folder import is_system_file
from dextouch.episodes.format import COMMIT_FILE
from dextouch.errors import CorruptDataError, NotFoundError, StorageError, StorageFullError

_SYNC_THREADS = 16
# End of the name of a file that is being replaced; one that was interrupted is left.
PARTIAL = ".partial"
_COPY_BYTES = 1 << 22
# IOV_MAX of Linux: what one writev takes.
_MAX_PARTS = 1024
# EFBIG: the file size limit of the process or file system; handled like a full disk.
_FULL = (errno.ENOSPC, errno.EDQUOT, errno.EFBIG)
# Each mapping holds a file descriptor, and the usual limit is 1024 per process.
MAX_MAPPED_FILES = 192
MAX_METADATA_BYTES = 1 << 24
# Earlier releases wrote larger records of long takes.
MAX_COMMIT_BYTES = 1 << 28


@contextmanager
def disk_errors(what: str, *, advice: str = "free space and try again") -> Iterator[None]:
    """Context manager that maps OSError to StorageError; a full disk or quota to StorageFullError.

    `what` names the operation; `advice` ends the message about a full disk.
    """
    try:
        yield
    except OSError as error:
        if error.errno in _FULL:
            raise StorageFullError(f"{what}: no space left ({error.strerror}); {advice}") from error
        raise StorageError(f"{what}: {error}") from error


def write_parts(descriptor: int, *parts: bytes | memoryview) -> None:
    """Write every byte of all parts in order, without joining them first (writev)."""
    views = [memoryview(part) for part in parts if part]
    num_left = sum(map(len, views))
    while num_left:
        num_written = os.writev(descriptor, views[:_MAX_PARTS])
        num_left -= num_written
        num_done = 0
        while num_left and num_written >= len(views[num_done]):
            num_written -= len(views[num_done])
            num_done += 1
        del views[:num_done]
        if num_left:
            views[0] = views[0][num_written:]


def sync_folder(path: Path) -> None:
    """Sync a folder, so that its entries survive a power loss."""
    _sync(path, os.fsync)


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


def try_lock(folder: Path, *, waits: bool = False) -> int | None:
    """Lock a folder, as `make_held_folder` does; None if it is locked, unless this `waits`."""
    descriptor = os.open(folder, os.O_RDONLY)
    try:
        fcntl.flock(descriptor, fcntl.LOCK_EX | (0 if waits else fcntl.LOCK_NB))
    except OSError as error:
        os.close(descriptor)
        if isinstance(error, BlockingIOError):
            return None
        raise
    return descriptor


@contextmanager
def held_folder(folder: Path) -> Iterator[None]:
    """Wait for the lock of a folder, and hold it."""
    descriptor = os.open(folder, os.O_RDONLY)
    try:
        fcntl.flock(descriptor, fcntl.LOCK_EX)
        yield
    finally:
        os.close(descriptor)


def is_folder_at(descriptor: int, path: Path) -> bool:
    """Whether an open folder is still the one at `path`."""
    try:
        there = path.stat()
    except FileNotFoundError:
        return False
    return there.st_ino == os.fstat(descriptor).st_ino


def unheld_folders(parent: Path) -> Iterator[Path]:
    """Iterate over folders not locked by a writer, holding each one's lock meanwhile."""
    for folder in sorted(parent.iterdir()) if parent.is_dir() else []:
        if is_system_file(folder.name):
            continue
        try:
            lock = try_lock(folder)
        except FileNotFoundError:
            continue  # committed since we listed
        if lock is None:
            continue
        try:
            # Its writer may have committed and unlocked it before we locked it.
            if is_folder_at(lock, folder):
                yield folder
        finally:
            os.close(lock)


def write_file(path: Path, data: bytes, *, sync: bool = True, mode: int = 0o644) -> None:
    """Write a new file; it is durable on return unless `sync` is false."""
    descriptor = os.open(path, os.O_WRONLY | os.O_CREAT | os.O_EXCL, mode)
    try:
        write_parts(descriptor, data)
        if sync:
            os.fdatasync(descriptor)
    finally:
        os.close(descriptor)


def sync_files(paths: Iterable[Path]) -> None:
    """Sync many files, so that they survive a power loss.

    In parallel, because the file system then commits its journal once for many of them.
    """
    with ThreadPoolExecutor(_SYNC_THREADS, thread_name_prefix="sync") as threads:
        for _ in threads.map(partial(_sync, how=os.fdatasync), paths):
            pass


def _sync(path: Path, how: Callable[[int], None]) -> None:
    descriptor = os.open(path, os.O_RDONLY)
    try:
        how(descriptor)
    finally:
        os.close(descriptor)


def replace_file(path: Path, data: bytes, *, mode: int = 0o644) -> None:
    """Replace the contents of a file atomically; `mode` are its permissions."""
    unfinished = path.with_name(path.name + PARTIAL)
    unfinished.unlink(missing_ok=True)
    write_file(unfinished, data, mode=mode)
    unfinished.replace(path)
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


class GroupFingerprint(NamedTuple):
    """What changes when a group is replaced or edited: its folder, its content and its remarks."""

    folder: int
    content: str
    remarks: str


@runtime_checkable
class ByteSource(Protocol):
    """Random access to the bytes of one file."""

    def size(self) -> int | None:
        """Length in bytes; None if the file does not exist."""
        ...

    def read(self, offset: int, length: int) -> memoryview | bytes:
        """Bytes offset … offset + length − 1, which the caller knows to exist."""
        ...


@runtime_checkable
class GroupFiles(Protocol):
    """The files of one committed group, by relative names with `/`."""

    item_id: str

    def get(self, name: str) -> bytes | None:
        """All bytes of a small file; None where there is no such file."""
        ...

    def get_now(self, name: str) -> bytes | None:
        """As `get`, but never what was read before."""
        ...

    def source(self, name: str) -> ByteSource:
        """A file that is read in parts."""
        ...

    def names(self) -> list[str]:
        """Sorted names of all files of the group, with those beside its content."""
        ...


@dataclass(frozen=True)
class OpenedGroup:
    """The committed group that a reader has opened, to tell its deletion from damage.

    `commit_sha256` is the hash of its commit record then; `what` names the group in errors.
    """

    files: GroupFiles
    commit_sha256: str
    what: str

    def check_present(self, error: StorageError | None = None) -> None:
        """Raise NotFoundError if the group was deleted or replaced, and so caused `error`."""
        try:
            commit = self.files.get_now(COMMIT_FILE)
        except StorageError:
            return
        if commit is None or hashlib.sha256(commit).hexdigest() != self.commit_sha256:
            change = "deleted" if commit is None else "replaced by another one"
            raise NotFoundError(
                f"{self.what}: was {change} while it was read; list the store again"
            ) from error

    @contextmanager
    def present(self) -> Iterator[None]:
        """`check_present` where reading its files fails."""
        try:
            yield
        except StorageError as error:
            self.check_present(error)
            raise


# Evicted mappings are dropped, not closed: readers may still use them, and the last one frees them.
# A file that was replaced under the same name has another identity.
@lru_cache(MAX_MAPPED_FILES)
def _map(path: str, *_identity: int) -> mmap.mmap:
    with Path(path).open("rb") as file:
        return mmap.mmap(file.fileno(), 0, access=mmap.ACCESS_READ)


class LocalFile:
    """A local file, memory-mapped on first read."""

    def __init__(self, path: Path) -> None:
        self.path = path

    def size(self) -> int | None:
        """Length in bytes; None if the file does not exist."""
        data = self._bytes()
        return None if data is None else len(data)

    def read(self, offset: int, length: int) -> memoryview:
        """Bytes offset … offset + length − 1."""
        data = self._bytes()
        return memoryview(b"") if data is None else data[offset : offset + length]

    def _bytes(self) -> memoryview | None:
        try:
            status = self.path.stat()
            if status.st_size == 0:
                return memoryview(b"")
            identity = (status.st_ino, status.st_size, status.st_mtime_ns)
            return memoryview(_map(str(self.path), *identity))
        except (FileNotFoundError, NotADirectoryError):
            # Also if it was removed after its size was read.
            return None
        except OSError:
            # Entered only on a miss: on every read it would cost as much as the lookup.
            with disk_errors(f"read {self.path}"):
                raise


def copy_files(files: GroupFiles, names: Iterable[str], folder: Path, *, link: bool) -> None:
    """Copy files of a group to a folder, durably; with `link` as hard links where that is possible.

    Raises CorruptDataError for a file that is missing or ends early.
    """
    with disk_errors(f"copy {files.item_id}"):
        for name in names:
            place = folder / name
            place.parent.mkdir(parents=True, exist_ok=True)
            if link and isinstance(files, LocalGroup):
                try:
                    os.link(files.path(name), place, follow_symlinks=False)
                    continue
                except OSError as error:
                    # Another file system, or one without hard links.
                    if error.errno in _FULL:
                        raise
            _copy(files, name, place)


def _copy(files: GroupFiles, name: str, place: Path) -> None:
    source = files.source(name)
    size = source.size()
    with place.open("xb") as file:
        for offset in range(0, size or 0, _COPY_BYTES):
            file.write(source.read(offset, min(_COPY_BYTES, (size or 0) - offset)))
        file.flush()
        os.fdatasync(file.fileno())
        if file.tell() != size:
            raise CorruptDataError(
                f"{files.item_id}: {name} has {file.tell()} bytes, expected {size}; verify the item"
            )


class LocalGroup:
    """The files of a group in a local folder.

    Reading raises CorruptDataError for a symbolic link at or below the folder, and for a small file
    that is larger than any metadata.
    """

    def __init__(self, folder: Path) -> None:
        self.folder, self.item_id = folder, folder.name

    def get(self, name: str) -> bytes | None:
        """All bytes of a small file; None where there is no such file."""
        path = self.path(name)
        with disk_errors(f"read {path}"):
            if not path.is_file():
                return None
            try:
                size = path.stat().st_size
                most = MAX_COMMIT_BYTES if name == COMMIT_FILE else MAX_METADATA_BYTES
                if size > most:
                    raise CorruptDataError(
                        f"{self.item_id}: {name} holds {size} bytes, expected at most {most}",
                        too_large=size,
                    )
                return path.read_bytes()
            except FileNotFoundError:
                return None

    def get_now(self, name: str) -> bytes | None:
        """As `get`, which remembers nothing."""
        return self.get(name)

    def source(self, name: str) -> LocalFile:
        """A file that is read in parts."""
        return LocalFile(self.path(name))

    def names(self) -> list[str]:
        """Sorted names of all files of the group, with those beside its content."""
        with disk_errors(f"look through {self.item_id}"):
            found = (path for path in self.folder.rglob("*") if path.is_file())
            names = (path.relative_to(self.folder).as_posix() for path in found)
            return sorted(n for n in names if not (is_system_file(n) or n.endswith(PARTIAL)))

    def path(self, name: str) -> Path:
        """Path of a file; raises CorruptDataError for a symbolic link on the way."""
        path = self.folder
        for part in ("", *name.split("/")):
            path = path / part
            if path.is_symlink():
                raise CorruptDataError(
                    f"{self.item_id}: {path.name!r} on the way to {name} is a symbolic link, "
                    "expected a file of the group itself; put the file in its place"
                )
        return path
