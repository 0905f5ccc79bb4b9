"""File access for group readers, independent of the backend; local files are memory-mapped."""

import mmap
import os
import threading
from collections import OrderedDict
from collections.abc import Callable, Hashable
from pathlib import Path
from typing import Generic, Protocol, TypeVar, runtime_checkable

from dextouch.episodes.files import disk_errors

V = TypeVar("V")
# Each mapping holds a file descriptor, and the usual limit is 1024 per process.
MAX_MAPPED_FILES = 192


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

    def source(self, name: str) -> ByteSource:
        """A file that is read in parts."""
        ...


class LruCache(Generic[V]):
    """Thread-safe cache that evicts the least recently used values beyond a total weight."""

    def __init__(self, capacity: int, weigh: Callable[[V], int]) -> None:
        self.capacity, self._weigh = capacity, weigh
        self.forget()

    def get(self, key: Hashable) -> V | None:
        """The value of a key; None if it is not in the cache."""
        with self._guard:
            value = self._values.get(key)
            if value is not None:
                self._values.move_to_end(key)
        return value

    def put(self, key: Hashable, value: V) -> None:
        """Add or replace a value."""
        with self._guard:
            before = self._values.pop(key, None)
            self._weight += self._weigh(value) - (0 if before is None else self._weigh(before))
            self._values[key] = value
            while self._weight > self.capacity:
                self._weight -= self._weigh(self._values.popitem(last=False)[1])

    def forget(self) -> None:
        """Drop all values, and the lock that another thread may have held at a fork."""
        self._guard = threading.Lock()
        self._values: OrderedDict[Hashable, V] = OrderedDict()
        self._weight = 0


# Evicted mappings are dropped, not closed: readers may still use them, and the last one frees them.
_MAPPED: LruCache[mmap.mmap] = LruCache(MAX_MAPPED_FILES, lambda _: 1)
os.register_at_fork(after_in_child=_MAPPED.forget)


def _mapped(path: Path) -> memoryview | None:
    """The memory-mapped bytes of a file; None if it is missing."""
    try:
        status = path.stat()
    except (FileNotFoundError, NotADirectoryError):
        return None
    # A file that was replaced under the same name has another identity.
    key = (str(path), status.st_ino, status.st_size, status.st_mtime_ns)
    known = _MAPPED.get(key)
    if known is None:
        if status.st_size == 0:
            return memoryview(b"")
        with path.open("rb") as file:
            known = mmap.mmap(file.fileno(), 0, access=mmap.ACCESS_READ)
        _MAPPED.put(key, known)
    return memoryview(known)


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
    """The files of a group in a local folder."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder

    @property
    def item_id(self) -> str:
        """The folder's name."""
        return self.folder.name

    def get(self, name: str) -> bytes | None:
        """All bytes of a small file; None where there is no such file."""
        path = self.folder / name
        with disk_errors(f"read {path}"):
            return path.read_bytes() if path.is_file() else None

    def source(self, name: str) -> LocalFile:
        """A file that is read in parts."""
        return LocalFile(self.folder / name)
