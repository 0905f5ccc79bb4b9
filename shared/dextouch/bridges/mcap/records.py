"""Record-by-record reading of untrusted MCAP files, with bounded allocations."""

import struct
from collections.abc import Iterator
from pathlib import Path
from typing import BinaryIO, Final

import zstandard
from mcap.exceptions import McapError
from mcap.records import Attachment, Channel, Chunk, DataEnd, McapRecord, Message, Metadata, Schema
from mcap.stream_reader import StreamReader, breakup_chunk

from dextouch.episodes import disk_errors
from dextouch.errors import (
    CorruptDataError,
    InvalidInputError,
    LimitExceededError,
    NotFoundError,
)

MAX_RECORD_BYTES: Final = 1 << 28
MAGIC: Final = b"\x89MCAP0\r\n"
_WANTED = (Attachment, Channel, DataEnd, Message, Metadata, Schema)


class _Bounded:
    """A file that never reads (and so never allocates) beyond its end."""

    def __init__(self, file: BinaryIO, size: int) -> None:
        self._file, self._left = file, size

    def read(self, size: int = -1) -> bytes:
        wanted = self._left if size < 0 else size
        if wanted > self._left:
            raise EOFError(f"{wanted} bytes requested, {self._left} are left")
        self._left -= wanted
        return self._file.read(wanted)


def records(path: Path) -> Iterator[McapRecord]:
    """Schemas, channels, messages, attachments and metadata in the order of the file.

    Raises:
        NotFoundError: no such file.
        InvalidInputError: not an MCAP file, or an unsupported compression.
        CorruptDataError: truncated, or a checksum mismatch.
        LimitExceededError: a record exceeds the size limit.
    """
    if not path.is_file():
        raise NotFoundError(f"{path}: no such file; expected an MCAP file")
    with disk_errors(f"read {path}"), path.open("rb") as file:
        if file.read(len(MAGIC)) != MAGIC:
            raise InvalidInputError(f"{path}: is not an MCAP file (wrong magic bytes)")
        file.seek(0)
        try:
            yield from _records(file, path)
        except EOFError as error:
            raise CorruptDataError(f"{path}: is truncated ({error}); copy it again") from error
        except (McapError, ValueError, KeyError, struct.error, zstandard.ZstdError) as error:
            raise CorruptDataError(
                f"{path}: is damaged or truncated ({type(error).__name__}: {error}); copy it "
                "again, or see what `mcap recover` saves"
            ) from error


def _records(file: BinaryIO, path: Path) -> Iterator[McapRecord]:
    bounded = _Bounded(file, path.stat().st_size)
    reader = StreamReader(
        bounded,  # type: ignore[arg-type]
        emit_chunks=True,
        validate_crcs=True,
        record_size_limit=MAX_RECORD_BYTES,
    )
    for record in reader.records:
        if isinstance(record, Chunk):
            for inner in breakup_chunk(_opened(record, path), validate_crc=True):
                if isinstance(inner, _WANTED):
                    yield inner
        elif isinstance(record, _WANTED):
            yield record


def _opened(chunk: Chunk, path: Path) -> Chunk:
    """Decompress a chunk after checking its declared size."""
    if chunk.uncompressed_size > MAX_RECORD_BYTES:
        raise LimitExceededError(
            f"{path}: a chunk announces {chunk.uncompressed_size} bytes, expected at most "
            f"{MAX_RECORD_BYTES}; write it with smaller chunks"
        )
    if chunk.compression == "":
        data = chunk.data
    elif chunk.compression == "zstd":
        with zstandard.ZstdDecompressor().stream_reader(chunk.data) as stream:
            # At most one byte more than declared, never an unbounded output.
            data = stream.read(chunk.uncompressed_size + 1)
    else:
        raise InvalidInputError(
            f"{path}: got chunks compressed as {chunk.compression!r}, expected 'zstd' or none; "
            "convert it with `mcap compress --compression zstd`"
        )
    if len(data) != chunk.uncompressed_size:
        raise CorruptDataError(
            f"{path}: a chunk decompresses to {len(data)} bytes or more, it announces "
            f"{chunk.uncompressed_size}"
        )
    chunk.data, chunk.compression = data, ""
    return chunk
