"""Reconstruction of a damaged or missing shard index from the storage chunks themselves."""

import math
import struct

import google_crc32c
import numpy as np

from dextouch.episodes.format import ArrayEntry
from dextouch.episodes.shard_reader import CRC_BYTES, INDEX_ENTRY_BYTES
from dextouch.episodes.sources import ByteSource
from dextouch.episodes.zstd import frame_bytes
from dextouch.errors import CorruptDataError

# One day of 30 images per second, each a storage chunk.
_MAX_CHUNKS = 86_400 * 30
_JPEG_END = b"\xff\xd9"


def salvaged_index(source: ByteSource, entry: ArrayEntry) -> np.ndarray:
    """(offset, length) of each intact storage chunk, (0, 0) of the others.

    Offsets come from the index where it is plausible, otherwise from neighbouring chunks, since
    storage chunks are contiguous; in a truncated file, from the chunks' own headers.

    Raises:
        CorruptDataError: more storage chunks than the limit of this reader.
    """
    num_chunks = -(-entry.shape[0] // entry.chunk_rows)
    if num_chunks > _MAX_CHUNKS:
        raise CorruptDataError(
            f"shard: got {num_chunks} storage chunks to look for, expected at most {_MAX_CHUNKS}"
        )
    data = bytes(source.read(0, source.size() or 0))
    end = len(data) - num_chunks * INDEX_ENTRY_BYTES - CRC_BYTES
    if end >= 0:
        body = data[end : len(data) - CRC_BYTES]
        places = np.frombuffer(body, dtype="<u8").reshape(-1, 2).tolist()
    else:
        places = [[0, 0]] * num_chunks
    found = [_place(data, places, number, max(end, 0)) for number in range(num_chunks)]
    if not any(length for _, length in found):
        walked = _walk(data, entry)[:num_chunks]
        found = walked + [(0, 0)] * (num_chunks - len(walked))
    return np.array(found, dtype=np.uint64).reshape(-1, 2)


def _place(data: bytes, places: list[list[int]], number: int, end: int) -> tuple[int, int]:
    """Offset and length of a storage chunk by its own index entry or by its neighbours'."""
    offset, length = places[number]
    before = sum(places[number - 1]) if number else 0
    after = places[number + 1][0] if number + 1 < len(places) else end
    for start, stop in (
        (offset, offset + length),
        (before, after),
        (before, before + length),
        (offset, after),
    ):
        if start < stop <= end and _holds(data[start:stop]):
            return start, stop - start
    return 0, 0


def _holds(chunk: bytes) -> bool:
    if len(chunk) <= CRC_BYTES:
        return False
    crc = int.from_bytes(chunk[-CRC_BYTES:], "little")
    return google_crc32c.value(chunk[:-CRC_BYTES]) == crc


def _walk(data: bytes, entry: ArrayEntry) -> list[tuple[int, int]]:
    """Intact storage chunks from the first byte up to the first damaged one."""
    found, start = [], 0
    while start < len(data) and (length := _chunk_bytes(data, start, entry)):
        found.append((start, length))
        start += length
    return found


def _chunk_bytes(data: bytes, start: int, entry: ArrayEntry) -> int:
    """Length of the storage chunk at an offset, checksum included; 0 if there is none."""
    if entry.codec == "jpeg":
        stop = data.find(_JPEG_END, start)
        # An end marker inside a thumbnail is ruled out by the checksum.
        while stop >= 0 and not _holds(data[start : stop + 2 + CRC_BYTES]):
            stop = data.find(_JPEG_END, stop + 1)
        return stop + 2 + CRC_BYTES - start if stop >= 0 else 0
    length = _encoded_bytes(data, start, entry)
    return length + CRC_BYTES if length and _holds(data[start : start + length + CRC_BYTES]) else 0


def _encoded_bytes(data: bytes, start: int, entry: ArrayEntry) -> int:
    """Length declared by a zstd frame or a group of pictures; 0 if there is none."""
    if entry.codec == "zstd":
        # Only block headers are parsed, which is far less than is copied.
        longest = entry.chunk_rows * math.prod(entry.shape[1:]) * np.dtype(entry.dtype).itemsize
        return frame_bytes(data[start : start + longest + longest // 8 + 1024]) or 0
    count = int.from_bytes(data[start : start + 4], "little")
    head = 4 * (1 + count)
    if not 1 <= count <= entry.chunk_rows or len(data) < start + head:
        return 0
    return head + sum(struct.unpack_from(f"<{count}I", data, start + 4))
