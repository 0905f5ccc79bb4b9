"""Intake of uploads: applies the limits before the ingest, and counts what comes."""

import time
from collections.abc import Awaitable, Callable, Iterator
from contextlib import ExitStack, contextmanager

import anyio
import anyio.to_thread
from prometheus_client import CollectorRegistry, Counter, Gauge, Histogram

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
from services.episode_store.ingest import Ingest
from services.episode_store.limits import Admission, StorageLimits

SECONDS = (0.002, 0.005, 0.01, 0.02, 0.05, 0.1, 0.2, 0.5, 1.0, 2.0, 5.0, 10.0, 30.0)


class Intake:
    """Passes every upload through the limits to the ingest, and updates metrics.

    Batches are written by `max_batches` threads of their own; reads and commits use others.
    """

    def __init__(
        self, ingest: Ingest, limits: StorageLimits, *, max_batches: int, max_bytes: int
    ) -> None:
        self._ingest, self._limits = ingest, limits
        self._admission = Admission(max_requests=max_batches, max_bytes=max_bytes)
        self._threads = anyio.CapacityLimiter(max_batches)
        self._batches = Counter(
            "dextouch_store_batches",
            "Acknowledged batches; replayed ones were stored before.",
            ("replayed",),
            registry=None,
        )
        self._bytes = Counter(
            "dextouch_store_batch_bytes", "Bytes of acknowledged new batches.", registry=None
        )
        self._ack_seconds = Histogram(
            "dextouch_store_ack_seconds",
            "Time from admission of a batch to its acknowledgement.",
            buckets=SECONDS,
            registry=None,
        )
        self._finish_seconds = Histogram(
            "dextouch_store_finish_seconds",
            "Time from the request to finish an upload to the committed recording.",
            buckets=SECONDS,
            registry=None,
        )
        self._refused = Counter(
            "dextouch_store_refused",
            "Refused upload requests by the exhausted resource.",
            ("reason",),
            registry=None,
        )

    def register(self, registry: CollectorRegistry) -> None:
        """Add the metrics to a registry."""
        counts = (self._batches, self._bytes, self._refused)
        for metric in (*counts, self._ack_seconds, self._finish_seconds):
            registry.register(metric)
        uploads = Gauge("dextouch_store_open_uploads", "Unfinished uploads.", registry=registry)
        uploads.set_function(lambda: self._limits.num_open)
        free = Gauge(
            "dextouch_store_free_bytes", "Free bytes on the store's disk.", registry=registry
        )
        free.set_function(self._limits.free_bytes)

    def create(self, attributes: RecordingAttributes) -> RecordingStatus:
        """Begin an upload or return its status; raises as `Ingest.create` and when full."""
        with self._counting_refusals():
            self._limits.check_new(attributes.station)
        status = self._ingest.create(attributes)
        if status.state == "open":
            self._limits.begin(attributes)
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
                self._limits.check_batch(recording_id, num_bytes)
            started = time.perf_counter()
            data = await read()
            receipt = await anyio.to_thread.run_sync(
                self._ingest.put_batch, recording_id, stream, number, data, limiter=self._threads
            )
        self._ack_seconds.observe(time.perf_counter() - started)
        self._batches.labels(str(receipt.replayed).lower()).inc()
        if not receipt.replayed:
            self._bytes.inc(len(data))
            self._limits.add(recording_id, len(data))
        return receipt

    def finish(self, recording_id: str, body: FinishRecording) -> RecordingStatus:
        """Commit a complete upload; raises as `Ingest.finish` and when full."""
        started = time.perf_counter()
        with self._counting_refusals():
            self._limits.check_finish(recording_id)
        status = self._ingest.finish(recording_id, body)
        self._limits.end(recording_id)
        self._finish_seconds.observe(time.perf_counter() - started)
        return status

    def idle(self, *, idle_s: float) -> UploadList:
        """Unfinished uploads that have been idle for `idle_s`."""
        return self._limits.idle(idle_s=idle_s)

    def expire(self, wanted: ExpireUploads) -> UploadList:
        """Drop unfinished uploads that have been idle for `idle_s` and return them."""
        gone = []
        for upload in self._limits.idle(idle_s=wanted.idle_s).uploads:
            if self._ingest.expire(upload.recording_id, idle_s=wanted.idle_s):
                self._limits.end(upload.recording_id)
                gone.append(upload)
        return UploadList(uploads=tuple(gone))

    @contextmanager
    def _counting_refusals(self) -> Iterator[None]:
        try:
            yield
        except (LimitExceededError, StorageFullError) as error:
            self._refused.labels(str(error.details.get("reason", "other"))).inc()
            raise
