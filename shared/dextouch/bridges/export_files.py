"""What exporters share: samples in bounded memory, wall-clock times, touch, whole files."""

import ctypes
import os
import shutil
import uuid
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from datetime import UTC, datetime, timedelta
from pathlib import Path
from typing import Final

import numpy as np
from jaxtyping import Int64, Shaped, UInt8

from dextouch.episodes import GOP_IMAGES, Attributes, EpisodeReader, RecordingReader, disk_errors
from dextouch.errors import ConflictError
from dextouch.schemas import EpisodeAttributes
from dextouch.streams import (
    ENCODED_UNITS,
    H264_UNIT,
    NO_DEVICE_TIME,
    NO_SEQUENCE,
    TAXEL_UNIT,
    StreamDescriptor,
    encoded_values,
)
from dextouch.tactile import colour
from dextouch.tactile.layout import DEXTOUCH_V1, Side, TactileLayout

BLOCK_IMAGES: Final = 32
# Fields of our MCAP messages beside those of their public schemas.
T_DEVICE: Final = "dextouch_t_device_ns"
SEQUENCE: Final = "dextouch_sequence"
Reader = EpisodeReader | RecordingReader
BLOCK_SECONDS: Final = 1.0
# Of the system call renameat2 (Linux): paths from the working folder; exchange both.
_AT_FDCWD, _RENAME_EXCHANGE = -100, 2
# Pressure at full brightness of a picture of touch.
FULL_SCALE_KPA: Final = 40.0
_EPOCH: Final = datetime(1970, 1, 1, tzinfo=UTC)


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


def wall_offset_ns(about: Attributes) -> int | None:
    """Unix time minus the item's own time, in nanoseconds; None if it is not known.

    Of a recording it is exact to the microseconds of `started_at`. Of an episode, step 0 is taken
    for `created_at`, the start of its recording: seconds that alignment cut off before step 0 are
    not counted.
    """
    if isinstance(about, EpisodeAttributes):
        began_at, began_ns = about.created_at, 0
    elif about.started_t_host_ns is None:
        return None
    else:
        began_at, began_ns = about.started_at, about.started_t_host_ns
    if began_at is None:
        return None
    return (began_at - _EPOCH) // timedelta(microseconds=1) * 1000 - began_ns


def touch_side(descriptor: StreamDescriptor) -> Side | None:
    """Side of a tactile stream; None if it cannot be drawn as a hand."""
    layout = descriptor.tactile_layout
    if not (_is_raw(descriptor) or descriptor.shape == (layout.num_taxels,)):
        return None
    if descriptor.side is not None:
        return descriptor.side
    sides: tuple[Side, Side] = ("left", "right")
    return next((side for side in sides if descriptor.name.endswith(f"_{side}")), None)


def _is_raw(descriptor: StreamDescriptor) -> bool:
    return descriptor.unit != TAXEL_UNIT and descriptor.shape == (
        descriptor.tactile_layout.num_raw_cells,
    )


def heat_map(
    values: np.ndarray,
    *,
    side: Side,
    full_scale: float,
    layout: TactileLayout = DEXTOUCH_V1,
    is_raw: bool = False,
) -> UInt8[np.ndarray, "*batch rows columns 3"]:
    """Readings of a glove as small RGB pictures of the hand, on the square-root scale of `colour`.

    Args:
        values: taxels, or the raw cells, on the last axis.
        side: of the hand.
        full_scale: reading shown at full brightness, in the unit of the values.
        layout: of the glove.
        is_raw: whether the values are raw cells.
    """
    taxels = layout.select(values, side=side) if is_raw else layout.check(np.asarray(values))
    # Which taxel is in each cell of the canvas, -1 of none; whole numbers are exact in float32.
    cells = layout.hand_canvas(np.arange(layout.num_taxels), side=side)
    indices = np.nan_to_num(cells, nan=-1).astype(np.intp)
    colours = colour(taxels, full_scale_kpa=full_scale)
    empty = np.broadcast_to(colour(np.array(np.nan)), (*colours.shape[:-2], 1, 3))
    return np.concatenate([colours, empty], axis=-2).take(indices, axis=-2)


class TouchPictures:
    """Pictures of a tactile stream that `touch_side` knows.

    `full_scale` is the reading at full brightness: 40 kPa, or of raw counts, which have no absolute
    scale, the largest of the take.
    """

    def __init__(self, reader: Reader, descriptor: StreamDescriptor) -> None:
        self._descriptor = descriptor
        self._side = touch_side(descriptor) or "left"
        self.full_scale = FULL_SCALE_KPA
        if descriptor.unit != TAXEL_UNIT:
            largest = [block.values.max() for block in blocks(reader, descriptor.name)]
            self.full_scale = float(max(largest, default=1)) or 1.0

    def draw(self, values: np.ndarray) -> UInt8[np.ndarray, "*batch rows columns 3"]:
        """Pictures of samples, [..., taxels or cells]."""
        return heat_map(
            values,
            side=self._side,
            full_scale=self.full_scale,
            layout=self._descriptor.tactile_layout,
            is_raw=_is_raw(self._descriptor),
        )

    @property
    def shape(self) -> tuple[int, int, int]:
        """Rows, columns and colours of a picture."""
        return (*self._descriptor.tactile_layout.canvas, 3)


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
