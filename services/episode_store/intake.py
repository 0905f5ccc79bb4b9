"""What stations send in; admitted and kept, or refused before anything is read, out."""

import time
from collections.abc import AsyncIterator, Awaitable, Callable, Iterator
from contextlib import asynccontextmanager, contextmanager

import anyio
import anyio.to_thread

from dextouch.errors import LimitExceededError, StorageFullError
from dextouch.schemas.recordings import (
    BatchReceipt,
    ExpireUploads,
    FinishRecording,
    RecordingAttributes,
    RecordingStatus,
    UploadList,
)
from dextouch.streams.wire import MAX_BATCH_BYTES
from services.episode_store.admission import Admission, DiskReserve
from services.episode_store.ingest import Ingest
from services.episode_store.metrics import StoreMetrics
from services.episode_store.quotas import StationQuotas

# What an upload's attributes and empty files may take.
CREATE_BYTES = 1 << 16


class Intake:
    """The way of every upload into the store: bounds first, then the ingest, and the counting.

    Args:
        ingest: keeps what is let in.
        admission: bounds what is here at once.
        reserve: bounds what the disk takes.
        quotas: limits what a station may store.
        metrics: told of everything.
        num_threads: that write batches; reading and finishing have others.
    """

    def __init__(
        self,
        ingest: Ingest,
        *,
        admission: Admission,
        reserve: DiskReserve,
        quotas: StationQuotas,
        metrics: StoreMetrics,
        num_threads: int,
    ) -> None:
        self._ingest = ingest
        self._admission, self._reserve, self._quotas = admission, reserve, quotas
        self._metrics = metrics
        self._threads = anyio.CapacityLimiter(num_threads)

    def create(self, attributes: RecordingAttributes) -> RecordingStatus:
        """Begin an upload, or say where it stands; raises as `Ingest.create` and when full."""
        with self._counting_refusals():
            self._reserve.check_upload(CREATE_BYTES)
            self._quotas.check_station(attributes.station, CREATE_BYTES)
        status = self._ingest.create(attributes)
        if status.state == "open":
            self._quotas.begin(attributes)
        return status

    def status(self, recording_id: str) -> RecordingStatus:
        """Where an upload stands."""
        return self._ingest.status(recording_id)

    async def put_batch(
        self,
        recording_id: str,
        stream: str,
        number: int,
        *,
        announced: str | None,
        read: Callable[[], Awaitable[bytes]],
    ) -> BatchReceipt:
        """Take a batch in.

        Args:
            recording_id: of an upload that was begun.
            stream: one of its streams.
            number: of the batch.
            announced: length of the body, as the request says it.
            read: gives the body; not called for a batch that is refused.

        Raises:
            LimitExceededError: too much at once; the body was not read.
            StorageFullError: the disk or the station's quota is full; the body was not read.
            DexTouchError: as `Ingest.put_batch`.
        """
        async with self._admitted(recording_id, announced):
            started = time.perf_counter()
            data = await read()
            receipt = await anyio.to_thread.run_sync(
                self._ingest.put_batch, recording_id, stream, number, data, limiter=self._threads
            )
        self._metrics.ack_seconds.observe(time.perf_counter() - started)
        self._metrics.batches.labels(str(receipt.replayed).lower()).inc()
        if not receipt.replayed:
            self._metrics.bytes.inc(len(data))
            self._quotas.add(recording_id, len(data))
        return receipt

    def finish(self, recording_id: str, body: FinishRecording) -> RecordingStatus:
        """Move a complete upload into the store; raises as `Ingest.finish` and when full."""
        started = time.perf_counter()
        with self._counting_refusals():
            self._reserve.check_commit(self._quotas.bytes_of(recording_id))
        status = self._ingest.finish(recording_id, body)
        self._quotas.end(recording_id)
        self._metrics.finish_seconds.observe(time.perf_counter() - started)
        return status

    def idle(self, *, idle_s: float) -> UploadList:
        """Unfinished uploads for which nothing has come for so long."""
        return self._quotas.idle(idle_s=idle_s)

    def expire(self, wanted: ExpireUploads) -> UploadList:
        """Drop unfinished uploads for which nothing has come for so long; those that went."""
        gone = []
        for upload in self._quotas.idle(idle_s=wanted.idle_s).uploads:
            if self._ingest.expire(upload.recording_id, idle_s=wanted.idle_s):
                self._quotas.end(upload.recording_id)
                gone.append(upload)
        return UploadList(uploads=tuple(gone))

    @asynccontextmanager
    async def _admitted(self, recording_id: str, announced: str | None) -> AsyncIterator[None]:
        # A body of unknown length may be as long as a batch can be.
        num_bytes = int(announced) if announced and announced.isdecimal() else MAX_BATCH_BYTES
        with self._counting_refusals():
            admission = self._admission.admitted(num_bytes)
            admission.__enter__()
        try:
            with self._counting_refusals():
                self._reserve.check_upload(num_bytes)
                self._quotas.check_upload(recording_id, num_bytes)
            yield
        finally:
            admission.__exit__(None, None, None)

    @contextmanager
    def _counting_refusals(self) -> Iterator[None]:
        try:
            yield
        except (LimitExceededError, StorageFullError) as error:
            self._metrics.refused.labels(str(error.details.get("reason", "other"))).inc()
            raise
