"""Batches of samples ↔ a spool: an append-only folder that a kill at any moment leaves readable.

The spool is where a station records before anything else, and where the store keeps an upload
until it is finished. Images of `jpeg` and `h264` streams travel as object arrays of bytes.
"""

import os
import shutil
from pathlib import Path
from types import TracebackType

import numpy as np

from dextouch.episodes.files import disk_errors, replace_file, sync_folder, write_file
from dextouch.episodes.journal import SAMPLE_JOURNAL, JournalWriter
from dextouch.episodes.recovery import RecoveryReport, lock_spool, recover
from dextouch.episodes.spool_reader import (
    CLOSED_FILE,
    RECORDING_FILE,
    SpoolReader,
    read_attributes,
)
from dextouch.errors import ConflictError, InvalidInputError, UnknownNameError
from dextouch.schemas.recordings import RecordingAttributes
from dextouch.streams.checks import ENCODED_UNITS, check_batch
from dextouch.streams.descriptors import StreamDescriptor
from dextouch.streams.samples import SampleBatch

__all__ = ["RecoveryReport", "SpoolReader", "SpoolWriter", "read_attributes", "recover"]


class SpoolWriter:
    """Appends batches to the streams of one recording.

    After `append` returns, the samples survive the death of the process; after `flush` with
    `sync`, also that of the machine.

    Args:
        path: new folder.
        attributes: of the recording; `streams` names all streams.
        sync: whether `flush` waits for the disk.
        resume: go on with a folder that exists (see the class method).

    Raises:
        ConflictError: the folder exists; go on with `SpoolWriter.resume`.
        InvalidInputError: a recording without a stream.
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
        num_rows: dict[str, int] = {}
        if resume:
            num_rows = {report.stream: report.num_samples for report in recover(path)}
            with disk_errors(f"resume spool {path.name}"):
                (path / CLOSED_FILE).unlink(missing_ok=True)
        else:
            _create(path, attributes)
        self._lock = lock_spool(path)
        self._descriptors = {d.name: d for d in attributes.streams}
        self._journals: dict[str, JournalWriter] = {}
        # The last stamp of each stream, which the next may not go below.
        self._last_t_host_ns: dict[str, int | None] = {}
        for name in self._descriptors:
            self._journals[name] = JournalWriter(
                path, name, SAMPLE_JOURNAL, num_rows=num_rows.get(name)
            )
            self.truncate(name, num_rows.get(name, 0))
        self._dirty: set[str] = set()
        with disk_errors(f"open spool {path.name}"):
            sync_folder(path)

    @classmethod
    def resume(cls, path: Path, *, sync: bool = True) -> "SpoolWriter":
        """Go on after the last good sample of a spool that was closed or crashed.

        Raises:
            NotFoundError: no spool there.
            ConflictError: another process is writing it.
            CorruptDataError: damage that is no torn end.
        """
        return cls(path, read_attributes(path), sync=sync, resume=True)

    def append(self, stream_name: str, batch: SampleBatch) -> None:
        """Append consecutive samples of a stream; cheap enough for every arrival.

        Args:
            stream_name: one of the recording's streams.
            batch: of the stream's dtype and shape; `t_host_ns` never decreases. Values of `jpeg`
                and `h264` streams are an object array of bytes, one an image
                (`dextouch.streams.samples.encoded_values`).

        Raises:
            UnknownNameError: no such stream.
            InvalidInputError: a batch that does not fit the stream.
            StorageFullError: no space; everything appended before stays.
        """
        journal = self._journal(stream_name)
        descriptor = self._descriptors[stream_name]
        check_batch(descriptor, batch, last_t_host_ns=self._last_t_host_ns[stream_name])
        if not len(batch):
            return
        columns = (batch.t_host_ns.tolist(), batch.t_device_ns.tolist(), batch.sequence.tolist())
        journal.append(_payloads(descriptor, batch.values), list(zip(*columns, strict=True)))
        self._last_t_host_ns[stream_name] = columns[0][-1]
        self._dirty.add(stream_name)

    def num_samples(self, stream_name: str) -> int:
        """How many samples of a stream are spooled."""
        return self._journal(stream_name).num_rows

    def flush(self) -> None:
        """Make what was appended survive a power loss (unless opened with `sync=False`)."""
        if self._sync:
            for name in sorted(self._dirty):
                self._journals[name].sync()
        self._dirty.clear()

    def truncate(self, stream_name: str, num_samples: int) -> None:
        """Keep the first samples of a stream: undoes appends that were not acknowledged."""
        rows = self._journal(stream_name).truncate(num_samples)
        self._last_t_host_ns[stream_name] = int(rows["t_host_ns"][-1]) if num_samples else None

    def set_attributes(self, attributes: RecordingAttributes) -> None:
        """Replace what is known of the recording (ledger, success); id and streams stay.

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
        """Give the files back without marking the recording as complete."""
        for journal in self._journals.values():
            journal.close()
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

    def _journal(self, name: str) -> JournalWriter:
        if name not in self._journals:
            raise UnknownNameError("stream", name, list(self._journals))
        return self._journals[name]


def _create(path: Path, attributes: RecordingAttributes) -> None:
    if not attributes.streams:
        raise InvalidInputError(
            f"spool {attributes.recording_id!r}: a recording without a stream; "
            "name at least one in its attributes"
        )
    # Under another name first, so that a spool that is seen has its attributes.
    unborn = path.with_name(path.name + ".new")
    with disk_errors(f"create spool {path.name}"):
        if path.exists():
            raise ConflictError(f"spool {path.name!r} exists; resume or remove it")
        shutil.rmtree(unborn, ignore_errors=True)
        unborn.mkdir(parents=True)
        write_file(unborn / RECORDING_FILE, attributes.model_dump_json().encode())
        unborn.rename(path)


def _payloads(descriptor: StreamDescriptor, values: np.ndarray) -> list[bytes]:
    if descriptor.unit in ENCODED_UNITS:
        return list(values)
    data = np.ascontiguousarray(values, dtype=descriptor.numpy_dtype()).tobytes()
    size = len(data) // len(values)
    return [data[i * size : (i + 1) * size] for i in range(len(values))]
