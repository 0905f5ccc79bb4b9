"""Writer of a new episode or recording, which appears atomically on commit."""

import os
import shutil
from collections.abc import Iterable
from pathlib import Path
from types import TracebackType

import numpy as np

from dextouch.episodes.files import disk_errors, make_held_folder
from dextouch.episodes.format import (
    STAMPS,
    Attributes,
    attributes_id,
    kind_of,
    stream_arrays,
)
from dextouch.episodes.staged_group import commit_stage
from dextouch.episodes.stream_writer import StreamWriter, WriteOptions
from dextouch.errors import ConflictError, InvalidInputError, UnknownNameError
from dextouch.streams import (
    ENCODED_UNITS,
    MAX_STREAMS,
    NO_DEVICE_TIME,
    NO_SEQUENCE,
    StreamDescriptor,
)

# Values, and stamps by name.
Block = tuple[np.ndarray, dict[str, np.ndarray]]


class EpisodeWriter:
    """Writes one episode or recording to a stage and publishes it on commit.

    Use it as a context manager (from `EpisodeStore.writer`): leaving it normally commits. After an
    exception, Ctrl-C included, nothing is left, and of a killed writer only a stage that
    `EpisodeStore.sweep` removes. A take is kept by its spool (`dextouch.episodes.spool`) until it
    is committed. Streams listed in the attributes are added at the start.

    Args:
        stage: new folder on the store's file system.
        target: where the group appears at commit.
        attributes: of an episode or a recording.
        options: quality and speed.
    """

    def __init__(
        self, *, stage: Path, target: Path, attributes: Attributes, options: WriteOptions
    ) -> None:
        self._stage, self._target, self._options = stage, target, options
        self._attributes, self._kind = attributes, kind_of(attributes)
        self._streams: dict[str, StreamWriter] = {}
        with disk_errors(f"create {stage}"):
            # Lock held as long as the writer lives, so that a sweep does not consider the stage
            # abandoned.
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
        self._streams[descriptor.name] = StreamWriter(
            self._stage, descriptor, self._kind, self._options
        )

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
            name: of an added stream.
            values: `[n, *shape]` of the stream's dtype; finite in episodes. For the units `jpeg`
                and `h264` uint8 images [n, h, w, 3], or an object array of encoded images (bytes),
                stored unchanged.
            t_ref_ns: [n], strictly increasing; episodes need exactly this stamp.
            t_host_ns: [n], non-decreasing; required for recordings.
            t_device_ns: [n]; recordings only, NO_DEVICE_TIME where absent.
            sequence: [n]; recordings only, NO_SEQUENCE where absent.

        Raises:
            UnknownNameError: no such stream.
            InvalidInputError: stamps of the other kind or out of order, or values of another dtype
                or shape.
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
        commit_stage(self._stage, self._target, self._with_streams(), entries)

    def _with_streams(self) -> Attributes:
        descriptors = tuple(stream.descriptor for stream in self._streams.values())
        return self._attributes.model_copy(update={"streams": descriptors})


def write_blocks(
    stage: Path,
    target: Path,
    attributes: Attributes,
    streams: Iterable[tuple[str, Iterable[Block]]],
) -> None:
    """Write a group of streams, by name, with blocks of their samples.

    Stage and target are those of `EpisodeWriter`.
    """
    with EpisodeWriter(
        stage=stage, target=target, attributes=attributes, options=WriteOptions()
    ) as writer:
        for name, blocks in streams:
            for values, stamps in blocks:
                writer.append(name, values=values, **stamps)
