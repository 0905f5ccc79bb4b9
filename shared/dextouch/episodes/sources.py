"""File access for group readers, independent of the backend; local files are memory-mapped."""

import hashlib
import mmap
import threading
from collections import OrderedDict
from collections.abc import Hashable
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from typing import Protocol, runtime_checkable

from dextouch.episodes.files import disk_errors
from dextouch.errors import CorruptDataError, NotFoundError, StorageError

# Each mapping holds a file descriptor, and the usual limit is 1024 per process.
MAX_MAPPED_FILES = 192
MAX_METADATA_BYTES = 1 << 24


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

    @property
    def item_id(self) -> str:
        """Id of the group."""
        ...

    def get(self, name: str) -> bytes | None:
        """All bytes of a small file; None where there is no such file."""
        ...

    def get_now(self, name: str) -> bytes | None:
        """As `get`, but never what was read before."""
        ...

    def source(self, name: str) -> ByteSource:
        """A file that is read in parts."""
        ...


@dataclass(frozen=True)
class OpenedGroup:
    """The committed group that a reader has opened, to tell its deletion from damage.

    Attributes:
        files: of the group.
        commit_name: name of its commit record.
        commit_sha256: hash of the commit record when it was opened.
        what: names the group in errors.
    """

    files: GroupFiles
    commit_name: str
    commit_sha256: str
    what: str

    def check_present(self, error: StorageError | None = None) -> None:
        """Refuse a group that was deleted or replaced, of which `error` is the consequence.

        Raises:
            NotFoundError: its commit record is gone, or another one.
        """
        try:
            commit = self.files.get_now(self.commit_name)
        except StorageError:
            return
        if commit is None or hashlib.sha256(commit).hexdigest() != self.commit_sha256:
            change = "deleted" if commit is None else "replaced by another one"
            raise NotFoundError(
                f"{self.what}: was {change} while it was read; list the store again"
            ) from error


class LruCache:
    """Thread-safe cache of bytes that evicts the least recently used ones beyond a total size."""

    def __init__(self, capacity: int) -> None:
        self.capacity = capacity
        self._guard = threading.Lock()
        self._values: OrderedDict[Hashable, bytes] = OrderedDict()
        self._size = 0

    def get(self, key: Hashable) -> bytes | None:
        """The value of a key; None if it is not in the cache."""
        with self._guard:
            value = self._values.get(key)
            if value is not None:
                self._values.move_to_end(key)
        return value

    def put(self, key: Hashable, value: bytes) -> None:
        """Add or replace a value."""
        with self._guard:
            self._size += len(value) - len(self._values.pop(key, b""))
            self._values[key] = value
            while self._size > self.capacity:
                self._size -= len(self._values.popitem(last=False)[1])


def _mapped(path: Path) -> memoryview | None:
    """The memory-mapped bytes of a file; None if it is missing."""
    try:
        status = path.stat()
        if status.st_size == 0:
            return memoryview(b"")
        return memoryview(_map(str(path), status.st_ino, status.st_size, status.st_mtime_ns))
    except (FileNotFoundError, NotADirectoryError):
        # Also if it was removed after its size was read.
        return None


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
            return _mapped(self.path)
        except OSError:
            # Entered only on a miss: on every read it would cost as much as the lookup.
            with disk_errors(f"read {self.path}"):
                raise


class LocalGroup:
    """The files of a group in a local folder, all of which must lie inside it.

    Raises:
        CorruptDataError: the folder, a file or a folder between is a symbolic link, or a small file
            is larger than any metadata.
    """

    def __init__(self, folder: Path) -> None:
        self.folder = folder

    @property
    def item_id(self) -> str:
        """The folder's name."""
        return self.folder.name

    def get(self, name: str) -> bytes | None:
        """All bytes of a small file; None where there is no such file."""
        path = self._path(name)
        with disk_errors(f"read {path}"):
            if not path.is_file():
                return None
            try:
                size = path.stat().st_size
                if size > MAX_METADATA_BYTES:
                    raise CorruptDataError(
                        f"{self.item_id}: {name} holds {size} bytes, expected at most "
                        f"{MAX_METADATA_BYTES}"
                    )
                return path.read_bytes()
            except FileNotFoundError:
                return None

    def get_now(self, name: str) -> bytes | None:
        """As `get`, which remembers nothing."""
        return self.get(name)

    def source(self, name: str) -> LocalFile:
        """A file that is read in parts."""
        return LocalFile(self._path(name))

    def _path(self, name: str) -> Path:
        path = self.folder
        for part in ("", *name.split("/")):
            path = path / part
            if path.is_symlink():
                raise CorruptDataError(
                    f"{self.item_id}: {path.name!r} on the way to {name} is a symbolic link, "
                    "expected a file of the group itself; put the file in its place"
                )
        return path
