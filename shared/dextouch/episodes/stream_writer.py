"""Blocks of one stream → its arrays in a group that is being written, after every check."""

from pathlib import Path

import numpy as np

from dextouch.episodes.files import disk_errors, write_file
from dextouch.episodes.format import (
    JPEG_CHUNK_BYTES,
    JPEG_END_SUFFIX,
    METADATA_FILE,
    STAMPS,
    ArrayEntry,
    Kind,
    array_metadata,
    array_names,
    chunk_rows,
    shard_path,
)
from dextouch.episodes.shards import ShardWriter
from dextouch.errors import InvalidInputError, NonFiniteError, ShapeError, StorageError
from dextouch.images.jpeg import encode_jpeg, jpeg_size
from dextouch.streams.checks import JPEG_UNIT
from dextouch.streams.descriptors import StreamDescriptor


class ArrayWriter:
    """One array: its shard and what the commit record will say about it."""

    def __init__(
        self,
        path: Path,
        *,
        dtype: str,
        row_shape: tuple[int, ...],
        chunk_rows: int,
        time_dimension: str,
    ) -> None:
        self._path, self._dtype, self._row_shape = path, dtype, row_shape
        self._chunk_rows = chunk_rows
        axes = (f"{path.name}_axis{axis}" for axis in range(1, 1 + len(row_shape)))
        self._dimension_names = (time_dimension, *axes)
        self._shard = ShardWriter(
            path / shard_path(1 + len(row_shape)),
            dtype=np.dtype(dtype).newbyteorder("<"),
            row_shape=row_shape,
            chunk_rows=chunk_rows,
        )

    def append(self, rows: np.ndarray) -> None:
        """Append rows of the array's dtype and shape."""
        self._shard.append(rows)

    def finish(self) -> ArrayEntry:
        """Write what is left and the metadata."""
        digest = self._shard.finish()
        entry = ArrayEntry.model_validate(
            {
                "dtype": self._dtype,
                "shape": (self._shard.num_rows, *self._row_shape),
                "chunk_rows": self._chunk_rows,
                "dimension_names": self._dimension_names,
                "sha256": digest,
            }
        )
        with disk_errors(f"write metadata of {self._path.name}"):
            write_file(self._path / METADATA_FILE, array_metadata(entry))
        return entry

    def close(self) -> None:
        """Give the file back."""
        self._shard.close()


class StreamWriter:
    """One stream: its values, its stamps, and the checks that every block passes."""

    def __init__(self, folder: Path, descriptor: StreamDescriptor, kind: Kind) -> None:
        self.descriptor, self._kind = descriptor, kind
        self._last_stamp_ns: int | None = None
        self._num_bytes = 0
        self._is_jpeg = descriptor.unit == JPEG_UNIT
        name, rows, time = descriptor.name, chunk_rows(descriptor), f"{descriptor.name}_time"
        if self._is_jpeg:
            values = ArrayWriter(
                folder / name,
                dtype="uint8",
                row_shape=(),
                chunk_rows=JPEG_CHUNK_BYTES,
                time_dimension=f"{name}_byte",
            )
        else:
            values = ArrayWriter(
                folder / name,
                dtype=descriptor.dtype,
                row_shape=descriptor.shape,
                chunk_rows=rows,
                time_dimension=time,
            )
        self.arrays = {name: values}
        for other in array_names(descriptor, kind)[1:]:
            self.arrays[other] = ArrayWriter(
                folder / other,
                dtype="int64",
                row_shape=(),
                chunk_rows=rows,
                time_dimension=time,
            )

    def append(self, values: np.ndarray, stamps: dict[str, np.ndarray]) -> None:
        """Append a block with all stamps of the kind; raises as `EpisodeWriter.append`."""
        name = self.descriptor.name
        for stamp, column in stamps.items():
            if column.dtype != np.int64 or column.shape != (len(values),):
                raise ShapeError(
                    f"{name}: {stamp} is {column.dtype} {column.shape}, expected int64 "
                    f"[{len(values)}] like the values"
                )
        if not len(values):
            return
        # All checks come before the first byte, so that a refused block leaves no trace.
        first = stamps[STAMPS[self._kind][0]]
        if self._is_jpeg:
            images = self._encoded(values)
            self._check_order(first)
            self._append_images(images)
        else:
            checked = self._checked(values)
            self._check_order(first)
            self.arrays[name].append(checked)
        for stamp, column in stamps.items():
            self.arrays[f"{name}_{stamp}"].append(column)

    def _check_order(self, stamps_ns: np.ndarray) -> None:
        # Arrival stamps may repeat: a device can hand over several samples at once.
        least = 1 if self._kind == "episode" else 0
        last = [] if self._last_stamp_ns is None else [self._last_stamp_ns]
        steps = np.diff(np.concatenate([np.array(last, dtype=np.int64), stamps_ns]))
        bad = np.flatnonzero(steps < least)
        if len(bad):
            raise InvalidInputError(
                f"{self.descriptor.name}: stamp goes from sample to sample by "
                f"{int(steps[bad[0]])} ns at place {int(bad[0])} of this block, expected at "
                f"least {least} ns; sort the samples or drop the repeated ones"
            )
        self._last_stamp_ns = int(stamps_ns[-1])

    def _checked(self, values: np.ndarray) -> np.ndarray:
        descriptor = self.descriptor
        if values.dtype != descriptor.numpy_dtype() or values.shape[1:] != descriptor.shape:
            raise ShapeError(
                f"{descriptor.name}: got values {values.dtype} {values.shape}, expected "
                f"{descriptor.dtype} [n, {', '.join(map(str, descriptor.shape))}]"
            )
        # Recordings stay as the device spoke; in an episode nothing downstream expects NaN.
        if self._kind == "episode" and values.dtype.kind == "f" and not np.isfinite(values).all():
            raise NonFiniteError(
                f"{descriptor.name}: {int((~np.isfinite(values)).sum())} values are NaN or "
                "infinite; leave invalid samples out of an episode"
            )
        return values

    def _encoded(self, values: np.ndarray) -> list[bytes]:
        """JPEG bytes are kept as they are; uint8 images are encoded here."""
        name, shape = self.descriptor.name, self.descriptor.shape
        images = list(values) if values.dtype == object else [encode_jpeg(v) for v in values]
        for index, data in enumerate(images):
            size = jpeg_size(data, where=f"{name}: image {index} of this block")
            if size != shape[:2]:
                raise ShapeError(f"{name}: image {index} is {size} pixels, expected {shape[:2]}")
        return images

    def _append_images(self, images: list[bytes]) -> None:
        name = self.descriptor.name
        ends = self._num_bytes + np.cumsum([len(data) for data in images], dtype=np.int64)
        self._num_bytes = int(ends[-1])
        self.arrays[name].append(np.frombuffer(b"".join(images), dtype=np.uint8))
        self.arrays[name + JPEG_END_SUFFIX].append(ends)

    def finish(self) -> dict[str, ArrayEntry]:
        """Complete all arrays; what the commit record says about each.

        Raises:
            StorageError: a block was written in part, since the disk failed in the middle.
        """
        entries = {name: array.finish() for name, array in self.arrays.items()}
        name = self.descriptor.name
        counts = {n: e.shape[0] for n, e in entries.items() if n != name or not self._is_jpeg}
        if len(set(counts.values())) != 1:
            raise StorageError(f"{name}: a block was written in part ({counts}); write it anew")
        return entries

    def close(self) -> None:
        """Give the files back."""
        for array in self.arrays.values():
            array.close()
