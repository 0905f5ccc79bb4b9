"""Spool of a recording: a crash-safe, append-only folder of sample batches.

A station records to a spool first, and the store keeps an upload in one until it is finished.
Images of `jpeg` and `h264` streams are object arrays of bytes.
"""

import os
import shutil
from dataclasses import replace
from pathlib import Path
from types import TracebackType

from dextouch.episodes.files import disk_errors, replace_file, sync_folder, try_lock, write_file
from dextouch.episodes.spool_log import (
    LOG_FILE,
    LogRecords,
    SpoolLogWriter,
    body_at,
    open_log,
    read_records,
)
from dextouch.episodes.spool_reader import (
    CLOSED_FILE,
    RECORDING_FILE,
    SpoolReader,
    read_attributes,
    read_batch,
)
from dextouch.errors import ConflictError, InvalidInputError, StorageError, UnknownNameError
from dextouch.schemas import RecordingAttributes
from dextouch.streams import (
    MAX_STREAMS,
    EncodedBatch,
    SampleBatch,
    check_batch,
    check_follows,
    encode_samples,
)

__all__ = ["LOG_FILE", "SpoolReader", "SpoolWriter", "read_attributes"]


class SpoolWriter:
    """Appends batches to the streams of one recording.

    After `append` returns, the samples survive a crash of the process; after `flush` with `sync`,
    also a power loss.

    Args:
        path: new folder.
        attributes: of the recording; `streams` names all streams.
        sync: whether `flush` waits for the disk.
        resume: continue an existing folder (see the class method).

    Raises:
        ConflictError: the folder exists; continue it with `SpoolWriter.resume`.
        InvalidInputError: a recording without a stream, or with more than MAX_STREAMS.
    """

    def __init__(
        self,
        path: Path,
        attributes: RecordingAttributes,
        *,
        sync: bool = True,
        resume: bool = False,
    ) -> None:
        self.path, self.attributes = path, attributes
        self._sync = sync
        self._streams = {d.name: number for number, d in enumerate(attributes.streams)}
        self._num_samples = dict.fromkeys(self._streams, 0)
        self._num_batches = dict.fromkeys(self._streams, 0)
        # The last stamp of each stream, a lower bound of the next one.
        self._last_t_host_ns: dict[str, int | None] = dict.fromkeys(self._streams)
        if not resume:
            _create(path, attributes)
        self._lock = _lock(path)
        try:
            self._log = SpoolLogWriter(path, end=self._resume() if resume else None)
        except BaseException:
            os.close(self._lock)
            raise
        # Records that a crashed process wrote but did not sync count as kept from here on.
        self._is_dirty = resume
        self.flush()
        with disk_errors(f"open spool {path.name}"):
            sync_folder(path)

    @classmethod
    def resume(cls, path: Path, *, sync: bool = True) -> "SpoolWriter":
        """Continue after the last valid record of a spool that was closed or crashed.

        Raises:
            NotFoundError: no spool there.
            ConflictError: another process is writing it.
            CorruptDataError: damage other than a torn tail.
        """
        return cls(path, read_attributes(path), sync=sync, resume=True)

    def append(self, stream_name: str, batch: SampleBatch) -> None:
        """Append consecutive samples of a stream; cheap enough for every arrival.

        Args:
            stream_name: one of the recording's streams.
            batch: of the stream's dtype and shape; `t_host_ns` never decreases. Values of `jpeg`
                and `h264` streams are an object array of bytes, one per image
                (`dextouch.streams.encoded_values`).

        Raises:
            UnknownNameError: no such stream.
            InvalidInputError: a batch that does not fit the stream.
            StorageFullError: no space; everything appended before stays.
        """
        record = self.encode(stream_name, batch)
        if record is not None:
            self.append_record(record)

    def encode(self, stream_name: str, batch: SampleBatch) -> EncodedBatch | None:
        """Encode a batch for `append_record`; None for an empty one.

        It does not change the writer, so that several threads can call it while another one
        appends.

        Raises:
            UnknownNameError: no such stream.
            InvalidInputError: a batch that does not fit the stream.
        """
        descriptor = self.attributes.streams[self._number(stream_name)]
        if len(batch):
            return encode_samples(descriptor, batch)
        check_batch(descriptor, batch)
        return None

    def append_record(self, record: EncodedBatch, *, flush: bool = False) -> None:
        """Append an encoded batch, as `append` does.

        Args:
            record: of a stream of this recording.
            flush: keep the batch only if `flush` succeeds too.

        Raises:
            InvalidInputError: it begins before the last sample of its stream.
            StorageFullError: no space; everything appended before stays.
        """
        name = record.stream_name
        check_follows(name, record.first_t_host_ns, self._last_t_host_ns[name])
        place = self._log.append(
            record, stream=self._number(name), first_sample=self._num_samples[name]
        )
        self._is_dirty = True
        if flush:
            try:
                self.flush()
            except StorageError:
                self._log.undo(place)
                raise
        self._num_samples[name] += record.num_samples
        self._num_batches[name] += 1
        self._last_t_host_ns[name] = record.last_t_host_ns

    def num_samples(self, stream_name: str) -> int:
        """Number of samples of a stream in the spool."""
        self._number(stream_name)
        return self._num_samples[stream_name]

    def num_batches(self, stream_name: str) -> int:
        """Number of appends of a stream."""
        self._number(stream_name)
        return self._num_batches[stream_name]

    def flush(self) -> None:
        """Sync appended records to disk (unless opened with `sync=False`)."""
        if self._sync and self._is_dirty:
            self._log.sync()
        self._is_dirty = False

    def set_attributes(self, attributes: RecordingAttributes) -> None:
        """Replace attributes of the recording (ledger, success); id and streams must not change.

        Raises:
            InvalidInputError: another id or other streams.
        """
        ours = self.attributes
        if (attributes.recording_id, attributes.streams) != (ours.recording_id, ours.streams):
            raise InvalidInputError(
                f"spool {ours.recording_id!r}: new attributes must keep its id and streams"
            )
        with disk_errors(f"write attributes of spool {self.path.name}"):
            replace_file(self.path / RECORDING_FILE, attributes.model_dump_json().encode())
        self.attributes = attributes

    def close(self) -> None:
        """Flush and mark the recording as complete; closing twice does nothing."""
        if self._lock < 0:
            return
        try:
            self.flush()
            with disk_errors(f"close spool {self.path.name}"):
                replace_file(self.path / CLOSED_FILE, b"")
        finally:
            self.abandon()

    def abandon(self) -> None:
        """Close the files without marking the recording as complete."""
        self._log.close()
        if self._lock >= 0:
            os.close(self._lock)
            self._lock = -1

    def __enter__(self) -> "SpoolWriter":
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        if kind is None:
            self.close()
        else:
            self.abandon()

    def _number(self, name: str) -> int:
        if name not in self._streams:
            raise UnknownNameError("stream", name, list(self._streams))
        return self._streams[name]

    def _resume(self) -> int:
        """Count the samples of an existing log; returns where it goes on."""
        records = _trusted_records(self.path)
        with disk_errors(f"resume spool {self.path.name}"):
            (self.path / CLOSED_FILE).unlink(missing_ok=True)
        for name, number in self._streams.items():
            rows = records.rows[records.rows["stream"] == number]
            self._num_samples[name] = int(rows["num_samples"].sum())
            self._num_batches[name] = len(rows)
            if len(rows):
                last = read_batch(self.path, self.attributes.streams[number], rows[-1:])
                self._last_t_host_ns[name] = int(last.t_host_ns[-1])
        return records.end


def _create(path: Path, attributes: RecordingAttributes) -> None:
    if not attributes.streams:
        raise InvalidInputError(
            f"spool {attributes.recording_id!r}: a recording without a stream; "
            "name at least one in its attributes"
        )
    if len(attributes.streams) > MAX_STREAMS:
        raise InvalidInputError(
            f"spool {attributes.recording_id!r}: got {len(attributes.streams)} streams, expected "
            f"at most {MAX_STREAMS} streams; put some into one stream of a larger shape"
        )
    # Created under a temporary name, so that a visible spool always has its attributes.
    unborn = path.with_name(path.name + ".new")
    with disk_errors(f"create spool {path.name}"):
        if path.exists():
            raise ConflictError(f"spool {path.name!r} exists; resume or remove it")
        shutil.rmtree(unborn, ignore_errors=True)
        unborn.mkdir(parents=True)
        write_file(unborn / RECORDING_FILE, attributes.model_dump_json().encode())
        unborn.rename(path)


def _trusted_records(path: Path) -> LogRecords:
    """The records of a log without those at its end whose body never reached the disk."""
    if not (path / LOG_FILE).exists():
        # The process died before it created the log.
        SpoolLogWriter(path).close()
    records = read_records(path)
    num_rows = len(records.rows)
    with open_log(path) as data:
        while num_rows and body_at(data, records.rows[num_rows - 1]) is None:
            num_rows -= 1
    return replace(records, rows=records.rows[:num_rows])


def _lock(path: Path) -> int:
    """Lock a spool exclusively; the returned descriptor holds the lock until it is closed.

    Raises:
        ConflictError: another process is writing or recovering it.
    """
    lock = try_lock(path)
    if lock is None:
        raise ConflictError(f"spool {path.name!r}: another process is writing it")
    return lock
