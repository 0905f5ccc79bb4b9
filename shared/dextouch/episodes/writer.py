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
    METADATA_FILE,
    STAMPS,
    CommitRecord,
    Kind,
    array_names,
    encode_commit,
    group_metadata,
    sha256_hex,
)
from dextouch.episodes.stream_writer import StreamWriter
from dextouch.errors import (
    ConflictError,
    InvalidInputError,
    UnknownNameError,
)
from dextouch.schemas.episodes import EpisodeAttributes, json_ready
from dextouch.schemas.recordings import RecordingAttributes
from dextouch.streams.checks import JPEG_UNIT
from dextouch.streams.descriptors import StreamDescriptor
from dextouch.streams.samples import NO_DEVICE_TIME, NO_SEQUENCE

Attributes = EpisodeAttributes | RecordingAttributes


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
        self._streams: dict[str, StreamWriter] = {}
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
                stream.close()
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
            name: entry
            for stream in self._streams.values()
            for name, entry in stream.finish().items()
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
