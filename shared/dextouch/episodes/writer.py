"""Writer of a new episode or recording, which appears atomically on commit.

It is written in a folder of its own, the stage. What an interrupted writer leaves of a stage is
never read: a sweep removes it.
"""

import errno
import os
import shutil
import uuid
from collections.abc import Iterator, Mapping
from pathlib import Path

import numpy as np

from dextouch.data_folder import is_system_file
from dextouch.episodes.files import (
    disk_errors,
    is_folder_at,
    make_held_folder,
    sync_files,
    sync_folder,
    try_lock,
    write_file,
)
from dextouch.episodes.format import (
    COMMIT_FILE,
    METADATA_FILE,
    STAMPS,
    ArrayEntry,
    Attributes,
    CommitRecord,
    Kind,
    array_metadata,
    attributes_id,
    encode_commit,
    group_metadata,
    kind_of,
    sha256_hex,
    shard_path,
    stream_arrays,
)
from dextouch.episodes.stream_writer import StreamWriter
from dextouch.errors import ConflictError, InvalidInputError, UnknownNameError
from dextouch.schemas import json_ready
from dextouch.streams import (
    ENCODED_UNITS,
    MAX_STREAMS,
    NO_DEVICE_TIME,
    NO_SEQUENCE,
    StreamDescriptor,
)

STAGING = ".staging"


def new_stage(root: Path, kind: Kind, item_id: str) -> Path:
    """A unique path for a new stage; the folder is not created."""
    return root / STAGING / f"{kind}-{item_id}-{uuid.uuid4().hex}"


def unheld_folders(parent: Path) -> Iterator[Path]:
    """Iterate over folders not locked by a writer, holding each one's lock meanwhile."""
    for folder in sorted(parent.iterdir()) if parent.is_dir() else []:
        if is_system_file(folder.name):
            continue
        try:
            lock = try_lock(folder)
        except FileNotFoundError:
            continue  # committed since we listed
        if lock is None:
            continue
        try:
            # Its writer may have committed and unlocked it before we locked it.
            if is_folder_at(lock, folder):
                yield folder
        finally:
            os.close(lock)


def sweep_stages(root: Path) -> int:
    """Remove abandoned stages, which killed writers have left, and return their number."""
    removed = 0
    for stage in unheld_folders(root / STAGING):
        shutil.rmtree(stage)
        removed += 1
    return removed


def commit_stage(
    stage: Path, target: Path, attributes: Attributes, entries: Mapping[str, ArrayEntry]
) -> None:
    """Write metadata and commit record of finished arrays and rename the stage to its target.

    Raises ConflictError if the target exists.
    """
    group = group_metadata(json_ready(attributes))
    record = CommitRecord(
        kind=kind_of(attributes),
        id=attributes_id(attributes),
        attributes_sha256=sha256_hex(group),
        arrays=dict(entries),
    )
    with disk_errors(f"commit {record.id}"):
        for name, entry in entries.items():
            write_file(stage / name / METADATA_FILE, array_metadata(entry), sync=False)
        write_file(stage / METADATA_FILE, group, sync=False)
        # Everything in the commit record is synced before the record itself.
        shards = [stage / name / shard_path(len(entry.shape)) for name, entry in entries.items()]
        metadata = [stage / name / METADATA_FILE for name in entries]
        sync_files([*shards, *metadata, stage / METADATA_FILE])
        write_file(stage / COMMIT_FILE, encode_commit(record)[0])
    if target.exists():
        raise _taken(target)
    with disk_errors(f"commit {record.id}"):
        sync_folder(stage)
        target.parent.mkdir(parents=True, exist_ok=True)
        # Renaming a folder onto one that is not empty fails, so a race cannot overwrite.
        try:
            stage.rename(target)
        except OSError as error:
            if error.errno not in {errno.ENOTEMPTY, errno.EEXIST}:
                raise
            raise _taken(target) from error
        sync_folder(target.parent)


def _taken(target: Path) -> ConflictError:
    return ConflictError(
        f"{target.parent.name.rstrip('s')} {target.name!r} exists already; choose another id"
    )


class EpisodeWriter:
    """Writes one episode or recording to a stage and publishes it on commit.

    Use it as a context manager (from `EpisodeStore.writer`): leaving it normally commits. After an
    exception, Ctrl-C included, nothing is left, and of a killed writer only a stage that
    `EpisodeStore.sweep` removes. A take is kept by its spool (`dextouch.episodes.spool`) until it
    is committed. Streams listed in the attributes are added at the start.
    """

    def __init__(self, *, stage: Path, target: Path, attributes: Attributes) -> None:
        self._stage, self._target = stage, target
        self._attributes, self._kind = attributes, kind_of(attributes)
        self._streams: dict[str, StreamWriter] = {}
        with disk_errors(f"create {stage}"):
            # Locked as long as the writer lives, so that no sweep takes the stage for abandoned.
            self._lock = make_held_folder(stage)
        try:
            for descriptor in attributes.streams:
                self.add_stream(descriptor)
        except BaseException:
            self._leave()
            raise

    def add_stream(self, descriptor: StreamDescriptor) -> None:
        """Add a stream.

        Raises:
            ConflictError: one of its arrays has the name of an array that exists.
            InvalidInputError: one stream more than MAX_STREAMS, a `jpeg` or `h264` stream that
                does not hold uint8 [h, w, 3], or an `h264` stream of odd height or width.
        """
        if len(self._streams) >= MAX_STREAMS:
            raise InvalidInputError(
                f"{attributes_id(self._attributes)}: stream {descriptor.name!r} exceeds the limit, "
                f"expected at most {MAX_STREAMS} streams; put some into one stream of a larger "
                f"shape, or write a second {self._kind}"
            )
        if descriptor.unit in ENCODED_UNITS and (
            descriptor.dtype != "uint8" or len(descriptor.shape) != 3 or descriptor.shape[2] != 3
        ):
            raise InvalidInputError(
                f"{descriptor.name}: got {descriptor.dtype} {descriptor.shape}, "
                f"expected uint8 [h, w, 3] for unit {descriptor.unit!r}"
            )
        taken = {name for stream in self._streams.values() for name in stream.arrays}
        for name in stream_arrays(descriptor, self._kind):
            if name in taken:
                raise ConflictError(f"stream {descriptor.name!r}: array {name!r} exists already")
        self._streams[descriptor.name] = StreamWriter(self._stage, descriptor, self._kind)

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
        """Append a block of samples to an added stream.

        Values are `[n, *shape]` of the stream's dtype; finite in episodes. For the units `jpeg` and
        `h264` they are uint8 images [n, h, w, 3], or an object array of encoded images (bytes),
        stored unchanged. Episodes need exactly `t_ref_ns` [n], strictly increasing; recordings
        `t_host_ns` [n], non-decreasing, and where there are any `t_device_ns` and `sequence`, with
        NO_DEVICE_TIME and NO_SEQUENCE where absent.

        Raises:
            UnknownNameError: no such stream.
            InvalidInputError: stamps of the other kind or out of order, or unfit values.
            StorageFullError: the disk is full.
            StorageError: an earlier block of the stream was interrupted.
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
        """Replace the attributes, for values known only at the end (success, ledger).

        Raises InvalidInputError for another kind or id than the writer was opened for.
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

    def __exit__(self, kind: type[BaseException] | None, *_: object) -> None:
        try:
            if kind is None:
                self._commit()
        finally:
            self._leave()

    def _leave(self) -> None:
        """Close the files and remove the stage, which a commit has moved away."""
        try:
            for stream in self._streams.values():
                stream.close()
        finally:
            try:
                shutil.rmtree(self._stage, ignore_errors=True)
            finally:
                os.close(self._lock)

    def _commit(self) -> None:
        if not self._streams:
            raise InvalidInputError(f"{attributes_id(self._attributes)}: has no stream")
        entries = {
            name: entry
            for stream in self._streams.values()
            for name, entry in stream.finish().items()
        }
        descriptors = tuple(stream.descriptor for stream in self._streams.values())
        attributes = self._attributes.model_copy(update={"streams": descriptors})
        commit_stage(self._stage, self._target, attributes, entries)
