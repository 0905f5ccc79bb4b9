"""One take in the spool: what is appended to it, and how safe it is from a power loss."""

import os
import threading
from itertools import dropwhile
from pathlib import Path

import structlog

from dextouch.episodes import disk_errors, is_keyframe
from dextouch.episodes.spool import LOG_FILE, SpoolWriter
from dextouch.errors import StorageError, StorageFullError
from dextouch.schemas import TakeCause, TakeCheck
from dextouch.streams import H264_UNIT, EncodedBatch, Sample, SampleBatch
from services.acquisition.clock import PeriodicCall, StationClock
from services.acquisition.drivers.base import Readings
from services.acquisition.settings import SpoolSafety
from services.acquisition.take_check import TakeWatch

logger = structlog.get_logger(__name__)

MEBIBYTE = 2**20
# A disk may be slow for this long before the take counts as stalled.
STALL_NS = 10_000_000_000


def check_free_space(folder: Path, safety: SpoolSafety) -> None:
    """Refuse to write on where so little is left that a take could not be closed any more.

    Raises:
        StorageFullError: less than `min_free_bytes` are left.
    """
    with disk_errors(f"measure free space of {folder}"):
        disk = os.statvfs(folder)
    free_bytes = disk.f_bavail * disk.f_frsize
    if free_bytes < safety.min_free_bytes:
        raise StorageFullError(
            f"spool {folder.name!r}: no space left to continue: "
            f"{free_bytes / MEBIBYTE:.0f} MiB free, {safety.min_free_bytes / MEBIBYTE:.0f} MiB are "
            "reserved for closing takes; the data recorded so far can be saved; free space before "
            "the next take",
            free_bytes=free_bytes,
        )


class Take:
    """One running or ended take: reader threads append to its spool, a thread of its own flushes.

    The only lock that readers take is held for the write of one append: data is encoded before, and
    other threads wait for the disk. The thread that flushes has its own descriptor of the log and
    takes no lock; the disk's error, or a disk that is nearly full, ends the take.
    """

    def __init__(
        self, spool: SpoolWriter, watch: TakeWatch, *, clock: StationClock, safety: SpoolSafety
    ) -> None:
        self.spool = spool
        self.watch = watch
        self._failure: str | None = None
        self._lock = threading.RLock()
        # Of video only what can be looked at without what came before the take: these streams wait
        # for the first image that begins a group.
        self._waiting = {s.name for s in spool.attributes.streams if s.unit == H264_UNIT}
        self._safety = safety
        self._clock = clock
        self._flushed_ns = clock.now_ns()
        self._flush_period_ns = round(safety.flush_period_s * 1e9)
        with disk_errors(f"open log of spool {spool.path.name!r}"):
            self._log = os.open(spool.path / LOG_FILE, os.O_RDONLY)
        # None once it has ended: it holds this take, and the two must not outlive it as a circle.
        self._flushes: PeriodicCall | None = PeriodicCall(
            self._flush, period_ns=self._flush_period_ns, clock=clock, name="flush-spool"
        )
        self._flushes.start()

    def is_working(self) -> bool:
        """Whether readings get through and flushes return; waits a moment for the disk."""
        if self.watch.has_ended:
            return True
        if not self._lock.acquire(timeout=STALL_NS / 1e9):
            return False
        self._lock.release()
        return self._clock.now_ns() - self._flushed_ns < STALL_NS + self._flush_period_ns

    def accept(self, readings: Readings) -> None:
        """Append new readings (called by the reader threads); nothing after the end.

        A stream's readings come from one thread, so its bytes are made before the lock is taken.
        """
        if self.watch.has_ended:
            return
        encoded = [self._encode(name, samples) for name, samples in readings.items()]
        with self._lock:
            try:
                for record, samples in encoded:
                    if record is not None and not self.watch.has_ended:
                        self.spool.append_record(record)
                        self.watch.streams[record.stream_name].add(samples)
            except StorageError as error:
                self._end(error)

    def _encode(self, name: str, samples: list[Sample]) -> tuple[EncodedBatch | None, list[Sample]]:
        if name in self._waiting:
            samples = list(dropwhile(lambda s: not is_keyframe(s.values.item()), samples))
        if not samples:
            return None, samples
        self._waiting.discard(name)
        return self.spool.encode(name, SampleBatch.from_samples(samples)), samples

    def end(self) -> TakeCheck:
        """Accept no more readings, flush the spool to the disk and check the take."""
        self._end()
        self._stop_flushing()
        self.watch.look()
        if self._failure is None:
            try:
                self.spool.flush()
            except StorageError as error:
                self._failure = error.message
        check = self.watch.check()
        if self._failure is None:
            return check
        cause = TakeCause(message=self._failure, advice="Free space on the disk of the spool.")
        return check.model_copy(update={"cause": cause})

    def release(self) -> None:
        """Give threads and files back; what was spooled stays as it is."""
        self._end()
        self._stop_flushing()
        self.spool.abandon()

    def problems(self) -> tuple[str, ...]:
        """What ended or disturbed the take as a whole."""
        failure = (self._failure,) if self._failure else ()
        return (*failure, *self.watch.host_problems())

    def _end(self, error: StorageError | None = None) -> None:
        with self._lock:
            if error is not None and not self.watch.has_ended:
                self._failure = error.message
                logger.error("stop_take_by_disk", error=error.message)
            self.watch.end()
            flushes = self._flushes  # Another thread may end it meanwhile.
            if flushes is not None:
                flushes.cancel()

    def _flush(self) -> None:
        """Make what was spooled survive a power loss."""
        try:
            self.watch.look()
            check_free_space(self.spool.path, self._safety)
            with disk_errors(f"flush spool {self.spool.path.name!r}"):
                os.fdatasync(self._log)
            self._flushed_ns = self._clock.now_ns()
        except StorageError as error:
            self._end(error)

    def _stop_flushing(self) -> None:
        flushes, self._flushes = self._flushes, None
        if flushes is not None:
            flushes.stop()
            os.close(self._log)
