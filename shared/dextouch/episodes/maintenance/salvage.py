"""The readable samples of a damaged group or spool.

Nothing is filled in: a damaged storage chunk, image or sample is dropped with its stamps.
"""

import math
import struct
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path

import google_crc32c
import numpy as np
import zstandard

from dextouch.episodes.encoded_images import GroupChunks, hashed_bytes
from dextouch.episodes.files import LocalFile
from dextouch.episodes.format import (
    GOP_IMAGES,
    STAMPS,
    ArrayEntry,
    Attributes,
    image_codec,
    index_name,
    kind_of,
    shard_path,
)
from dextouch.episodes.image_codecs import ImageGroups
from dextouch.episodes.shards import CRC_BYTES, INDEX_ENTRY_BYTES, ShardReader
from dextouch.episodes.spool_log import body_at, find_records, open_log, read_batch, read_seal
from dextouch.errors import CorruptDataError, InvalidInputError
from dextouch.streams import StreamDescriptor, check_batch, decode_body, encoded_values

# The rows of these streams correspond by index: the steps of the model grid.
GRID_STREAMS = ("action", "action_commanded")
BLOCK_SAMPLES = 256
# One day of 30 images per second, each a storage chunk.
_MAX_CHUNKS = 86_400 * 30
_JPEG_END = b"\xff\xd9"
# Values, and stamps by name.
Block = tuple[np.ndarray, dict[str, np.ndarray]]


@dataclass(frozen=True)
class SalvagedStream:
    """The readable samples of one stream; `kept` is the mask of samples to keep.

    `read` gives those of a range that starts and ends at multiples of `block`.
    """

    descriptor: StreamDescriptor
    kept: np.ndarray
    read: Callable[[int, int, np.ndarray], Block]
    block: int = BLOCK_SAMPLES

    @property
    def num_lost(self) -> int:
        """Number of dropped samples."""
        return int((~self.kept).sum())

    def blocks(self) -> Iterator[Block]:
        """Iterate over the kept samples."""
        for start in range(0, len(self.kept), self.block):
            stop = min(start + self.block, len(self.kept))
            if self.kept[start:stop].any():
                yield self.read(start, stop, self.kept[start:stop])


class _SalvagedArray:
    """An array of which some storage chunks are damaged; `groups` decodes encoded images of v2."""

    def __init__(self, path: Path, entry: ArrayEntry, groups: ImageGroups | None = None) -> None:
        self.chunk_rows, what = entry.chunk_rows, f"array {path.name!r}"
        index = _salvaged_index(LocalFile(path), entry)
        self._shard = ShardReader(LocalFile(path), entry, what=what, index=index)
        self._images = None if groups is None else GroupChunks(groups, self._shard)
        self._row_shape = entry.shape[1:]
        holds = [self._holds(number) for number in range(len(index))]
        self.rows_hold = np.repeat(np.array(holds, dtype=bool), entry.chunk_rows)[: entry.shape[0]]

    def _holds(self, number: int) -> bool:
        try:
            hashed_bytes(self._shard, self._shard.payload(number), number, self._images)
        except CorruptDataError:
            return False
        return True

    def rows(self, start: int, stop: int, kept: np.ndarray) -> np.ndarray:
        """Kept ones of rows start … stop−1, of one storage chunk; of images the bytes."""
        number = start // self.chunk_rows
        if self._images is not None:
            return encoded_values(self._images.read_group(number))[kept]
        return self._shard.rows_of(self._shard.payload(number), number)[kept]

    def column(self) -> np.ndarray:
        """All rows of numbers; damaged ones are zero."""
        column, rows = np.zeros((len(self.rows_hold), *self._row_shape), np.int64), self.chunk_rows
        for number in range(-(-len(column) // rows)):
            if self.rows_hold[number * rows]:
                part = self._shard.rows_of(self._shard.payload(number), number)
                column[number * rows : number * rows + len(part)] = part
        return column


class _SalvagedImages:
    """Encoded images of v3 of which some bytes are damaged, or some rows of their index.

    An image is known by its checksum in the index, whatever is around it.
    """

    def __init__(
        self, path: Path, entry: ArrayEntry, index: _SalvagedArray, groups: ImageGroups
    ) -> None:
        self.chunk_rows, self._places = groups.size, index.column()
        # Each storage chunk has its place, so that no index of the shard is needed.
        self._shard = ShardReader(
            LocalFile(path), entry, what=groups.what, index=np.zeros((0, 2), np.uint64)
        )
        holds = np.array([self._image(n) is not None for n in range(len(self._places))], bool)
        self.rows_hold = holds & index.rows_hold
        for first in range(0, len(holds), groups.size):
            here = slice(first, min(first + groups.size, len(holds)))
            if self.rows_hold[here].all():
                with suppress(CorruptDataError):
                    images = self._images(range(here.start, here.stop))
                    groups.check(images, first // groups.size)
                    continue
            self.rows_hold[here] = False

    def _image(self, number: int) -> bytes | None:
        start, stop, crc = self._places[number].tolist()
        if not 0 <= start < stop <= self._shard.num_rows:
            return None
        try:
            image = self._shard.read_bytes(start, stop)
        except CorruptDataError:
            return None
        return image if google_crc32c.value(image) == crc else None

    def rows(self, start: int, stop: int, kept: np.ndarray) -> np.ndarray:
        """The bytes of those of images start … stop−1 that are kept."""
        return encoded_values(self._images((start + np.flatnonzero(kept)).tolist()))

    def _images(self, numbers: Iterable[int]) -> list[bytes]:
        return [image for n in numbers if (image := self._image(n)) is not None]


def group_streams(
    folder: Path, attributes: Attributes, entries: Mapping[str, ArrayEntry]
) -> list[SalvagedStream]:
    """The readable samples of a committed group; `entries` are what is known of its arrays."""

    def array(name: str, groups: ImageGroups | None = None) -> _SalvagedArray:
        return _SalvagedArray(_shard_of(folder, name, entries), entries[name], groups)

    found = []
    for stream in attributes.streams:
        name, codec = stream.name, image_codec(stream)
        groups = None if codec is None else ImageGroups(codec, stream.shape, f"array {name!r}")
        values: _SalvagedArray | _SalvagedImages
        if groups is not None and entries[name].codec == "bytes":
            path, index = _shard_of(folder, name, entries), array(index_name(name))
            values = _SalvagedImages(path, entries[name], index, groups)
        else:
            values = array(name, groups)
        stamps = {stamp: array(f"{name}_{stamp}") for stamp in STAMPS[kind_of(attributes)]}
        count = min(len(part.rows_hold) for part in (values, *stamps.values()))
        kept = values.rows_hold[:count].copy()
        for part in stamps.values():
            kept &= part.rows_hold[:count]
        columns = {stamp: part.column()[:count] for stamp, part in stamps.items()}
        read = partial(_read_rows, values, columns)
        found.append(SalvagedStream(stream, kept, read, values.chunk_rows))
    return found


def _shard_of(folder: Path, name: str, entries: Mapping[str, ArrayEntry]) -> Path:
    return folder / name / shard_path(len(entries[name].shape))


def spool_streams(spool: Path, attributes: Attributes) -> list[SalvagedStream]:
    """The readable samples of a spool, batch by batch."""
    with open_log(spool) as data:
        rows = find_records(data).rows
        holds = np.array(
            [_holds(attributes.streams, row, body_at(data, row)) for row in rows], bool
        )
    mine = [rows["stream"] == number for number in range(len(attributes.streams))]
    seal = None
    with suppress(FileNotFoundError, CorruptDataError):
        seal = read_seal(spool)
    # Samples by stream that it had when it was closed, as far as it says.
    closed_with = {} if seal is None else seal.num_samples
    return [
        _spooled(spool, stream, rows[own], holds[own], closed_with.get(stream.name, 0))
        for stream, own in zip(attributes.streams, mine, strict=True)
    ]


def _read_rows(
    array: _SalvagedArray | _SalvagedImages,
    columns: Mapping[str, np.ndarray],
    start: int,
    stop: int,
    kept: np.ndarray,
) -> Block:
    return array.rows(start, stop, kept), {
        stamp: column[start:stop][kept] for stamp, column in columns.items()
    }


def on_one_grid(streams: Sequence[SalvagedStream]) -> list[SalvagedStream]:
    """Keep the longest gap-free run of the model grid, since steps are addressed by number."""
    grid = [stream for stream in streams if stream.descriptor.name in GRID_STREAMS]
    if not grid:
        return list(streams)
    count = max(len(stream.kept) for stream in grid)
    whole = np.ones(count, dtype=bool)
    for stream in grid:
        whole[: len(stream.kept)] &= stream.kept
        whole[len(stream.kept) :] = False
    edges = np.flatnonzero(np.diff(np.concatenate([[False], whole, [False]]).astype(np.int8)))
    run = np.zeros(count, dtype=bool)
    if len(edges):
        best = int(np.argmax(edges[1::2] - edges[::2]))
        run[edges[2 * best] : edges[2 * best + 1]] = True
    return [
        replace(s, kept=run[: len(s.kept)]) if s.descriptor.name in GRID_STREAMS else s
        for s in streams
    ]


def _holds(streams: Sequence[StreamDescriptor], row: np.void, body: bytes | None) -> bool:
    if body is None or row["stream"] >= len(streams):
        return False
    descriptor = streams[int(row["stream"])]
    try:
        check_batch(descriptor, decode_body(descriptor, body, int(row["num_samples"])))
    except (CorruptDataError, InvalidInputError):
        return False
    return True


def _spooled(
    spool: Path, descriptor: StreamDescriptor, rows: np.ndarray, holds: np.ndarray, num_sealed: int
) -> SalvagedStream:
    # A torn tail was never acknowledged, so it does not count as lost, unless the spool was closed.
    count = int(np.flatnonzero(holds)[-1]) + 1 if holds.any() else 0
    rows = rows[:count][holds[:count]]
    ends = rows["first_sample"] + rows["num_samples"]
    kept = np.zeros(max(int(ends[-1]) if len(rows) else 0, num_sealed), dtype=bool)
    for row in rows:
        kept[int(row["first_sample"]) :][: int(row["num_samples"])] = True
    if image_codec(descriptor) == "h264" and len(kept):
        # Whole groups of pictures, since their images depend on each other.
        whole = np.logical_and.reduceat(kept, np.arange(0, len(kept), GOP_IMAGES))
        kept = np.repeat(whole, GOP_IMAGES)[: len(kept)]

    def read(start: int, stop: int, wanted: np.ndarray) -> Block:
        inside = rows[(rows["first_sample"] < stop) & (ends > start)]
        batch = read_batch(spool, descriptor, inside)
        numbers = np.concatenate(
            [np.arange(r["num_samples"]) + int(r["first_sample"]) for r in inside]
        )
        chosen = np.isin(numbers, start + np.flatnonzero(wanted))
        stamps = {stamp: getattr(batch, stamp)[chosen] for stamp in STAMPS["recording"]}
        return batch.values[chosen], stamps

    return SalvagedStream(descriptor, kept, read)


def _salvaged_index(source: LocalFile, entry: ArrayEntry) -> np.ndarray:
    """(offset, length) of each intact storage chunk of a shard, (0, 0) of the others.

    Offsets come from the index where it is right, otherwise from the end of the chunk before, since
    storage chunks are contiguous, and lengths then from the chunks' own headers.
    """
    num_chunks = -(-entry.shape[0] // entry.chunk_rows)
    if num_chunks > _MAX_CHUNKS:
        raise CorruptDataError(
            f"shard: got {num_chunks} storage chunks to look for, expected at most {_MAX_CHUNKS}"
        )
    data = bytes(source.read(0, source.size() or 0))
    limit = len(data) - num_chunks * INDEX_ENTRY_BYTES - CRC_BYTES
    places = [[0, 0]] * num_chunks
    if limit >= 0:
        places = np.frombuffer(data, "<u8", 2 * num_chunks, limit).reshape(-1, 2).tolist()
    found, sure, end, stuck, follows = [], 0, 0, -1, True
    for offset, length in places:
        place, is_inside = (offset, length), offset + length <= limit
        # Behind a chunk that was found lies the next one: a cut index names others.
        is_right = is_inside and (offset == sure if follows else offset > sure)
        if not is_right or not _is_intact(data[offset : offset + length]):
            place = (end, _chunk_bytes(data, end, entry) if end != stuck else 0)
        follows = place[1] > 0
        if follows:
            sure = end = sum(place)
        else:
            place, stuck, end = (0, 0), end, max(end, offset + length if is_inside else 0)
        found.append(place)
    return np.array(found, dtype=np.uint64).reshape(-1, 2)


def _is_intact(chunk: bytes) -> bool:
    if len(chunk) <= CRC_BYTES:
        return False
    crc = int.from_bytes(chunk[-CRC_BYTES:], "little")
    return google_crc32c.value(chunk[:-CRC_BYTES]) == crc


def _chunk_bytes(data: bytes, start: int, entry: ArrayEntry) -> int:
    """Length of the storage chunk at an offset, checksum included; 0 if there is none."""
    if entry.codec == "jpeg":
        # No image takes twice the bytes of its pixels.
        end = start + 2 * math.prod(entry.shape[1:]) + 65_536
        stop = data.find(_JPEG_END, start, end)
        # An end marker inside a thumbnail is ruled out by the checksum.
        while stop >= 0 and not _is_intact(data[start : stop + 2 + CRC_BYTES]):
            stop = data.find(_JPEG_END, stop + 1, end)
        return stop + 2 + CRC_BYTES - start if stop >= 0 else 0
    length = _encoded_bytes(data, start, entry) + CRC_BYTES
    return length if _is_intact(data[start : start + length]) else 0


def _encoded_bytes(data: bytes, start: int, entry: ArrayEntry) -> int:
    """Length declared by a zstd frame or a group of pictures; 0 if there is none."""
    if entry.codec == "zstd":
        size = entry.chunk_rows * math.prod(entry.shape[1:]) * np.dtype(entry.dtype).itemsize
        rest = data[start : start + size + size // 8 + 1024]
        frame = zstandard.ZstdDecompressor().decompressobj()
        with suppress(zstandard.ZstdError):
            # Nothing larger than a storage chunk is decompressed.
            if zstandard.get_frame_parameters(rest).content_size == size:
                frame.decompress(rest)
        return len(rest) - len(frame.unused_data) if frame.eof else 0
    count = int.from_bytes(data[start : start + 4], "little")
    head = 4 * (1 + count)
    if not 1 <= count <= entry.chunk_rows or len(data) < start + head:
        return 0
    return head + sum(struct.unpack_from(f"<{count}I", data, start + 4))
