"""Atomic creation of a file: it gets its name only once it is complete."""

import os
import uuid
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from dextouch.episodes import disk_errors
from dextouch.errors import ConflictError


@contextmanager
def new_file(path: Path, *, overwrite: bool = False) -> Iterator[Path]:
    """Context manager with a temporary path, renamed to `path` when the block succeeds.

    Args:
        path: of the finished file; its folder is created.
        overwrite: whether an existing file is replaced.

    Raises:
        ConflictError: `path` exists and `overwrite` is false.
        StorageError: the write failed.
    """
    if path.is_dir() or (path.exists() and not overwrite):
        raise ConflictError(
            f"{path}: exists already; choose another path"
            + ("" if path.is_dir() else " or allow overwriting (--force)")
        )
    partial = path.with_name(f".{path.name}.{uuid.uuid4().hex}.partial")
    with disk_errors(f"write {path}"):
        path.parent.mkdir(parents=True, exist_ok=True)
        try:
            yield partial
            with partial.open("rb+") as file:
                os.fsync(file.fileno())
            partial.replace(path)
        finally:
            partial.unlink(missing_ok=True)
