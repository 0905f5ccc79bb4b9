"""File access for group readers, independent of the backend; local files are memory-mapped."""

import mmap
import os
import threading
from collections import OrderedDict
from pathlib import Path
from typing import Protocol, runtime_checkable

from dextouch.episodes.files import disk_errors

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


class _MappedFiles:
    """LRU cache of memory-mapped files."""

    def __init__(self, capacity: int) -> None:
        self._capacity = capacity
        self._guard = threading.Lock()
        self._maps: OrderedDict[tuple[str, int, int, int], mmap.mmap] = OrderedDict()

    def get(self, path: Path) -> memoryview | None:
        """The mapped bytes of a file; None if it is missing or empty."""
        try:
            status = path.stat()
        except (FileNotFoundError, NotADirectoryError):
            return None
        # A file that was replaced under the same name has another identity.
        key = (str(path), status.st_ino, status.st_size, status.st_mtime_ns)
        with self._guard:
            known = self._maps.get(key)
            if known is None:
                if status.st_size == 0:
                    return memoryview(b"")
                known = self._map(path)
                self._maps[key] = known
                # Dropped, not closed: readers may still use the mapping, and the last one frees it.
                while len(self._maps) > self._capacity:
                    self._maps.popitem(last=False)
            else:
                self._maps.move_to_end(key)
        return memoryview(known)

    def forget(self) -> None:
        """Drop all mappings, as a forked process must."""
        self._guard = threading.Lock()
        self._maps.clear()

    @staticmethod
    def _map(path: Path) -> mmap.mmap:
        descriptor = os.open(path, os.O_RDONLY)
        try:
            return mmap.mmap(descriptor, 0, access=mmap.ACCESS_READ)
        finally:
            os.close(descriptor)


_MAPPED = _MappedFiles(MAX_MAPPED_FILES)
# A lock that another thread held at the fork would stay locked in the child forever.
os.register_at_fork(after_in_child=_MAPPED.forget)


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
            return _MAPPED.get(self.path)
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
