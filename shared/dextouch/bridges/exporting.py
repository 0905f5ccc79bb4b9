"""What exporters share: samples in bounded memory, and a file or folder that appears whole."""

import ctypes
import os
import shutil
import uuid
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Final

import numpy as np
from jaxtyping import Int64, Shaped

from dextouch.episodes import GOP_IMAGES, EpisodeReader, RecordingReader, disk_errors
from dextouch.errors import ConflictError
from dextouch.streams import ENCODED_UNITS, H264_UNIT, NO_DEVICE_TIME, NO_SEQUENCE, encoded_values

BLOCK_IMAGES: Final = 32
Reader = EpisodeReader | RecordingReader
BLOCK_SECONDS: Final = 1.0
# Of the system call renameat2 (Linux): paths from the working folder; exchange both.
_AT_FDCWD, _RENAME_EXCHANGE = -100, 2


@dataclass(frozen=True)
class Block:
    """Consecutive samples of one stream.

    `t_ns` is t_ref_ns of an episode or t_host_ns of a recording; `values` are rows of the stream,
    or for encoded images an object array of bytes.
    """

    t_ns: Int64[np.ndarray, " n"]
    t_device_ns: Int64[np.ndarray, " n"]
    sequence: Int64[np.ndarray, " n"]
    values: Shaped[np.ndarray, "n ..."]

    def __len__(self) -> int:
        return len(self.t_ns)


def exported_samples(reader: Reader, name: str) -> Int64[np.ndarray, " kept"]:
    """Indices of a stream's samples without damaged images; of H.264 whole groups are left out."""
    damaged, unit = reader.damaged_images(name), reader.streams[name].unit
    indices = np.arange(reader.num_samples(name), dtype=np.int64)
    size = GOP_IMAGES if unit == H264_UNIT else 1
    return indices[np.isin(indices // size, damaged // size, invert=True)]


def blocks(reader: Reader, name: str) -> Iterator[Block]:
    """Iterate over `exported_samples` in order, about a second per block.

    Encoded images stay encoded.
    """
    descriptor, t_ns = reader.streams[name], reader.stamps_ns(name)
    t_device_ns, sequence = np.full_like(t_ns, NO_DEVICE_TIME), np.full_like(t_ns, NO_SEQUENCE)
    if isinstance(reader, RecordingReader):
        stamps = reader.stamps(name)
        t_device_ns, sequence = stamps.t_device_ns, stamps.sequence
    kept = np.isin(np.arange(len(t_ns)), exported_samples(reader, name))
    each = max(1, round(descriptor.nominal_rate_hz * BLOCK_SECONDS))
    for start in range(0, len(t_ns), each):
        stop = min(start + each, len(t_ns))
        if descriptor.unit in ENCODED_UNITS:
            values = encoded_values(reader.encoded_images(name, start, stop))
        else:
            values = reader.values(name, start, stop)
        part = np.flatnonzero(kept[start:stop])
        if len(part):
            rows = start + part
            yield Block(t_ns[rows], t_device_ns[rows], sequence[rows], values[part])


@contextmanager
def new_file(path: Path, *, overwrite: bool = False) -> Iterator[Path]:
    """Context manager with a temporary path, renamed to `path` when the block succeeds.

    Raises:
        ConflictError: `path` exists, and is a folder or not to be overwritten.
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


def replace_folder(new: Path, old: Path) -> None:
    """Put a complete folder in the place of another one, which is removed.

    On Linux the two are exchanged in one step, so that a crash leaves one of them in the place;
    where the disk cannot do that, the old one is renamed first.

    Raises StorageError if neither is possible; then the old one is in its place.
    """
    with disk_errors(f"replace {old}"):
        for path in new.rglob("*"):
            # Files that are shared with the old folder are on the disk already.
            if path.is_dir() or path.stat().st_nlink == 1:
                _sync(path)
        _sync(new)
        if not _exchange(new, old):
            aside = old.with_name(f".{old.name}.{uuid.uuid4().hex}.old")
            old.rename(aside)
            try:
                new.rename(old)
            except OSError:
                aside.rename(old)
                raise
            aside.rename(new)
        _sync(old.parent)
        shutil.rmtree(new)


def _sync(path: Path) -> None:
    descriptor = os.open(path, os.O_RDONLY)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)


def _exchange(first: Path, second: Path) -> bool:
    """Exchange two paths in one step; False where the system or the disk cannot."""
    try:
        rename = ctypes.CDLL(None).renameat2
    except (AttributeError, OSError):
        return False
    paths = (os.fsencode(first), os.fsencode(second))
    return bool(rename(_AT_FDCWD, paths[0], _AT_FDCWD, paths[1], _RENAME_EXCHANGE) == 0)
