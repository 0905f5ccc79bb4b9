"""The path of a new file in; a place to write it that takes its name only when it is whole, out."""

import os
import uuid
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from dextouch.episodes.files import disk_errors
from dextouch.errors import ConflictError


@contextmanager
def new_file(path: Path, *, overwrite: bool = False) -> Iterator[Path]:
    """A path beside `path` that takes its name when the block ends well.

    Args:
        path: of the finished file; its folder is created.
        overwrite: whether an existing file is replaced.

    Raises:
        ConflictError: `path` exists and `overwrite` is false.
        StorageError: the disk does not take it.
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
