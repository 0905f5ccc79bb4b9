"""Limits of uploads: batches in flight, the disk, and what each station may use; and metrics."""

import shutil
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from functools import partial
from pathlib import Path
from typing import Final

import anyio
import structlog
from prometheus_client import CollectorRegistry, Counter, Gauge, Histogram

from dextouch.episodes import KINDS, Kind, disk_errors, folder_bytes
from dextouch.episodes.spool import read_attributes
from dextouch.errors import LimitExceededError, NotFoundError, StorageError, StorageFullError
from dextouch.schemas import BatchReceipt, RecordingAttributes, UploadList, UploadSummary
from services.episode_store.ingest import idle_seconds, upload_folders
from services.episode_store.settings import EpisodeStoreSettings

logger = structlog.get_logger(__name__)

# Bounds of the histograms.
SECONDS = (0.002, 0.005, 0.01, 0.02, 0.05, 0.1, 0.2, 0.5, 1.0, 2.0, 5.0, 10.0, 30.0)
REFUSAL_REASONS: Final = ("busy", "disk", "quota", "other")
BUSY_RETRY_S = 1
FULL_RETRY_S = 30
# Maximum age of the sum of finished recordings; our own commits are counted at once.
REFRESH_S = 1.0
# Allowance for an upload's attributes and empty files.
CREATE_BYTES = 1 << 16


class Admission:
    """Limits the batches in flight, by number and by the bytes of their bodies (backpressure).

    A batch is admitted before its body is read, so a refused one costs no memory. A single batch is
    always admitted. Belongs to one event loop.
    """

    def __init__(self, *, max_requests: int, max_bytes: int) -> None:
        # Batches are written by threads of their own; reads and commits use others.
        self.threads = anyio.CapacityLimiter(max_requests)
        self._max_requests, self._max_bytes = max_requests, max_bytes
        self._num_requests = self._num_bytes = 0

    @contextmanager
    def admitted(self, num_bytes: int) -> Iterator[None]:
        """Context manager that counts a body of this size while it is read and written.

        Raises LimitExceededError: with `retry_after_s`, so the answer is 429.
        """
        full = self._num_requests >= self._max_requests or (
            self._num_requests and self._num_bytes + num_bytes > self._max_bytes
        )
        if full:
            raise LimitExceededError(
                f"store is busy: {self._num_requests} batches with {self._num_bytes} bytes "
                f"are being written, allowed are {self._max_requests} and {self._max_bytes}; "
                f"send the batch again in {BUSY_RETRY_S} s",
                reason="busy",
                retry_after_s=BUSY_RETRY_S,
            )
        self._num_requests += 1
        self._num_bytes += num_bytes
        try:
            yield
        finally:
            self._num_requests -= 1
            self._num_bytes -= num_bytes


def free_bytes_of(folder: Path) -> int:
    """Free disk space at a folder, which need not exist yet."""
    with disk_errors(f"measure free space of {folder}"):
        while not folder.exists():
            folder = folder.parent
        return shutil.disk_usage(folder).free


class StorageLimits:
    """Disk usage by uploads: a reserve stays free, and each station keeps to its quota.

    Unfinished uploads and finished recordings count. The reserve is for finishing uploads, which
    copies them. Thread-safe. Every check raises StorageFullError with `retry_after_s`; nothing was
    written then. `folder` has the unfinished uploads; `recordings` tells the bytes of finished
    recordings by station.
    """

    def __init__(
        self,
        folder: Path,
        settings: EpisodeStoreSettings,
        *,
        recordings: Callable[[], dict[str, int]],
    ) -> None:
        self._folder, self._recordings = folder, recordings
        self._quota, self._min_free = settings.quota_bytes_per_station, settings.min_free_bytes
        self._guard = threading.Lock()
        # Station and bytes of unfinished uploads.
        self._uploads: dict[str, tuple[str, int]] = {
            path.name: (attributes.station, folder_bytes(path))
            for path, attributes in self._spools()
        }
        self._finished: tuple[float, dict[str, int]] | None = None

    @property
    def num_open(self) -> int:
        """Number of unfinished uploads."""
        return len(self._uploads)

    def free_bytes(self) -> int:
        """Free bytes of the disk, including the reserve."""
        return free_bytes_of(self._folder.parent)

    def check_new(self, station: str) -> None:
        """Check that a station may begin an upload."""
        self._check_disk(CREATE_BYTES, self._min_free, "upload")
        self._check_quota(station, CREATE_BYTES)

    def check_batch(self, recording_id: str, num_bytes: int) -> None:
        """Check that so many bytes of an upload may come."""
        self._check_disk(num_bytes, self._min_free, "upload")
        if (upload := self._uploads.get(recording_id)) is not None:
            self._check_quota(upload[0], num_bytes)

    def check_finish(self, recording_id: str) -> None:
        """Check that an upload can be copied; this may use the reserve."""
        self._check_disk(self._uploads.get(recording_id, ("", 0))[1], 0, "finish")

    def begin(self, attributes: RecordingAttributes) -> None:
        """Register a new upload."""
        with self._guard:
            self._uploads.setdefault(attributes.recording_id, (attributes.station, 0))

    def add(self, recording_id: str, num_bytes: int) -> None:
        """Add bytes of an upload."""
        with self._guard:
            if recording_id in self._uploads:
                station, before = self._uploads[recording_id]
                self._uploads[recording_id] = station, before + num_bytes

    def end(self, recording_id: str) -> None:
        """Unregister an upload that was finished or dropped."""
        with self._guard:
            self._uploads.pop(recording_id, None)
            self._finished = None

    def idle(self, *, idle_s: float) -> UploadList:
        """Uploads that have been idle for `idle_s`, by id."""
        found = [
            UploadSummary(
                recording_id=path.name,
                station=attributes.station,
                task=attributes.task,
                num_bytes=folder_bytes(path),
                idle_s=since_s,
            )
            for path, attributes in self._spools()
            if (since_s := idle_seconds(path)) >= idle_s
        ]
        return UploadList(uploads=tuple(found))

    def _check_disk(self, num_bytes: int, reserve: int, what: str) -> None:
        free = self.free_bytes()
        if free - num_bytes < reserve:
            raise StorageFullError(
                f"{what}: {num_bytes} bytes exceed the {free} free bytes ({reserve} reserved); "
                "acknowledged batches are kept, free space on the store's disk",
                reason="disk",
                got=free,
                expected=reserve + num_bytes,
                retry_after_s=FULL_RETRY_S,
            )

    def _check_quota(self, station: str, num_bytes: int) -> None:
        if self._quota is None:
            return
        now = time.monotonic()
        with self._guard:
            if self._finished is None or now - self._finished[0] > REFRESH_S:
                self._finished = (now, self._recordings())
            uploads = (size for whose, size in self._uploads.values() if whose == station)
            used = self._finished[1].get(station, 0) + sum(uploads)
        if used + num_bytes > self._quota:
            raise StorageFullError(
                f"station {station!r}: {used} bytes are in use and {num_bytes} more were sent, "
                f"allowed are {self._quota}; delete recordings or expire uploads of this station",
                reason="quota",
                got=used + num_bytes,
                expected=self._quota,
                retry_after_s=FULL_RETRY_S,
            )

    def _spools(self) -> list[tuple[Path, RecordingAttributes]]:
        found = []
        for path in upload_folders(self._folder):
            try:
                found.append((path, read_attributes(path)))
            except NotFoundError:
                continue  # no upload, or finished while we were listing
            except StorageError as error:
                logger.warning("damaged_upload", recording_id=path.name, reason=error.message)
        return found


class UploadMetrics:
    """Prometheus metrics of a store, in a `registry`: uploads, and what the limits measure."""

    def __init__(self, limits: StorageLimits, num_items: Callable[[Kind], int]) -> None:
        registry = self.registry = CollectorRegistry()
        text = "Acknowledged batches; replayed ones were stored before."
        self.batches = Counter("dextouch_store_batches", text, ("replayed",), registry=registry)
        text = "Bytes of acknowledged new batches."
        self.bytes = Counter("dextouch_store_batch_bytes", text, registry=registry)
        text = "Refused upload requests by the exhausted resource."
        self.refused = Counter("dextouch_store_refused", text, ("reason",), registry=registry)
        self.ack_seconds, self.finish_seconds = (
            Histogram(f"dextouch_store_{name}_seconds", text, buckets=SECONDS, registry=registry)
            for name, text in (
                ("ack", "Time from admission of a batch to its acknowledgement."),
                ("finish", "Time from the request to finish an upload to the committed recording."),
            )
        )
        # A rate needs a first value to grow from.
        for reason in REFUSAL_REASONS:
            self.refused.labels(reason)
        for replayed in ("true", "false"):
            self.batches.labels(replayed)
        for name, text, measure in (
            ("open_uploads", "Unfinished uploads.", lambda: limits.num_open),
            ("free_bytes", "Free bytes on the store's disk.", limits.free_bytes),
        ):
            Gauge(f"dextouch_store_{name}", text, registry=registry).set_function(measure)
        text = "Recordings and episodes in the catalog, as it was last read."
        items = Gauge("dextouch_store_items", text, ("kind",), registry=registry)
        for kind in KINDS:
            items.labels(kind).set_function(partial(num_items, kind))

    def count(self, receipt: BatchReceipt, *, num_bytes: int, took_s: float) -> None:
        """Count a batch of so many bytes that was acknowledged in `took_s` after its admission."""
        self.ack_seconds.observe(took_s)
        self.batches.labels(str(receipt.replayed).lower()).inc()
        if not receipt.replayed:
            self.bytes.inc(num_bytes)

    @contextmanager
    def counting_refusals(self) -> Iterator[None]:
        """Count uploads that are refused inside, by the exhausted resource."""
        try:
            yield
        except (LimitExceededError, StorageFullError) as error:
            self.refused.labels(str(error.details.get("reason", "other"))).inc()
            raise
