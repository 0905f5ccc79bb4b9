"""Writer of a new episode or recording, which appears atomically on commit."""

import os
import shutil
from collections.abc import Iterable
from contextlib import suppress
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
from dextouch.episodes.staged_group import commit_stage, write_stage
from dextouch.episodes.staging_recovery import RecoveredGroup, recover_stage
from dextouch.episodes.stream_writer import StreamWriter, WriteOptions
from dextouch.errors import (
    ConflictError,
    DexTouchError,
    InvalidInputError,
    StorageError,
    UnknownNameError,
)
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
    exception, Ctrl-C included, appended samples are kept if the writer is `recoverable`, as
    recordings are by default: the take is committed as far as it was written, with `recovered` set.
    Where that is impossible, as on a full disk, its stage is kept and `EpisodeStore.recover`
    completes it later; a note on the exception says which of the two. Other writers leave nothing
    behind after an exception. Streams listed in the attributes are added at the start.

    Args:
        stage: new folder on the store's file system.
        target: where the group appears at commit.
        attributes: of an episode or a recording.
        options: durability and speed.
    """

    def __init__(
        self, *, stage: Path, target: Path, attributes: Attributes, options: WriteOptions
    ) -> None:
        self._stage, self._target, self._options = stage, target, options
        self._attributes, self._kind = attributes, kind_of(attributes)
        self._streams: dict[str, StreamWriter] = {}
        keep = self._kind == "recording" if options.recoverable is None else options.recoverable
        # Whether `stage.json` must be written before the next sample.
        self._unannounced, self._recoverable = keep, keep
        self._is_discarded = False
        with disk_errors(f"create {stage}"):
            # Lock held as long as the writer lives, so that a sweep does not consider the stage
            # abandoned.
            self._lock = make_held_folder(stage)
        try:
            for descriptor in attributes.streams:
                self.add_stream(descriptor)
        except BaseException:
            self.discard()
            self._leave(interrupted=True, error=None)
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
        self._unannounced = self._recoverable

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
            InvalidInputError: stamps of the other kind or out of order, values of another dtype or
                shape, or a writer that was discarded.
            StorageFullError: the disk is full.
            StorageError: an earlier block of the stream was interrupted.
        """
        if self._is_discarded:
            raise InvalidInputError(
                f"{name}: a sample for {attributes_id(self._attributes)!r}, which was discarded"
            )
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
        if self._unannounced:
            write_stage(self._stage, self._with_streams())
            self._unannounced = False
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
        self._unannounced = self._recoverable

    def __enter__(self) -> "EpisodeWriter":
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        try:
            if kind is None and not self._is_discarded:
                self._commit()
        except BaseException as failure:
            self._leave(interrupted=True, error=failure)
            raise
        self._leave(interrupted=kind is not None, error=error)

    def discard(self) -> None:
        """Discard everything written when the context is left, normally or not."""
        self._is_discarded = True

    def _leave(self, *, interrupted: bool, error: BaseException | None) -> None:
        keep = interrupted and self._recoverable and not self._is_discarded
        try:
            if keep:
                keep = self._keep(error)
        finally:
            for stream in self._streams.values():
                stream.close()
            # Also after another interrupt: a recoverable stage is kept until it is committed.
            if not keep:
                shutil.rmtree(self._stage, ignore_errors=True)
            os.close(self._lock)

    def _keep(self, error: BaseException | None) -> bool:
        """Commit the take as far as written; returns whether its stage is left to `recover`."""
        what = f"{self._kind} {attributes_id(self._attributes)!r}"
        for stream in self._streams.values():
            # On a full disk, the storage chunks written so far are kept.
            with suppress(StorageError):
                stream.keep()
        try:
            with suppress(StorageError):
                write_stage(self._stage, self._with_streams())
            group = self._complete()
        except DexTouchError as failure:
            where = f" in {self._stage}" if self._stage.exists() else ""
            told = (
                f"{what}: what was appended is kept{where}, but could not be completed "
                f"({failure.message}); EpisodeStore.recover completes it"
            )
        else:
            if group is None:
                return False
            counts = ", ".join(f"{name}: {count}" for name, count in group.num_samples.items())
            told = (
                f"{what}: what was appended is kept as {group.item_id!r}, marked as recovered "
                f"(samples of {counts})"
            )
        if error is not None:
            error.add_note(told)
        return self._stage.exists()

    def _complete(self) -> RecoveredGroup | None:
        """Commit the stage, as a writer to a bucket overrides; None if there is nothing to keep."""
        return recover_stage(self._stage, self._target.parent.parent)

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
    """Write a group that can be written again: names of streams with blocks of their samples.

    Stage and target are those of `EpisodeWriter`. After an exception nothing is left.
    """
    options = WriteOptions(recoverable=False)
    with EpisodeWriter(
        stage=stage, target=target, attributes=attributes, options=options
    ) as writer:
        for name, blocks in streams:
            for values, stamps in blocks:
                writer.append(name, values=values, **stamps)
