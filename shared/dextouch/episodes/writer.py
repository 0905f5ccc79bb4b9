"""Blocks of samples → a new episode or recording that appears whole or not at all."""

import errno
import fcntl
import os
import shutil
from pathlib import Path
from types import TracebackType

import numpy as np

from dextouch.episodes.files import disk_errors, sync_folder, write_file
from dextouch.episodes.format import (
    COMMIT_FILE,
    JPEG_CHUNK_BYTES,
    JPEG_END_SUFFIX,
    METADATA_FILE,
    STAMPS,
    ArrayEntry,
    CommitRecord,
    Kind,
    array_metadata,
    array_names,
    chunk_rows,
    encode_commit,
    group_metadata,
    sha256_hex,
    shard_path,
)
from dextouch.episodes.shards import ShardWriter
from dextouch.errors import (
    ConflictError,
    InvalidInputError,
    NonFiniteError,
    ShapeError,
    UnknownNameError,
)
from dextouch.images.jpeg import encode_jpeg, jpeg_size
from dextouch.schemas.episodes import EpisodeAttributes, json_ready
from dextouch.schemas.recordings import RecordingAttributes
from dextouch.streams.checks import JPEG_UNIT
from dextouch.streams.descriptors import StreamDescriptor
from dextouch.streams.samples import NO_DEVICE_TIME, NO_SEQUENCE

Attributes = EpisodeAttributes | RecordingAttributes


class _ArrayWriter:
    """One array: its shard and what the commit record will say about it."""

    def __init__(
        self,
        path: Path,
        *,
        dtype: str,
        row_shape: tuple[int, ...],
        chunk_rows: int,
        compress: bool,
        time_dimension: str,
    ) -> None:
        self._path, self._dtype, self._row_shape = path, dtype, row_shape
        self._chunk_rows, self._codec = chunk_rows, "zstd" if compress else "plain"
        axes = (f"{path.name}_axis{axis}" for axis in range(1, 1 + len(row_shape)))
        self._dimension_names = (time_dimension, *axes)
        self._shard = ShardWriter(
            path / shard_path(1 + len(row_shape)),
            dtype=np.dtype(dtype).newbyteorder("<"),
            row_shape=row_shape,
            chunk_rows=chunk_rows,
            compress=compress,
        )

    def append(self, rows: np.ndarray) -> None:
        self._shard.append(rows)

    def finish(self) -> ArrayEntry:
        digest = self._shard.finish()
        entry = ArrayEntry.model_validate(
            {
                "dtype": self._dtype,
                "shape": (self._shard.num_rows, *self._row_shape),
                "chunk_rows": self._chunk_rows,
                "codec": self._codec,
                "dimension_names": self._dimension_names,
                "sha256": digest,
            }
        )
        with disk_errors(f"write metadata of {self._path.name}"):
            write_file(self._path / METADATA_FILE, array_metadata(entry))
        return entry

    def close(self) -> None:
        self._shard.close()


class _StreamWriter:
    """One stream: its values, its stamps, and the checks that every block passes."""

    def __init__(self, folder: Path, descriptor: StreamDescriptor, kind: Kind) -> None:
        self.descriptor, self._kind = descriptor, kind
        self._last_stamp_ns: int | None = None
        self._num_bytes = 0
        self._is_jpeg = descriptor.unit == JPEG_UNIT
        name, rows, time = descriptor.name, chunk_rows(descriptor), f"{descriptor.name}_time"
        if self._is_jpeg:
            values = _ArrayWriter(
                folder / name,
                dtype="uint8",
                row_shape=(),
                chunk_rows=JPEG_CHUNK_BYTES,
                compress=False,
                time_dimension=f"{name}_byte",
            )
        else:
            values = _ArrayWriter(
                folder / name,
                dtype=descriptor.dtype,
                row_shape=descriptor.shape,
                chunk_rows=rows,
                compress=True,
                time_dimension=time,
            )
        self.arrays = {name: values}
        for other in array_names(descriptor, kind)[1:]:
            self.arrays[other] = _ArrayWriter(
                folder / other,
                dtype="int64",
                row_shape=(),
                chunk_rows=rows,
                compress=True,
                time_dimension=time,
            )

    def append(self, values: np.ndarray, stamps: dict[str, np.ndarray]) -> None:
        name = self.descriptor.name
        for stamp, column in stamps.items():
            if column.dtype != np.int64 or column.shape != (len(values),):
                raise ShapeError(
                    f"{name}: {stamp} is {column.dtype} {column.shape}, expected int64 "
                    f"[{len(values)}] like the values"
                )
        if not len(values):
            return
        self._check_order(stamps[STAMPS[self._kind][0]])
        if self._is_jpeg:
            self._append_images(values)
        else:
            self.arrays[name].append(self._checked(values))
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

    def _append_images(self, values: np.ndarray) -> None:
        """Object array of JPEG bytes (kept as they are) or uint8 images (encoded here)."""
        name, shape = self.descriptor.name, self.descriptor.shape
        if values.dtype != object:
            values = np.array([*map(encode_jpeg, values), b""], dtype=object)[:-1]
        for index, data in enumerate(values):
            size = jpeg_size(data, where=f"{name}: image {index} of this block")
            if size != shape[:2]:
                raise ShapeError(f"{name}: image {index} is {size} pixels, expected {shape[:2]}")
        lengths = np.array([len(data) for data in values], dtype=np.int64)
        ends = self._num_bytes + np.cumsum(lengths)
        self._num_bytes = int(ends[-1])
        self.arrays[name].append(np.frombuffer(b"".join(values), dtype=np.uint8))
        self.arrays[name + JPEG_END_SUFFIX].append(ends)


class EpisodeWriter:
    """Writes one episode or recording beside the store and moves it in when all is well.

    Use it as a context manager (from `EpisodeStore.writer`): leaving normally commits, an
    exception leaves nothing behind. Streams listed in the attributes are there from the start.

    Args:
        stage: new folder on the store's file system.
        target: where the group appears at commit.
        kind: "episode" or "recording".
        attributes: of that kind.
    """

    def __init__(self, *, stage: Path, target: Path, kind: Kind, attributes: Attributes) -> None:
        self._stage, self._target, self._kind = stage, target, kind
        self._attributes = attributes
        self._streams: dict[str, _StreamWriter] = {}
        with disk_errors(f"create {stage}"):
            stage.mkdir(parents=True)
            # Held as long as the writer lives: tells a sweep that this stage is not abandoned.
            self._lock = os.open(stage, os.O_RDONLY)
            fcntl.flock(self._lock, fcntl.LOCK_EX)
        for descriptor in attributes.streams:
            self.add_stream(descriptor)

    def add_stream(self, descriptor: StreamDescriptor) -> None:
        """Announce a stream.

        Raises:
            ConflictError: one of its arrays has the name of an array that exists.
            InvalidInputError: a `jpeg` stream that does not hold uint8 [h, w, 3].
        """
        if descriptor.unit == JPEG_UNIT and (
            descriptor.dtype != "uint8" or len(descriptor.shape) != 3 or descriptor.shape[2] != 3
        ):
            raise InvalidInputError(
                f"{descriptor.name}: got {descriptor.dtype} {descriptor.shape}, "
                "expected uint8 [h, w, 3] for unit 'jpeg'"
            )
        taken = {name for stream in self._streams.values() for name in stream.arrays}
        for name in array_names(descriptor, self._kind):
            if name in taken:
                raise ConflictError(f"stream {descriptor.name!r}: array {name!r} exists already")
        self._streams[descriptor.name] = _StreamWriter(self._stage, descriptor, self._kind)

    def append(
        self,
        name: str,
        *,
        values: np.ndarray,
        t_ref_ns: np.ndarray | None = None,
        t_host_ns: np.ndarray | None = None,
        t_device_ns: np.ndarray | None = None,
        sequence: np.ndarray | None = None,
    ) -> None:
        """Append a block of samples to a stream.

        Args:
            name: of an announced stream.
            values: [n, *shape] of the stream's dtype; finite in episodes. For unit `jpeg` uint8
                images [n, h, w, 3], or an object array of JPEG bytes that is kept as it is.
            t_ref_ns: [n], strictly increasing; episodes need exactly this stamp.
            t_host_ns: [n], never decreasing; recordings need it.
            t_device_ns: [n]; recordings only, NO_DEVICE_TIME where absent.
            sequence: [n]; recordings only, NO_SEQUENCE where absent.

        Raises:
            UnknownNameError: no such stream.
            InvalidInputError: stamps of the other kind, out of order, or values that do not fit.
            StorageFullError: the disk is full.
        """
        if name not in self._streams:
            raise UnknownNameError("stream", name, list(self._streams))
        given = {
            "t_ref_ns": t_ref_ns,
            "t_host_ns": t_host_ns,
            "t_device_ns": t_device_ns,
            "sequence": sequence,
        }
        stamps = {key: np.asarray(column) for key, column in given.items() if column is not None}
        values = np.asarray(values)
        if self._kind == "recording":
            blank = np.full(len(values), NO_DEVICE_TIME, dtype=np.int64)
            stamps.setdefault("t_device_ns", blank)
            stamps.setdefault("sequence", np.full(len(values), NO_SEQUENCE, dtype=np.int64))
        if set(stamps) != set(STAMPS[self._kind]):
            raise InvalidInputError(
                f"{name}: got stamps {sorted(stamps)}, expected {list(STAMPS[self._kind])} "
                f"in a block of {self._kind}"
            )
        self._streams[name].append(values, stamps)

    def set_attributes(self, attributes: Attributes) -> None:
        """Replace the attributes with ones that are known only at the end (success, ledger).

        Raises:
            InvalidInputError: of another kind or id than the writer was opened for.
        """
        if type(attributes) is not type(self._attributes) or attributes_id(
            attributes
        ) != attributes_id(self._attributes):
            raise InvalidInputError(
                f"attributes: got {attributes_id(attributes)!r}, expected the same kind and id "
                f"as {attributes_id(self._attributes)!r}"
            )
        self._attributes = attributes

    def __enter__(self) -> "EpisodeWriter":
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        try:
            if kind is None:
                self._commit()
        finally:
            for stream in self._streams.values():
                for array in stream.arrays.values():
                    array.close()
            shutil.rmtree(self._stage, ignore_errors=True)
            os.close(self._lock)

    def _commit(self) -> None:
        if not self._streams:
            raise InvalidInputError(f"{attributes_id(self._attributes)}: has no stream")
        descriptors = tuple(stream.descriptor for stream in self._streams.values())
        group = group_metadata(
            json_ready(self._attributes.model_copy(update={"streams": descriptors}))
        )
        entries = {
            name: array.finish()
            for stream in self._streams.values()
            for name, array in stream.arrays.items()
        }
        record = CommitRecord(
            kind=self._kind,
            id=attributes_id(self._attributes),
            attributes_sha256=sha256_hex(group),
            arrays=entries,
        )
        with disk_errors(f"commit {record.id}"):
            write_file(self._stage / METADATA_FILE, group)
            write_file(self._stage / COMMIT_FILE, encode_commit(record)[0])
            sync_folder(self._stage)
            self._target.parent.mkdir(parents=True, exist_ok=True)
            self._move_into_place()
            sync_folder(self._target.parent)

    def _move_into_place(self) -> None:
        # Renaming a folder onto one that is not empty fails, so a race cannot overwrite.
        try:
            self._stage.rename(self._target)
        except OSError as error:
            if error.errno not in {errno.ENOTEMPTY, errno.EEXIST}:
                raise
            raise ConflictError(
                f"{self._kind} {self._target.name!r} exists already; choose another id"
            ) from error


def attributes_id(attributes: Attributes) -> str:
    """The id that attributes carry, whatever their kind."""
    if isinstance(attributes, EpisodeAttributes):
        return attributes.episode_id
    return attributes.recording_id
