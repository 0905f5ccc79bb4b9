"""Zarr v2 groups in one zip file, written and read without zarr; `zarr.open` reads them too.

Storage chunks are zstd, zip entries are uncompressed
(https://zarr-specs.readthedocs.io/en/latest/v2/v2.0.html). The reader does not trust the file:
names, sizes and shapes are checked before anything is allocated, and a missing storage chunk is an
error, never zeros. Equal content gives equal bytes.

zarr's own `ZipStore` (3.1.6) gives none of this: it dates entries by the clock, writes the metadata
of an array that grows again under the same name, and reads a missing storage chunk as zeros.
"""

import json
import math
import zipfile
import zlib
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, Final, Literal

import numpy as np
import zstandard
from jaxtyping import Shaped
from pydantic import Field, ValidationError

from dextouch.episodes import disk_errors
from dextouch.errors import (
    CorruptDataError,
    InvalidInputError,
    LimitExceededError,
    NotFoundError,
    StorageError,
)
from dextouch.frozen_model import FrozenModel
from dextouch.schemas import first_problems

ZSTD_LEVEL: Final = 1
# Rows of a storage chunk of numbers.
CHUNK_ROWS: Final = 256
MAX_CHUNK_BYTES: Final = 1 << 27
MAX_METADATA_BYTES: Final = 1 << 26
MAX_ROWS: Final = 1 << 40
# The earliest date a zip can name: equal content gives equal bytes.
_DATE = (1980, 1, 1, 0, 0, 0)

Size = Annotated[int, Field(ge=1, le=1 << 20)]


class _Zstd(FrozenModel):
    id: Literal["zstd"] = "zstd"
    level: int = ZSTD_LEVEL


class ArrayMetadata(FrozenModel):
    """`.zarray` of one array; only the features modelled here are supported."""

    zarr_format: Literal[2] = 2
    shape: tuple[Annotated[int, Field(ge=0, le=MAX_ROWS)], ...] = Field(min_length=1, max_length=6)
    chunks: tuple[Size, ...] = Field(min_length=1, max_length=6)
    dtype: Literal["|b1", "|u1", "<u2", "<i8", "<f4", "<f8"]
    compressor: _Zstd = _Zstd()
    fill_value: float | bool | None = 0
    order: Literal["C"] = "C"
    filters: None = None
    dimension_separator: Literal["."] = "."

    def chunk_bytes(self) -> int:
        """Bytes of one storage chunk, decoded."""
        return math.prod(self.chunks) * np.dtype(self.dtype).itemsize


@dataclass
class _NewArray:
    """An array that grows: its rows in storage chunks, and those that fill none yet."""

    pending: Shaped[np.ndarray, "n ..."]
    chunk_rows: int
    num_rows: int = 0

    def metadata(self) -> ArrayMetadata:
        row_shape, dtype = self.pending.shape[1:], self.pending.dtype.str
        return ArrayMetadata.model_validate(
            {
                "shape": (self.num_rows + len(self.pending), *row_shape),
                "chunks": (self.chunk_rows, *row_shape),
                "dtype": dtype,
                "fill_value": False if dtype == "|b1" else 0,
            }
        )


class ZarrZipWriter:
    """Appends rows to the arrays of a new zip file; buffers one storage chunk per array."""

    def __init__(self, path: Path) -> None:
        self._zip = zipfile.ZipFile(path, "x", zipfile.ZIP_STORED)
        self._arrays: dict[str, _NewArray] = {}
        self._zstd = zstandard.ZstdCompressor(level=ZSTD_LEVEL)

    def append(self, name: str, rows: np.ndarray, *, chunk_rows: int = CHUNK_ROWS) -> None:
        """Append rows [n, ...] to the array `GROUP/NAME`.

        The first rows set its type, one of `ArrayMetadata`, the shape of its rows and the length of
        its storage chunks.
        """
        array = self._arrays.setdefault(name, _NewArray(rows[:0], chunk_rows))
        row_shape, dtype = array.pending.shape[1:], array.pending.dtype
        if (rows.shape[1:], rows.dtype) != (row_shape, dtype):
            raise InvalidInputError(
                f"{name}: got rows of {rows.dtype} {rows.shape[1:]}, expected {dtype} {row_shape}"
            )
        pending = np.concatenate([array.pending, rows])
        while len(pending) >= array.chunk_rows:
            self._write_chunk(name, array, pending[: array.chunk_rows])
            array.num_rows += array.chunk_rows
            pending = pending[array.chunk_rows :]
        array.pending = pending.copy()

    def _write_chunk(self, name: str, array: _NewArray, rows: np.ndarray) -> None:
        key = ".".join([str(array.num_rows // array.chunk_rows), *("0" for _ in rows.shape[1:])])
        self._write(f"{name}/{key}", self._zstd.compress(rows.tobytes()))

    def _write(self, name: str, data: bytes) -> None:
        self._zip.writestr(zipfile.ZipInfo(name, _DATE), data)

    def finish(self, attributes: Mapping[str, Mapping[str, Any]]) -> None:
        """Write buffered rows, the metadata, and attributes by name ("" is the root group)."""
        groups = {"", *(name.rpartition("/")[0] for name in self._arrays)}
        for name in [*sorted(groups), *self._arrays]:
            prefix, array = f"{name}/" if name else "", self._arrays.get(name)
            if array is None:
                self._write(f"{prefix}.zgroup", _json({"zarr_format": 2}))
            else:
                if len(array.pending):
                    missing = [(0, array.chunk_rows - len(array.pending))]
                    missing += [(0, 0)] * (array.pending.ndim - 1)
                    self._write_chunk(name, array, np.pad(array.pending, missing))
                self._write(f"{prefix}.zarray", _json(array.metadata().model_dump()))
            if name in attributes:
                self._write(f"{prefix}.zattrs", _json(attributes[name]))
        self._zip.close()

    def close(self) -> None:
        """Close the file; without a prior `finish` it is not a valid zip file."""
        self._zip.close()


def _json(value: object) -> bytes:
    return json.dumps(value, sort_keys=True, indent=1, allow_nan=False).encode()


@contextmanager
def zip_errors(path: Path) -> Iterator[None]:
    """Context manager that translates zip file errors to DexTouch errors."""
    try:
        with disk_errors(f"read {path}"):
            yield
    except (zipfile.BadZipFile, zlib.error, EOFError) as error:
        raise CorruptDataError(
            f"{path}: is not a complete zip file ({error}); copy or export it again"
        ) from error
    except NotImplementedError as error:
        raise StorageError(f"{path}: uses a zip feature that is not supported ({error})") from error


class ZarrZipReader:
    """Reads rows of arrays of a Zarr v2 group in an untrusted zip file.

    Raises:
        NotFoundError: no such file.
        CorruptDataError: not a zip file, or entries that are not part of a Zarr group.
    """

    def __init__(self, path: Path) -> None:
        if not path.is_file():
            raise NotFoundError(f"{path}: no such file; expected a zip file")
        self._path = path
        self._arrays: dict[str, ArrayMetadata] = {}
        with zip_errors(path):
            self._zip = zipfile.ZipFile(path)
        self._entries: dict[str, zipfile.ZipInfo] = {}
        for entry in self._zip.infolist():
            name = entry.filename
            parts = name.rstrip("/").split("/")
            if name in self._entries or {"", ".."} & {*parts} or "\\" in name or ":" in name:
                self.close()
                raise CorruptDataError(
                    f"{path}: holds an entry named {name!r} that leads elsewhere or comes twice; "
                    "refused"
                )
            self._entries[name] = entry

    def close(self) -> None:
        """Close the file."""
        self._zip.close()

    def __contains__(self, name: str) -> bool:
        return f"{name}/.zarray" in self._entries

    def attributes(self, name: str) -> dict[str, Any]:
        """`.zattrs` of a group or an array; empty where there are none."""
        key = f"{name}/.zattrs" if name else ".zattrs"
        if key not in self._entries:
            return {}
        try:
            value = json.loads(self._bytes(key, MAX_METADATA_BYTES))
        except (ValueError, RecursionError) as error:
            raise CorruptDataError(f"{self._path}: {key} is not JSON ({error})") from error
        if not isinstance(value, dict):
            raise CorruptDataError(f"{self._path}: {key} is not a JSON object")
        return value

    def metadata(self, name: str) -> ArrayMetadata:
        """Metadata of an array.

        Raises:
            NotFoundError: no such array.
            CorruptDataError: invalid metadata, or an unsupported kind of array.
        """
        if name not in self._arrays:
            key = f"{name}/.zarray"
            if name not in self:
                raise NotFoundError(f"{self._path}: holds no array {name!r}")
            try:
                metadata = ArrayMetadata.model_validate_json(self._bytes(key, MAX_METADATA_BYTES))
            except ValidationError as error:
                raise CorruptDataError(
                    f"{self._path}: {key} is invalid ({first_problems(error)})"
                ) from error
            self._check(name, metadata)
            self._arrays[name] = metadata
        return self._arrays[name]

    def _check(self, name: str, metadata: ArrayMetadata) -> None:
        if metadata.chunks[1:] != metadata.shape[1:]:
            raise CorruptDataError(
                f"{self._path}: {name} has storage chunks {metadata.chunks} for shape "
                f"{metadata.shape}, expected whole rows"
            )
        num_bytes = metadata.chunk_bytes()
        if num_bytes > MAX_CHUNK_BYTES:
            raise LimitExceededError(
                f"{self._path}: {name} has storage chunks of {num_bytes} bytes, expected at "
                f"most {MAX_CHUNK_BYTES}"
            )

    def read(self, name: str, start: int, stop: int) -> Shaped[np.ndarray, "n ..."]:
        """Rows start … stop-1 of an array.

        Raises:
            InvalidInputError: rows outside the array.
            CorruptDataError: damaged or missing bytes.
        """
        metadata = self.metadata(name)
        if not 0 <= start <= stop <= metadata.shape[0]:
            raise InvalidInputError(
                f"{self._path}: got rows {start} … {stop} of {name}, expected within 0 … "
                f"{metadata.shape[0]}"
            )
        each, first = metadata.chunks[0], start // metadata.chunks[0]
        empty = np.empty((0, *metadata.shape[1:]), dtype=metadata.dtype)
        chunks = [self._chunk(name, metadata, n) for n in range(first, -(-stop // each))]
        return np.concatenate([empty, *chunks])[start - first * each : stop - first * each]

    def _chunk(self, name: str, metadata: ArrayMetadata, index: int) -> np.ndarray:
        key = f"{name}/" + ".".join([str(index), *("0" for _ in metadata.shape[1:])])
        if key not in self._entries:
            raise CorruptDataError(f"{self._path}: {key} is missing; export it again")
        num_bytes = metadata.chunk_bytes()
        frame = self._bytes(key, MAX_CHUNK_BYTES)
        try:
            with zstandard.ZstdDecompressor().stream_reader(frame) as stream:
                # At most one byte more than expected, never an unbounded output.
                data = stream.read(num_bytes + 1)
        except zstandard.ZstdError as error:
            raise CorruptDataError(f"{self._path}: {key} is damaged ({error})") from error
        if len(data) != num_bytes:
            raise CorruptDataError(
                f"{self._path}: {key} holds {len(data)} bytes or more, expected {num_bytes}"
            )
        return np.frombuffer(data, dtype=metadata.dtype).reshape(metadata.chunks)

    def _bytes(self, key: str, limit: int) -> bytes:
        entry = self._entries[key]
        if entry.flag_bits & 1:
            raise StorageError(f"{self._path}: {key} is encrypted; expected plain entries")
        with zip_errors(self._path), self._zip.open(entry) as file:
            data = file.read(limit + 1)
        if len(data) > limit:
            raise LimitExceededError(
                f"{self._path}: {key} holds more than {limit} bytes, the most that is read"
            )
        return data
