"""Zstandard compression with thread-local contexts and bounded decompression.

Creating a context costs as much as decompressing a storage chunk.
"""

import threading

import zstandard

from dextouch.episodes.format import ZSTD_LEVEL
from dextouch.errors import CorruptDataError

# Far above current chunks (1 MiB, or one sample), and above the half second of raw images that
# earlier releases wrote.
MAX_CHUNK_BYTES = 1 << 29
_REPEATED = 1


class _Contexts(threading.local):
    def __init__(self) -> None:
        self.compressor = zstandard.ZstdCompressor(level=ZSTD_LEVEL)
        self.decompressor = zstandard.ZstdDecompressor()


_CONTEXTS = _Contexts()


def compress(data: bytes) -> bytes:
    """Compress bytes to one frame."""
    return _CONTEXTS.compressor.compress(data)


def decompress(frame: bytes, *, size: int, what: str) -> bytes:
    """Decompress a single frame of exactly `size` bytes.

    Raises:
        CorruptDataError: another size or trailing data, or more than MAX_CHUNK_BYTES; `what` names
            the frame in errors.
    """
    if size > MAX_CHUNK_BYTES:
        raise CorruptDataError(f"{what}: is of {size} bytes, expected at most {MAX_CHUNK_BYTES}")
    try:
        # Checked before decompression: a decompression bomb declares a size that is never
        # allocated.
        said = zstandard.get_frame_parameters(frame).content_size
        if said != size:
            raise CorruptDataError(f"{what}: holds {said} bytes, expected {size}")
        return _CONTEXTS.decompressor.decompress(frame, allow_extra_data=False)
    except zstandard.ZstdError as error:
        raise CorruptDataError(f"{what}: no zstd frame of {size} bytes ({error})") from error


def content_bytes(frame: bytes) -> int:
    """Content size declared by a zstd frame; 0 if absent or not a frame."""
    try:
        said = int(zstandard.get_frame_parameters(frame).content_size)
    except zstandard.ZstdError:
        return 0
    return 0 if said == zstandard.CONTENTSIZE_UNKNOWN else said


def frame_bytes(frame: bytes) -> int | None:
    """Length of the first zstd frame, found by walking its blocks; None if it is incomplete."""
    try:
        place = zstandard.frame_header_size(frame)
        has_checksum = zstandard.get_frame_parameters(frame).has_checksum
    except zstandard.ZstdError:
        return None
    last = False
    while not last:
        header = int.from_bytes(frame[place : place + 3], "little")
        last, kind, size = bool(header & 1), header >> 1 & 3, header >> 3
        place += 3 + (1 if kind == _REPEATED else size)
        if place > len(frame):
            return None
    place += 4 * has_checksum
    return place if place <= len(frame) else None
