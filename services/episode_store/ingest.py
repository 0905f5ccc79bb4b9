"""Ingest of uploads: numbered batches are spooled exactly once, finished recordings committed."""

import shutil
import threading
from collections import OrderedDict
from collections.abc import Iterator
from contextlib import contextmanager
from functools import partial
from pathlib import Path

import structlog

from dextouch.episodes import EpisodeStore, check_id
from dextouch.episodes.care import UPLOADS
from dextouch.episodes.spool import SpoolWriter
from dextouch.errors import ConflictError, InvalidInputError, NotFoundError
from dextouch.schemas import (
    ID_TAKEN,
    BatchReceipt,
    FinishRecording,
    RecordingAttributes,
    RecordingStatus,
)
from services.episode_store.committing import Commit, commit_spool
from services.episode_store.locks import KeyedLocks
from services.episode_store.quotas import idle_seconds
from services.episode_store.upload import put_batch, upload_status

logger = structlog.get_logger(__name__)

# Maximum wait for the lock of a recording, which finishing a long take holds.
PATIENCE_S = 20.0


class Ingest:
    """All uploads of a store. Thread-safe, with one lock per recording.

    Args:
        store: destination of finished recordings; unfinished ones are in a folder below it.
        sync: whether batches are synced to disk before they are acknowledged.
        max_open_uploads: number of uploads with open files; others are reopened on demand.
        commit: commits a complete upload; None commits synchronously.
    """

    def __init__(
        self,
        store: EpisodeStore,
        *,
        sync: bool,
        max_open_uploads: int,
        commit: Commit | None = None,
    ) -> None:
        self._store = store
        self.folder = store.root / UPLOADS
        self._sync, self._max_open = sync, max_open_uploads
        self._commit = commit or partial(commit_spool, store)
        self._open: OrderedDict[str, SpoolWriter] = OrderedDict()
        self._locks = KeyedLocks(patience_s=PATIENCE_S)
        self._guard = threading.Lock()

    def create(self, attributes: RecordingAttributes) -> RecordingStatus:
        """Begin an upload, or return the status of an existing one.

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
                spool = self._upload(recording_id)
                _check_same(attributes, spool.attributes)
                return upload_status(spool)
            spool = SpoolWriter(path, attributes, sync=self._sync)
            self._keep(recording_id, spool)
            logger.info("recording_created", recording_id=recording_id)
            return upload_status(spool)

    def status(self, recording_id: str) -> RecordingStatus:
        """Status of an upload.

        Raises:
            NotFoundError: no such upload.
        """
        with self._working_on(recording_id):
            if self._store.exists(recording_id, kind="recording"):
                return RecordingStatus(recording_id=recording_id, state="finished")
            return upload_status(self._upload(recording_id))

    def put_batch(self, recording_id: str, stream: str, number: int, data: bytes) -> BatchReceipt:
        """Store a batch; it is durable when this returns.

        Raises:
            NotFoundError: no such recording.
            UnknownNameError: no such stream.
            ConflictError: a gap, other samples under a known number, or a finished recording.
            PacketError, InvalidInputError: not a valid batch of this stream.
            UnavailableError: the recording is being finished; try again later.
            StorageFullError: no space; acknowledged batches are kept.
        """
        with self._working_on(recording_id):
            return put_batch(self._upload(recording_id), stream, number, data)

    def finish(self, recording_id: str, body: FinishRecording) -> RecordingStatus:
        """Commit a complete upload; idempotent.

        Raises:
            NotFoundError: no such recording.
            ConflictError: batches are missing, or more are here than announced.
            InvalidInputError: not all streams are announced, or none has a sample.
            UnavailableError: it is being finished already; try again later.
            StorageFullError: no space; the upload is unchanged.
        """
        with self._working_on(recording_id):
            if not self._store.exists(recording_id, kind="recording"):
                spool = self._upload(recording_id)
                _check_complete(spool, body)
                self._move(spool, body)
            shutil.rmtree(self._path(recording_id), ignore_errors=True)
        return RecordingStatus(recording_id=recording_id, state="finished")

    def expire(self, recording_id: str, *, idle_s: float) -> bool:
        """Drop an unfinished upload that has been idle for `idle_s`; whether it was dropped.

        Raises:
            UnavailableError: it is in use.
        """
        with self._working_on(recording_id):
            path = self._path(recording_id)
            if not path.exists() or idle_seconds(path) < idle_s:
                return False
            with self._guard:
                spool = self._open.pop(recording_id, None)
            if spool is not None:
                spool.abandon()
            shutil.rmtree(path)
        logger.warning("upload_expired", recording_id=recording_id)
        return True

    def close(self) -> None:
        """Close all files; uploads continue after a restart."""
        with self._guard:
            while self._open:
                self._open.popitem()[1].abandon()

    def _move(self, spool: SpoolWriter, body: FinishRecording) -> None:
        known = spool.attributes
        attributes = known.model_copy(
            update={
                "success": known.success if body.success is None else body.success,
                "ledger": body.ledger or known.ledger,
            }
        )
        recording_id = attributes.recording_id
        with self._guard:
            self._open.pop(recording_id)
        spool.close()
        try:
            counts = self._commit(self._path(recording_id), attributes)
        except ConflictError:
            # The commit process of a previous service may have completed it.
            if not self._store.exists(recording_id, kind="recording"):
                raise
            return
        logger.info("recording_finished", recording_id=recording_id, num_samples=counts)

    @contextmanager
    def _working_on(self, recording_id: str) -> Iterator[None]:
        check_id(recording_id, kind="recording id")
        with self._locks.holding(recording_id):
            yield

    def _upload(self, recording_id: str) -> SpoolWriter:
        """The spool of an upload; the caller holds its lock."""
        with self._guard:
            if recording_id in self._open:
                self._open.move_to_end(recording_id)
                return self._open[recording_id]
        if self._store.exists(recording_id, kind="recording"):
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


def _check_same(got: RecordingAttributes, ours: RecordingAttributes) -> None:
    # Attributes known only at the end may differ from those at the beginning.
    late = {"success": ours.success, "ledger": ours.ledger}
    if got.model_copy(update=late) != ours:
        raise ConflictError(
            f"recording {ours.recording_id!r} exists with other attributes; choose another id",
            reason=ID_TAKEN,
        )


def _check_complete(spool: SpoolWriter, body: FinishRecording) -> None:
    recording_id = spool.attributes.recording_id
    here = upload_status(spool).next_batch
    if set(body.num_batches) != set(here):
        raise InvalidInputError(
            f"finish {recording_id}: got streams {sorted(body.num_batches)}, expected "
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
