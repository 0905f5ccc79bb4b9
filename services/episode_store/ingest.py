"""Ingest of uploads: numbered batches are spooled exactly once, finished recordings committed."""

import shutil
import threading
import time
from collections import OrderedDict
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from functools import partial
from pathlib import Path
from weakref import WeakValueDictionary

import structlog

from dextouch.episodes import EpisodeStore, check_id, disk_errors
from dextouch.episodes.maintenance import UPLOADS, DeletionRecords
from dextouch.episodes.spool import SpoolReader, SpoolWriter, read_attributes
from dextouch.errors import (
    ConflictError,
    InvalidInputError,
    NotFoundError,
    StorageError,
    UnavailableError,
)
from dextouch.schemas import (
    ID_TAKEN,
    BatchReceipt,
    FinishRecording,
    RecordingAttributes,
    RecordingStatus,
    StreamContent,
)
from dextouch.streams import read_batch
from dextouch.tracing import current_trace_id
from services.episode_store.committing import Commit, CommitProcess, check_content, commit_spool
from services.episode_store.deletions import refuse_deleted
from services.episode_store.keys import ANYONE, Sender, owner_of
from services.episode_store.settings import EpisodeStoreSettings

logger = structlog.get_logger(__name__)

# Maximum wait for the lock of a recording, which finishing a long take holds.
PATIENCE_S = 20.0
RETRY_AFTER_S = 1


class KeyedLocks:
    """One lock per recording, so that recordings do not block each other."""

    def __init__(self, *, patience_s: float) -> None:
        self._patience_s = patience_s
        self._guard = threading.Lock()
        # Those who hold or wait for a lock keep it alive, so that unknown ids cost no memory.
        self._locks: WeakValueDictionary[str, threading.Lock] = WeakValueDictionary()

    @contextmanager
    def holding(self, key: str) -> Iterator[None]:
        """Context manager that holds the lock of a key.

        Raises UnavailableError: the lock was not released in `patience_s`.
        """
        with self._guard:
            lock = self._locks.setdefault(key, threading.Lock())
        if not lock.acquire(timeout=self._patience_s):
            # The traceback would keep it alive.
            del lock
            raise UnavailableError(
                f"{key}: still locked after {self._patience_s:g} s; try again later",
                retry_after_s=RETRY_AFTER_S,
            )
        try:
            yield
        finally:
            lock.release()

    def is_wanted(self, key: str) -> bool:
        """Whether a key is locked or waited for."""
        return key in self._locks


class Ingest:
    """All uploads of a store. Thread-safe, with one lock per recording.

    Unfinished ones are in a folder below the store. `commit` commits a complete upload; None as the
    settings say.
    """

    def __init__(
        self, store: EpisodeStore, settings: EpisodeStoreSettings, *, commit: Commit | None = None
    ) -> None:
        self._store = store
        self.folder = store.root / UPLOADS
        self._sync, self._max_open = settings.sync_uploads, settings.max_open_uploads
        self._process = CommitProcess(settings.store_url) if settings.commit_in_process else None
        self._commit = commit or self._process or partial(commit_spool, store)
        self._open: OrderedDict[str, SpoolWriter] = OrderedDict()
        self._locks = KeyedLocks(patience_s=PATIENCE_S)
        self._guard = threading.Lock()
        self._deletions = DeletionRecords(store.root)

    def create(self, attributes: RecordingAttributes, sender: Sender = ANYONE) -> RecordingStatus:
        """Begin an upload, or return the status of an existing one.

        Raises InvalidInputError without a stream, AccessDeniedError for a key of another station,
        and ConflictError if the id is taken, also by an upload of another key, or was deleted.
        """
        recording_id = attributes.recording_id
        sender.check_station(attributes.station)
        with self._working_on(recording_id):
            refuse_deleted(self._deletions, attributes)
            if self.is_finished(recording_id):
                _check_same(attributes, self._store.recording(recording_id).attributes)
                return RecordingStatus(recording_id=recording_id, state="finished")
            path = self._path(recording_id)
            if path.exists():
                spool = self._upload(recording_id)
                _check_same(attributes, spool.attributes)
                if not sender.may_continue(owner_of(path), attributes.station):
                    raise ConflictError(
                        f"upload {recording_id!r} was begun by another key; choose another id",
                        reason=ID_TAKEN,
                    )
                return _status(spool)
            if attributes.trace_id is None:
                attributes = attributes.model_copy(update={"trace_id": current_trace_id()})
            spool = SpoolWriter(path, attributes, sync=self._sync, notes=sender.as_files())
            self._keep(recording_id, spool)
            logger.info("recording_created", recording_id=recording_id)
            return _status(spool)

    def status(self, recording_id: str, sender: Sender = ANYONE) -> RecordingStatus:
        """Status of an upload.

        Raises NotFoundError: no such upload; AccessDeniedError: it is none of the sender.
        """
        with self._working_on(recording_id):
            if self.is_finished(recording_id):
                sender.check_station(self._store.recording(recording_id).attributes.station)
                return RecordingStatus(recording_id=recording_id, state="finished")
            return _status(self._upload(recording_id, sender))

    def is_stored(self, recording_id: str, stream: str, number: int) -> bool:
        """Whether a batch was acknowledged before; answering it again needs no space."""
        with self._working_on(recording_id):
            if not self._path(recording_id).exists():
                return self.is_finished(recording_id)
            return number < self._upload(recording_id).num_batches(stream)

    def is_begun(self, recording_id: str) -> bool:
        """Whether an upload was begun or finished before; beginning it again needs no space."""
        check_id(recording_id, kind="recording id")
        return self._path(recording_id).exists() or self.is_finished(recording_id)

    def is_finished(self, recording_id: str) -> bool:
        """Whether a recording is finished; finishing it again needs no space."""
        return self._store.exists(recording_id, kind="recording")

    def put_batch(
        self, recording_id: str, stream: str, number: int, data: bytes, sender: Sender = ANYONE
    ) -> BatchReceipt:
        """Store a batch; it is durable when this returns.

        Raises NotFoundError or UnknownNameError without the recording or stream, AccessDeniedError
        if it is none of the sender, ConflictError for a gap, other samples under a known number or
        a finished recording, PacketError or InvalidInputError if it is no batch of this stream,
        UnavailableError while the recording is being finished, and StorageFullError without space;
        acknowledged batches are kept.
        """
        with self._working_on(recording_id):
            spool = self._upload(recording_id, sender)
            refuse_deleted(self._deletions, spool.attributes)
            return _put_batch(spool, stream, number, data)

    def finish(
        self, recording_id: str, body: FinishRecording, sender: Sender = ANYONE
    ) -> RecordingStatus:
        """Commit a complete upload; idempotent.

        Raises NotFoundError without it, AccessDeniedError if it is none of the sender,
        ConflictError if other batches or samples are here than announced, also once it is
        finished, InvalidInputError if not all streams are announced or none has a sample,
        UnavailableError while it is being finished, and StorageFullError without space; the upload
        is unchanged then.
        """
        with self._working_on(recording_id):
            is_finished = self.is_finished(recording_id)
            if not is_finished:
                spool = self._upload(recording_id, sender)
                refuse_deleted(self._deletions, spool.attributes)
                _check_announced(recording_id, _status(spool).next_batch, body)
                is_finished = not self._move(spool, body)
                try:
                    refuse_deleted(self._deletions, spool.attributes)
                except ConflictError:
                    # Deleted while it was committed, when nothing listed it.
                    self._store.delete(recording_id, kind="recording", for_good=True)
                    raise
            content = {}
            if is_finished or body.content:
                content = self._check_committed(recording_id, body, sender)
            shutil.rmtree(self._path(recording_id), ignore_errors=True)
        return RecordingStatus(recording_id=recording_id, state="finished", content=content)

    def expire(self, recording_id: str, *, idle_s: float) -> bool:
        """Drop an unfinished upload that has been idle for `idle_s`; whether it was dropped.

        Raises UnavailableError: it is in use.
        """
        with self._working_on(recording_id):
            path = self._path(recording_id)
            if not path.exists() or idle_seconds(path) < idle_s:
                return False
            self._drop(recording_id)
        logger.warning("upload_expired", recording_id=recording_id)
        return True

    def drop_deleted(self) -> list[str]:
        """Drop unfinished uploads of takes that were deleted permanently, and return their ids."""
        gone = []
        for path in upload_folders(self.folder):
            with self._working_on(path.name):
                try:
                    refuse_deleted(self._deletions, read_attributes(path))
                    continue
                except ConflictError:
                    self._drop(path.name)
                except (NotFoundError, StorageError):
                    continue  # finished meanwhile, or damaged
            logger.warning("deleted_upload_dropped", recording_id=path.name)
            gone.append(path.name)
        return gone

    def close(self) -> None:
        """Close all files, after a running commit; uploads continue after a restart."""
        with self._guard:
            while self._open:
                self._open.popitem()[1].abandon()
        if self._process is not None:
            self._process.close()

    def _drop(self, recording_id: str) -> None:
        """Remove an upload; the caller holds its lock."""
        with self._guard:
            spool = self._open.pop(recording_id, None)
        if spool is not None:
            spool.abandon()
        shutil.rmtree(self._path(recording_id), ignore_errors=True)

    def _move(self, spool: SpoolWriter, body: FinishRecording) -> bool:
        """Commit an upload; whether we did, and not the process of a previous service."""
        known = spool.attributes
        attributes = known.model_copy(
            update={
                "success": known.success if body.success is None else body.success,
                "ledger": body.ledger or known.ledger,
                "num_batches": body.num_batches,
            }
        )
        recording_id = attributes.recording_id
        with self._guard:
            self._open.pop(recording_id)
        try:
            spool.close()
        finally:
            spool.abandon()
        try:
            counts = self._commit(self._path(recording_id), attributes, body.content)
        except ConflictError:
            if not self.is_finished(recording_id):
                raise
            return False
        logger.info("recording_finished", recording_id=recording_id, num_samples=counts)
        return True

    def _check_committed(
        self, recording_id: str, body: FinishRecording, sender: Sender
    ) -> dict[str, StreamContent]:
        """Compare a finished recording with what its station announced; what it has, if asked."""
        reader = self._store.recording(recording_id)
        sender.check_station(reader.attributes.station)
        content = reader.content()
        # Earlier releases did not note them: then any number that can hold the samples is right.
        here = reader.attributes.num_batches or {
            name: min(max(1, body.num_batches.get(name, 0)), one.num_samples)
            for name, one in content.items()
        }
        _check_announced(recording_id, here, body)
        check_content(recording_id, content, body.content)
        return content if body.content else {}

    @contextmanager
    def _working_on(self, recording_id: str) -> Iterator[None]:
        check_id(recording_id, kind="recording id")
        with self._locks.holding(recording_id):
            yield

    def _upload(self, recording_id: str, sender: Sender = ANYONE) -> SpoolWriter:
        """The spool of an upload that the sender may continue; the caller holds its lock."""
        spool = self._opened(recording_id)
        sender.check_upload(spool.path, spool.attributes.station)
        return spool

    def _opened(self, recording_id: str) -> SpoolWriter:
        with self._guard:
            if recording_id in self._open:
                if self._path(recording_id).exists():
                    self._open.move_to_end(recording_id)
                    return self._open[recording_id]
                # Removed by someone else: what is appended to it now would be lost.
                self._open.pop(recording_id).abandon()
        if self.is_finished(recording_id):
            raise ConflictError(f"recording {recording_id!r} is finished and cannot be changed")
        path = self._path(recording_id)
        if not path.exists():
            raise NotFoundError(f"recording {recording_id!r}: there is no upload with this id")
        spool = SpoolWriter.resume(path, sync=self._sync)
        self._keep(recording_id, spool)
        return spool

    def _keep(self, recording_id: str, spool: SpoolWriter) -> None:
        with self._guard:
            self._open[recording_id] = spool
            idle = [other for other in self._open if not self._locks.is_wanted(other)]
            for other in idle[: max(0, len(self._open) - self._max_open)]:
                self._open.pop(other).abandon()

    def _path(self, recording_id: str) -> Path:
        return self.folder / recording_id


def upload_folders(folder: Path) -> list[Path]:
    """Folders of the unfinished uploads in a folder, by name; they may end at any moment."""
    with disk_errors("list uploads"):
        paths = sorted(folder.iterdir()) if folder.is_dir() else []
    # A name with a dot is an upload that is still being created.
    return [path for path in paths if "." not in path.name]


def idle_seconds(path: Path) -> float:
    """Seconds since the last write to an upload's folder."""
    with disk_errors(f"look at upload {path.name}"):
        try:
            newest = max(file.stat().st_mtime for file in [path, *path.iterdir()])
        except FileNotFoundError:
            return 0.0
    return max(0.0, time.time() - newest)


def _check_same(got: RecordingAttributes, ours: RecordingAttributes) -> None:
    # Attributes known only at the end may differ from those at the beginning.
    late: dict[str, object] = {
        "success": ours.success,
        "ledger": ours.ledger,
        "num_batches": ours.num_batches,
    }
    if got.trace_id is None:
        late["trace_id"] = ours.trace_id
    if got.model_copy(update=late) != ours:
        raise ConflictError(
            f"recording {ours.recording_id!r} exists with other attributes; choose another id",
            reason=ID_TAKEN,
        )


def _check_announced(recording_id: str, here: Mapping[str, int], body: FinishRecording) -> None:
    for announced in (body.num_batches, body.content or here):
        if set(announced) != set(here):
            raise InvalidInputError(
                f"finish {recording_id}: got streams {sorted(announced)}, expected "
                f"{sorted(here)}; announce 0 batches for a stream without samples"
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


def _status(spool: SpoolWriter) -> RecordingStatus:
    """The batch that each stream expects next."""
    names = [stream.name for stream in spool.attributes.streams]
    return RecordingStatus(
        recording_id=spool.attributes.recording_id,
        state="open",
        next_batch={name: spool.num_batches(name) for name in names},
    )


def _put_batch(spool: SpoolWriter, stream: str, number: int, data: bytes) -> BatchReceipt:
    recording_id = spool.attributes.recording_id
    expected = spool.num_batches(stream)
    if number > expected:
        raise ConflictError(
            f"{recording_id} {stream}: got batch {number}, expected {expected}; "
            "send the missing ones first",
            got=number,
            expected=expected,
        )
    descriptor = next(known for known in spool.attributes.streams if known.name == stream)
    batch = read_batch(data, descriptor, number=number)
    replayed = number < expected
    if not replayed:
        spool.append_record(batch, flush=True)
    elif SpoolReader(spool.path).appended(stream, number) != batch.body:
        raise ConflictError(
            f"{recording_id} {stream}: batch {number} exists with other samples; "
            "batches are immutable",
            got=number,
            expected=expected,
        )
    return BatchReceipt(
        recording_id=recording_id,
        stream=stream,
        number=number,
        num_samples=batch.num_samples,
        replayed=replayed,
    )
