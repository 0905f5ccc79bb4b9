"""Spool of a recording: a crash-safe, append-only folder of sample batches.

A station records to a spool first, and the store keeps an upload in one until it is finished.
Images of `jpeg` and `h264` streams are object arrays of bytes.
"""

import os
import shutil
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from dextouch.episodes.files import disk_errors, replace_file, sync_folder, try_lock, write_file
from dextouch.episodes.format import sha256_hex
from dextouch.episodes.spool_log import (
    CLOSED_FILE,
    LOG_FILE,
    LOG_MAGIC,
    RECORDING_FILE,
    LogRecords,
    Seal,
    SpoolLogWriter,
    decode_attributes,
    encode_attributes,
    has_checksum,
    read_batch,
    read_bodies,
    read_recording_file,
    read_records,
    read_seal,
    trusted_records,
)
from dextouch.errors import (
    ConflictError,
    CorruptDataError,
    InvalidInputError,
    StorageError,
    UnknownNameError,
)
from dextouch.schemas import RecordingAttributes
from dextouch.streams import (
    MAX_STREAMS,
    EncodedBatch,
    SampleBatch,
    check_batch,
    check_follows,
    encode_samples,
    sample_ends,
)

__all__ = ["LOG_FILE", "SpoolReader", "SpoolWriter", "read_attributes"]


class SpoolReader:
    """Reads the complete records of a spool, even while it is being written.

    The log is scanned on first access; records appended later are not visible. A closed spool must
    be as it was when it was closed.

    Raises NotFoundError without a spool, CorruptDataError for damaged attributes, or if it is
    closed and has changed since.
    """

    def __init__(self, path: Path) -> None:
        self.path, self._where = path, f"spool {path.name!r}"
        # Before the attributes, which a writer that is closing the spool may change until then.
        self.closed, self._seal = False, None
        with disk_errors(f"open {self._where}"):
            try:
                self._seal = read_seal(path)
                self.closed = True
            except (FileNotFoundError, NotADirectoryError):
                pass  # being written, or left by a crash
        text = read_recording_file(path)
        self.attributes = decode_attributes(text, what=self._where)
        self.streams = {d.name: d for d in self.attributes.streams}
        self._records: LogRecords | None = None
        self._rows: dict[str, np.ndarray] = {}
        if self._seal is not None:
            self._check_seal(self._seal, text)
        elif self.closed and has_checksum(text):
            raise self._changed(f"{CLOSED_FILE!r} is empty")

    def num_samples(self, stream_name: str) -> int:
        """Number of samples of a stream when the log was scanned.

        Raises UnknownNameError without the stream, CorruptDataError for damage other than a torn
        tail.
        """
        return int(self._stream_rows(stream_name)["num_samples"].sum())

    def read(self, stream_name: str, start: int = 0, stop: int | None = None) -> SampleBatch:
        """Samples start … stop-1 of a stream, verified.

        Raises InvalidInputError outside the stream, CorruptDataError for a checksum mismatch.
        """
        stop = self.num_samples(stream_name) if stop is None else stop
        rows, skipped = self._span(stream_name, start, stop)
        batch = read_batch(self.path, self.streams[stream_name], rows)
        wanted = slice(skipped, skipped + stop - start)
        return SampleBatch(*(column[wanted] for column in vars(batch).values()))

    def body(self, stream_name: str, start: int, stop: int) -> bytes:
        """The bytes of samples start … stop-1 as they lie in the log; raises as `read`."""
        rows, skipped = self._span(stream_name, start, stop)
        descriptor, count = self.streams[stream_name], int(rows["num_samples"].sum())
        body = b"".join(read_bodies(self.path, rows))
        if count == stop - start:
            return body
        ends = [0, *sample_ends(descriptor, body, count, where=self._where)]
        return body[ends[skipped] : ends[skipped + stop - start]]

    def appended(self, stream_name: str, number: int) -> bytes:
        """The bytes of one append, numbered from 0; raises as `read`."""
        rows = self._stream_rows(stream_name)
        if not 0 <= number < len(rows):
            raise InvalidInputError(
                f"{stream_name}: got append {number}, expected within 0 … {len(rows) - 1}"
            )
        (body,) = read_bodies(self.path, rows[number : number + 1])
        return body

    def scan(self) -> LogRecords:
        """All records of the log, of which a torn tail is none; raises as `num_samples`."""
        if self._records is None:
            records = read_records(self.path)
            self._check_records(records)
            self._records = records
        return self._records

    def is_empty(self) -> bool:
        """Whether nothing was ever appended.

        Raises CorruptDataError if something was, but no sample of it is whole.
        """
        records = trusted_records(self.path, self.scan())
        if not len(records.rows) and records.num_bytes > len(LOG_MAGIC):
            raise CorruptDataError(
                f"{self._where}: no record in the {records.num_bytes} bytes of its log is whole; "
                "restore it from a copy, or remove the take"
            )
        return not len(records.rows)

    def _check_records(self, records: LogRecords) -> None:
        rows = records.rows
        if self.closed and records.gaps:
            start, stop = records.gaps[0]
            raise self._changed(f"bytes {start} … {stop - 1} of its log are no record")
        if len(rows) and int(rows["stream"].max()) >= len(self.streams):
            raise CorruptDataError(
                f"{self._where}: its log has a stream number "
                f"{int(rows['stream'].max())}, {RECORDING_FILE} has {len(self.streams)} streams"
            )
        if self._seal is not None:
            got = _num_samples(rows, list(self.streams))
            if got != self._seal.num_samples:
                raise self._changed(f"samples {got}, expected {self._seal.num_samples}")
            if sha256_hex(rows.tobytes()) != self._seal.records_sha256:
                raise self._changed("its log has other records")

    def _check_seal(self, seal: Seal, text: bytes) -> None:
        with disk_errors(f"open {self._where}"):
            log = self.path / LOG_FILE
            log_bytes = log.stat().st_size if log.is_file() else 0
        what = ""
        if sha256_hex(text) != seal.recording_sha256:
            what = f"{RECORDING_FILE} is not the one it was closed with"
        elif set(seal.num_samples) != set(self.streams):
            what = f"streams {sorted(self.streams)}, expected {sorted(seal.num_samples)}"
        elif log_bytes != seal.log_bytes:
            what = f"its log has {log_bytes} bytes, expected {seal.log_bytes}"
        if what:
            raise self._changed(what)

    def _changed(self, what: str) -> CorruptDataError:
        return CorruptDataError(
            f"{self._where} was closed and has changed since: {what}; restore its files from a "
            f"copy, or remove {CLOSED_FILE!r}: then what is left is recovered as an interrupted "
            "take"
        )

    def _span(self, stream_name: str, start: int, stop: int) -> tuple[np.ndarray, int]:
        """The records with samples start … stop-1, and the number of samples in them before."""
        rows, total = self._stream_rows(stream_name), self.num_samples(stream_name)
        if not 0 <= start <= stop <= total:
            raise InvalidInputError(
                f"{stream_name}: got samples {start} … {stop}, expected within 0 … {total}"
            )
        first = int(np.searchsorted(rows["first_sample"], start, side="right")) - 1
        last = int(np.searchsorted(rows["first_sample"], stop, side="left"))
        rows = rows[max(0, first) : max(0, first, last)]
        return rows, start - int(rows["first_sample"][0]) if len(rows) else 0

    def _stream_rows(self, name: str) -> np.ndarray:
        if name not in self.streams:
            raise UnknownNameError("stream", name, list(self.streams))
        if name not in self._rows:
            rows = self.scan().rows
            self._rows[name] = rows[rows["stream"] == list(self.streams).index(name)]
        return self._rows[name]


def _num_samples(rows: np.ndarray, names: list[str]) -> dict[str, int]:
    return {
        name: int(rows["num_samples"][rows["stream"] == number].sum())
        for number, name in enumerate(names)
    }


def read_attributes(path: Path) -> RecordingAttributes:
    """Attributes of a spool's recording; raises as `SpoolReader`."""
    return decode_attributes(read_recording_file(path), what=f"spool {path.name!r}")


@dataclass
class _Appended:
    """What a spool holds of a stream; the last stamp is a lower bound of the next one."""

    number: int
    num_samples: int = 0
    num_batches: int = 0
    last_t_host_ns: int | None = None


class SpoolWriter:
    """Appends batches to the streams of one recording.

    After `append` returns, the samples survive a crash of the process; after `flush` with `sync`,
    also a power loss. `attributes.streams` names all streams; `notes` are further small files of a
    new folder, by name.

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
        notes: Mapping[str, bytes] | None = None,
    ) -> None:
        self.path, self.attributes = path, attributes
        self._sync = sync
        self._streams = {d.name: _Appended(number) for number, d in enumerate(attributes.streams)}
        if not resume:
            _create(path, attributes, notes or {})
        lock = try_lock(path)
        if lock is None:
            raise ConflictError(f"spool {path.name!r}: another process is writing it")
        self._lock = lock
        self.torn_bytes, self.lost_samples = 0, dict[str, int]()
        try:
            self._log = SpoolLogWriter(path, self._resume())
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

        What is cut off is in `torn_bytes`, and in `lost_samples` where its stream is known. Raises
        as `SpoolReader`, and ConflictError if another process is writing it.
        """
        return cls(path, read_attributes(path), sync=sync, resume=True)

    def append(self, stream_name: str, batch: SampleBatch) -> None:
        """Append consecutive samples of a stream; cheap enough for every arrival.

        `t_host_ns` never decreases. Values of `jpeg` and `h264` streams are an object array of
        bytes, one per image (`dextouch.streams.encoded_values`).

        Raises:
            UnknownNameError: no such stream.
            InvalidInputError: a batch that does not fit the stream.
            StorageFullError: no space; everything appended before stays.
        """
        record = self.encode(stream_name, batch)
        if record is not None:
            self.append_record(record)

    def encode(self, stream_name: str, batch: SampleBatch) -> EncodedBatch | None:
        """Encode a batch for `append_record`; None for an empty one. Raises as `append`.

        It does not change the writer: threads may call it while another one appends.
        """
        descriptor = self.attributes.streams[self._stream(stream_name).number]
        if len(batch):
            return encode_samples(descriptor, batch)
        check_batch(descriptor, batch)
        return None

    def append_record(self, record: EncodedBatch, *, flush: bool = False) -> None:
        """Append an encoded batch as `append` does; with `flush` it is kept only if synced, too."""
        stream = self._stream(record.stream_name)
        check_follows(record.stream_name, record.first_t_host_ns, stream.last_t_host_ns)
        place = self._log.append(record, stream=stream.number, first_sample=stream.num_samples)
        self._is_dirty = True
        if flush:
            try:
                self.flush()
            except StorageError:
                self._log.undo(place)
                raise
        stream.num_samples += record.num_samples
        stream.num_batches += 1
        stream.last_t_host_ns = record.last_t_host_ns

    def num_samples(self, stream_name: str) -> int:
        """Number of samples of a stream in the spool."""
        return self._stream(stream_name).num_samples

    def num_batches(self, stream_name: str) -> int:
        """Number of appends of a stream."""
        return self._stream(stream_name).num_batches

    def flush(self) -> None:
        """Sync appended records to disk (unless opened with `sync=False`)."""
        if self._sync and self._is_dirty:
            self._log.sync()
        self._is_dirty = False

    def set_attributes(self, attributes: RecordingAttributes) -> None:
        """Replace attributes of the recording (ledger, success).

        Raises InvalidInputError for another id or other streams.
        """
        ours = self.attributes
        if (attributes.recording_id, attributes.streams) != (ours.recording_id, ours.streams):
            raise InvalidInputError(
                f"spool {ours.recording_id!r}: new attributes must keep its id and streams"
            )
        with disk_errors(f"write attributes of spool {self.path.name}"):
            replace_file(self.path / RECORDING_FILE, encode_attributes(attributes))
        self.attributes = attributes

    def close(self) -> None:
        """Flush and seal the complete recording; closing twice does nothing.

        Raises StorageError if the disk refused; the spool is open: try again or abandon it.
        """
        if self._lock < 0:
            return
        self.flush()
        seal = Seal(
            num_samples={name: s.num_samples for name, s in self._streams.items()},
            log_bytes=self._log.end,
            records_sha256=self._log.records_sha256,
            recording_sha256=sha256_hex(read_recording_file(self.path)),
        )
        with disk_errors(f"close spool {self.path.name}"):
            replace_file(self.path / CLOSED_FILE, seal.model_dump_json().encode())
        self.abandon()

    def abandon(self) -> None:
        """Close the files without marking the recording as complete."""
        self._log.close()
        if self._lock >= 0:
            os.close(self._lock)
            self._lock = -1

    def __enter__(self) -> "SpoolWriter":
        return self

    def __exit__(self, kind: type[BaseException] | None, *_: object) -> None:
        try:
            if kind is None:
                self.close()
        finally:
            self.abandon()

    def _stream(self, name: str) -> _Appended:
        if name not in self._streams:
            raise UnknownNameError("stream", name, list(self._streams))
        return self._streams[name]

    def _resume(self) -> LogRecords:
        """Count the samples of the log; returns the records after which it goes on."""
        reader = SpoolReader(self.path)
        records = trusted_records(self.path, reader.scan())
        self.torn_bytes = max(0, records.num_bytes - records.end)
        kept = _num_samples(records.rows, list(self._streams))
        lost = {name: reader.num_samples(name) - count for name, count in kept.items()}
        self.lost_samples = {name: count for name, count in lost.items() if count}
        with disk_errors(f"resume spool {self.path.name}"):
            (self.path / CLOSED_FILE).unlink(missing_ok=True)
        for stream in self._streams.values():
            rows = records.rows[records.rows["stream"] == stream.number]
            stream.num_samples, stream.num_batches = int(rows["num_samples"].sum()), len(rows)
            if len(rows):
                last = read_batch(self.path, self.attributes.streams[stream.number], rows[-1:])
                stream.last_t_host_ns = int(last.t_host_ns[-1])
        return records


def _create(path: Path, attributes: RecordingAttributes, notes: Mapping[str, bytes]) -> None:
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
    # Created under a temporary name, so that a visible spool always has its files.
    unborn = path.with_name(path.name + ".new")
    with disk_errors(f"create spool {path.name}"):
        if path.exists():
            raise ConflictError(f"spool {path.name!r} exists; resume or remove it")
        shutil.rmtree(unborn, ignore_errors=True)
        unborn.mkdir(parents=True)
        write_file(unborn / RECORDING_FILE, encode_attributes(attributes))
        write_file(unborn / LOG_FILE, LOG_MAGIC)
        for name, data in notes.items():
            write_file(unborn / name, data)
        unborn.rename(path)
