"""Intake of uploads: applies admission, disk reserve and quotas before the ingest."""

import time
from collections.abc import Awaitable, Callable, Iterator
from contextlib import ExitStack, contextmanager

import anyio
import anyio.to_thread

from dextouch.errors import LimitExceededError, StorageFullError
from dextouch.schemas import (
    BatchReceipt,
    ExpireUploads,
    FinishRecording,
    RecordingAttributes,
    RecordingStatus,
    UploadList,
)
from dextouch.streams import MAX_BATCH_BYTES
from services.episode_store.admission import Admission, DiskReserve
from services.episode_store.ingest import Ingest
from services.episode_store.metrics import StoreMetrics
from services.episode_store.quotas import StationQuotas

# Allowance for an upload's attributes and empty files.
CREATE_BYTES = 1 << 16


class Intake:
    """Passes every upload through the limits to the ingest, and updates metrics.

    Batches are written by `num_threads` threads of their own; reads and commits use others.
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
        """Begin an upload or return its status; raises as `Ingest.create` and when full."""
        with self._counting_refusals():
            self._reserve.check_upload(CREATE_BYTES)
            self._quotas.check_station(attributes.station, CREATE_BYTES)
        status = self._ingest.create(attributes)
        if status.state == "open":
            self._quotas.begin(attributes)
        return status

    def status(self, recording_id: str) -> RecordingStatus:
        """Status of an upload."""
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
        """Store a batch of an unfinished upload.

        `announced` is the Content-Length of the request, whose body `read` reads.

        Raises:
            LimitExceededError: too many batches in flight; the body was not read.
            StorageFullError: the disk or the station's quota is full; the body was not read.
            DexTouchError: as `Ingest.put_batch`.
        """
        # A body of unknown length may be as large as the largest batch.
        num_bytes = int(announced) if announced and announced.isdecimal() else MAX_BATCH_BYTES
        with ExitStack() as admission:
            with self._counting_refusals():
                admission.enter_context(self._admission.admitted(num_bytes))
                self._reserve.check_upload(num_bytes)
                self._quotas.check_upload(recording_id, num_bytes)
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
        """Commit a complete upload; raises as `Ingest.finish` and when full."""
        started = time.perf_counter()
        with self._counting_refusals():
            self._reserve.check_commit(self._quotas.bytes_of(recording_id))
        status = self._ingest.finish(recording_id, body)
        self._quotas.end(recording_id)
        self._metrics.finish_seconds.observe(time.perf_counter() - started)
        return status

    def idle(self, *, idle_s: float) -> UploadList:
        """Unfinished uploads that have been idle for `idle_s`."""
        return self._quotas.idle(idle_s=idle_s)

    def expire(self, wanted: ExpireUploads) -> UploadList:
        """Drop unfinished uploads that have been idle for `idle_s` and return them."""
        gone = []
        for upload in self._quotas.idle(idle_s=wanted.idle_s).uploads:
            if self._ingest.expire(upload.recording_id, idle_s=wanted.idle_s):
                self._quotas.end(upload.recording_id)
                gone.append(upload)
        return UploadList(uploads=tuple(gone))

    @contextmanager
    def _counting_refusals(self) -> Iterator[None]:
        try:
            yield
        except (LimitExceededError, StorageFullError) as error:
            self._metrics.refused.labels(str(error.details.get("reason", "other"))).inc()
            raise
