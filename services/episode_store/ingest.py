"""Numbered batches of a recording → the spool, exactly once each; at the end → the store."""

import hashlib
import shutil
import threading
import zlib
from collections import OrderedDict
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import structlog

from dextouch.episodes import EpisodeStore
from dextouch.episodes.format import check_id
from dextouch.episodes.log import SpoolReader, SpoolWriter
from dextouch.errors import ConflictError, InvalidInputError, NotFoundError, UnknownNameError
from dextouch.schemas.recordings import (
    BatchReceipt,
    FinishRecording,
    RecordingAttributes,
    RecordingStatus,
)
from dextouch.streams.wire import decode_batch
from services.episode_store.receipts import Receipts

logger = structlog.get_logger(__name__)

_COPY_SAMPLES = 256
_UPLOADS = ".uploads"
_NUM_LOCKS = 64


class _Upload:
    """One unfinished recording: its spool and its receipts, which always agree."""

    def __init__(self, spool: SpoolWriter, *, sync: bool) -> None:
        self.spool = spool
        self._sync = sync
        self._streams = {stream.name: stream for stream in spool.attributes.streams}
        self.receipts = {name: Receipts(spool.path / f"{name}.receipts") for name in self._streams}
        for name, receipts in self.receipts.items():
            # What was written but never acknowledged comes again.
            spool.truncate(name, receipts.num_samples)

    def status(self) -> RecordingStatus:
        return RecordingStatus(
            recording_id=self.spool.attributes.recording_id,
            state="open",
            next_batch={name: len(receipts) for name, receipts in self.receipts.items()},
        )

    def put(self, stream: str, number: int, data: bytes) -> BatchReceipt:
        if stream not in self.receipts:
            raise UnknownNameError("stream", stream, list(self.receipts))
        receipts, recording_id = self.receipts[stream], self.spool.attributes.recording_id
        if number > len(receipts):
            raise ConflictError(
                f"{recording_id} {stream}: got batch {number}, expected {len(receipts)}; "
                "send the missing ones first",
                got=number,
                expected=len(receipts),
            )
        replayed = number < len(receipts)
        if replayed:
            if hashlib.sha256(data).digest() != receipts[number].sha256:
                raise ConflictError(
                    f"{recording_id} {stream}: batch {number} is here with other bytes; "
                    "a batch never changes",
                    got=number,
                    expected=len(receipts),
                )
        else:
            self._append(stream, number, data)
        before = receipts[number - 1].end_sample if number else 0
        return BatchReceipt(
            recording_id=recording_id,
            stream=stream,
            number=number,
            num_samples=receipts[number].end_sample - before,
            replayed=replayed,
        )

    def _append(self, stream: str, number: int, data: bytes) -> None:
        receipts = self.receipts[stream]
        batch = decode_batch(data, self._streams[stream], number=number)
        self.spool.append(stream, batch)
        acknowledged = False
        try:
            self.spool.flush()
            end_sample = self.spool.num_samples(stream)
            receipts.append(data, end_sample=end_sample, sync=self._sync)
            acknowledged = True
        finally:
            if not acknowledged:
                self.spool.truncate(stream, receipts.num_samples)


class Ingest:
    """All uploads of a store. Thread-safe; one recording is worked on by one thread at a time.

    Args:
        store: where finished recordings go; unfinished ones lie in a folder below it.
        sync: whether an acknowledged batch survives a power loss.
        max_open_uploads: how many keep their files open; others are opened when asked for.
    """

    def __init__(self, store: EpisodeStore, *, sync: bool, max_open_uploads: int) -> None:
        self._store = store
        self._folder = store.root / _UPLOADS
        self._sync, self._max_open = sync, max_open_uploads
        self._open: OrderedDict[str, _Upload] = OrderedDict()
        self._locks = [threading.Lock() for _ in range(_NUM_LOCKS)]
        self._guard = threading.Lock()

    def create(self, attributes: RecordingAttributes) -> RecordingStatus:
        """Begin an upload, or say where it stands if it had begun.

        Raises:
            InvalidInputError: a recording without a stream.
            ConflictError: the id is taken by another recording.
        """
        recording_id = attributes.recording_id
        with self._working_on(recording_id):
            if self._store.exists(recording_id, kind="recording"):
                _check_same(attributes, self._store.recording(recording_id).attributes)
                return RecordingStatus(recording_id=recording_id, state="finished")
            path = self._path(recording_id)
            if path.exists():
                upload = self._upload(recording_id)
                _check_same(attributes, upload.spool.attributes)
                return upload.status()
            spool = SpoolWriter(path, attributes, sync=self._sync)
            self._keep(recording_id, _Upload(spool, sync=self._sync))
            logger.info("recording_created", recording_id=recording_id)
            return self._open[recording_id].status()

    def status(self, recording_id: str) -> RecordingStatus:
        """Where an upload stands.

        Raises:
            NotFoundError: never begun.
        """
        with self._working_on(recording_id):
            if self._store.exists(recording_id, kind="recording"):
                return RecordingStatus(recording_id=recording_id, state="finished")
            return self._upload(recording_id).status()

    def put_batch(self, recording_id: str, stream: str, number: int, data: bytes) -> BatchReceipt:
        """Take a batch in; when this returns, it is kept.

        Raises:
            NotFoundError: no such recording.
            UnknownNameError: no such stream.
            ConflictError: a gap, other bytes under a known number, or a finished recording.
            PacketError, InvalidInputError: bytes that are no batch of this stream.
            StorageFullError: no space; all that was acknowledged stays.
        """
        with self._working_on(recording_id):
            if self._store.exists(recording_id, kind="recording"):
                raise ConflictError(f"recording {recording_id!r} is finished; it never changes")
            return self._upload(recording_id).put(stream, number, data)

    def finish(self, recording_id: str, body: FinishRecording) -> RecordingStatus:
        """Move a complete upload into the store; repeating it changes nothing.

        Raises:
            NotFoundError: no such recording.
            ConflictError: batches are missing, or more are here than announced.
            InvalidInputError: not all streams are announced, or none has a sample.
        """
        with self._working_on(recording_id):
            if not self._store.exists(recording_id, kind="recording"):
                upload = self._upload(recording_id)
                _check_complete(upload, body)
                self._commit(upload, body)
            shutil.rmtree(self._path(recording_id), ignore_errors=True)
        return RecordingStatus(recording_id=recording_id, state="finished")

    def close(self) -> None:
        """Give all files back; uploads go on after the next start."""
        with self._guard:
            while self._open:
                self._open.popitem()[1].spool.abandon()

    def _commit(self, upload: _Upload, body: FinishRecording) -> None:
        spool = upload.spool
        attributes = spool.attributes.model_copy(
            update={
                "success": spool.attributes.success if body.success is None else body.success,
                "ledger": body.ledger or spool.attributes.ledger,
            }
        )
        recording_id = attributes.recording_id
        with self._guard:
            self._open.pop(recording_id)
        spool.close()
        reader = SpoolReader(spool.path)
        with self._store.writer(kind="recording", attributes=attributes) as writer:
            for name in reader.streams:
                for batch in reader.batches(name, num_samples=_COPY_SAMPLES):
                    writer.append(
                        name,
                        values=batch.values,
                        t_host_ns=batch.t_host_ns,
                        t_device_ns=batch.t_device_ns,
                        sequence=batch.sequence,
                    )
        counts = {name: reader.num_samples(name) for name in reader.streams}
        logger.info("recording_finished", recording_id=recording_id, num_samples=counts)

    @contextmanager
    def _working_on(self, recording_id: str) -> Iterator[None]:
        check_id(recording_id, kind="recording id")
        with self._lock_of(recording_id):
            yield

    def _lock_of(self, recording_id: str) -> threading.Lock:
        # A fixed set of locks, so that asking for unknown ids costs no memory.
        return self._locks[zlib.crc32(recording_id.encode()) % _NUM_LOCKS]

    def _upload(self, recording_id: str) -> _Upload:
        """The open upload; the caller holds its lock."""
        with self._guard:
            if recording_id in self._open:
                self._open.move_to_end(recording_id)
                return self._open[recording_id]
        path = self._path(recording_id)
        if not path.exists():
            raise NotFoundError(f"recording {recording_id!r}: no upload was begun under this id")
        upload = _Upload(SpoolWriter.resume(path, sync=self._sync), sync=self._sync)
        self._keep(recording_id, upload)
        return upload

    def _keep(self, recording_id: str, upload: _Upload) -> None:
        with self._guard:
            self._open[recording_id] = upload
            idle = [other for other in self._open if not self._lock_of(other).locked()]
            for other in idle[: max(0, len(self._open) - self._max_open)]:
                self._open.pop(other).spool.abandon()

    def _path(self, recording_id: str) -> Path:
        return self._folder / recording_id


def _check_same(got: RecordingAttributes, ours: RecordingAttributes) -> None:
    late = {"success": ours.success, "ledger": ours.ledger}
    if got.model_copy(update=late) != ours:
        raise ConflictError(
            f"recording {ours.recording_id!r} exists with other attributes; choose another id"
        )


def _check_complete(upload: _Upload, body: FinishRecording) -> None:
    recording_id = upload.spool.attributes.recording_id
    here = upload.status().next_batch
    if set(body.num_batches) != set(here):
        raise InvalidInputError(
            f"finish {recording_id}: got streams {sorted(body.num_batches)}, expected "
            f"{sorted(here)}; announce 0 batches for a stream that never spoke"
        )
    differing = {
        name: {"got": here[name], "expected": expected}
        for name, expected in body.num_batches.items()
        if here[name] != expected
    }
    if differing:
        listed = ", ".join(
            f"{name} has {count['got']} of {count['expected']} batches"
            for name, count in differing.items()
        )
        raise ConflictError(f"finish {recording_id}: {listed}; send the rest first", **differing)
    if not any(here.values()):
        raise InvalidInputError(f"finish {recording_id}: a recording without a sample")
