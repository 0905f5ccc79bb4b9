"""Reader threads of devices, with reconnection, and the flush thread of the spool."""

import os
import threading
from collections.abc import Callable, Sequence
from contextlib import closing
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import structlog
from jaxtyping import UInt16

from dextouch.episodes import disk_errors
from dextouch.episodes.spool import LOG_FILE
from dextouch.errors import DeviceError, InvalidInputError, StorageError, StorageFullError
from dextouch.streams import Sample
from services.acquisition.clock import StationClock, Waiter
from services.acquisition.drivers.base import Driver, Readings

logger = structlog.get_logger(__name__)

RETRY_NS = 200_000_000
# What stays the same is logged once and then so rarely, with its count.
LOG_AGAIN_NS = 60_000_000_000
NOTHING_LOGGED = ("", 0, 0)
# What a supervisor counts besides the driver. An error of a driver says which of them it is in its
# detail `event`.
EVENTS = (
    "lost_device",
    "wrong_version",
    "wrong_side",
    "wrong_serial_number",
    "wrong_hello",
    "wrong_nodes",
    "ambiguous_device",
    "absent_device",
    "silent_bridge",
    "driver_failure",
)
Sink = Callable[[Readings], None]
MEBIBYTE = 2**20


@dataclass
class StreamCounters:
    """One stream's counts; written by its reader thread alone.

    `num_bytes` are those of the payloads. The least and greatest count of each raw cell, which show
    a dead or pinned one, are kept where samples are raw counts of a glove, the only unsigned 16-bit
    rows there are.
    """

    num_samples: int = 0
    num_bytes: int = 0
    first_t_host_ns: int | None = None
    last_t_host_ns: int | None = None
    largest_gap_ns: int = 0
    low_counts: UInt16[np.ndarray, " n"] | None = None
    high_counts: UInt16[np.ndarray, " n"] | None = None

    def add(self, samples: Sequence[Sample]) -> None:
        """Count new samples."""
        for sample in samples:
            if self.last_t_host_ns is None:
                self._start(sample)
            else:
                gap_ns = sample.t_host_ns - self.last_t_host_ns
                self.largest_gap_ns = max(self.largest_gap_ns, gap_ns)
            self.last_t_host_ns = sample.t_host_ns
            values = sample.values
            encoded = values.dtype == np.object_
            self.num_bytes += len(values.item()) if encoded else values.nbytes
            if self.low_counts is not None and self.high_counts is not None:
                np.minimum(self.low_counts, values, out=self.low_counts)
                np.maximum(self.high_counts, values, out=self.high_counts)
        self.num_samples += len(samples)

    def _start(self, sample: Sample) -> None:
        self.first_t_host_ns = sample.t_host_ns
        if sample.values.dtype == np.uint16 and sample.values.ndim == 1:
            self.low_counts, self.high_counts = sample.values.copy(), sample.values.copy()


class DeviceSupervisor:
    """Reads one device while the station runs, and reopens it after every disconnection.

    Args:
        driver: of the device; used by the supervisor's thread alone.
        sink: called in that thread with new readings.
        clock: of the station.

    Attributes:
        connected: whether the device is open.
        reconnects: how often it was lost after it was open.
        last_error: why it was lost, or could not be opened; None while it is open.
        streams: counters of each of its streams.
    """

    def __init__(self, driver: Driver, *, sink: Sink, clock: StationClock) -> None:
        self.driver = driver
        self.connected = threading.Event()
        self.reconnects = 0
        self.last_error: str | None = None
        self.streams = {d.name: StreamCounters() for d in driver.descriptors}
        self._events = dict.fromkeys(EVENTS, 0)
        self._sink = sink
        # The last message that was logged, when, and how often it came since it was new.
        self._logged = NOTHING_LOGGED
        self._clock = clock
        self._stopping = threading.Event()
        self._waiter: Waiter | None = None
        self._waiter_lock = threading.Lock()
        self._thread = threading.Thread(target=self._run, name=f"read-{driver.name}", daemon=True)

    def start(self) -> None:
        """Start reading."""
        self._thread.start()

    def stop(self) -> None:
        """End the thread (within a read's timeout) and close the device."""
        self._stopping.set()
        with self._waiter_lock:
            if self._waiter is not None:
                self._waiter.cancel()
        if self._thread.ident is not None:
            self._thread.join()

    def events(self) -> dict[str, int]:
        """Counts of all that happened to the device since the start, by name."""
        return {**self.driver.events(), **self._events}

    def count(self, readings: Readings) -> None:
        """Count new samples (called by the reader thread)."""
        for name, samples in readings.items():
            self.streams[name].add(samples)

    def _run(self) -> None:
        while not self._stopping.is_set():
            try:
                self._read_until_lost()
            except DeviceError as error:
                self.last_error = error.message
                self._count_loss(error)
                self._log_loss(error.message)
                self._close_and_wait()
            except Exception as error:
                self._events["driver_failure"] += 1
                self.last_error = f"{type(error).__name__}: {error}"
                logger.exception("fail_device", device=self.driver.name)
                self._close_and_wait()
        self.driver.close()
        self.connected.clear()

    def _read_until_lost(self) -> None:
        self.driver.open()
        self.last_error = None
        self.connected.set()
        self._release_waiter()
        while not self._stopping.is_set():
            # A decoder may name a stream without a sample.
            readings = {name: samples for name, samples in self.driver.read().items() if samples}
            if readings:
                # A loss of a device that gave something is new, whatever it says.
                self._logged = NOTHING_LOGGED
                self.count(readings)
                self._sink(readings)

    def _count_loss(self, error: DeviceError) -> None:
        event = error.details.get("event")
        if isinstance(event, str) and event in self._events:
            self._events[event] += 1
        elif self.connected.is_set():
            # Failing to open a device that is gone is no further loss.
            self._events["lost_device"] += 1

    def _log_loss(self, message: str) -> None:
        """Log new problems at once, and continuing ones once a minute."""
        now_ns = self._clock.now_ns()
        last_message, logged_ns, count = self._logged
        if message == last_message and now_ns - logged_ns < LOG_AGAIN_NS:
            self._logged = (message, logged_ns, count + 1)
            return
        count = count + 1 if message == last_message else 1
        self._logged = (message, now_ns, count)
        logger.warning("lose_device", device=self.driver.name, error=message, count=count)

    def _close_and_wait(self) -> None:
        # The waiter comes before the closing and goes after the next opening, so that a virtual
        # clock stands still in between and a loss always costs the same time.
        with self._waiter_lock:
            if self._waiter is None:
                self._waiter = self._clock.waiter()
            if self._stopping.is_set():
                self._waiter.cancel()
        if self.connected.is_set():
            self.reconnects += 1
        self.connected.clear()
        self.driver.close()
        self._waiter.wait_until(self._clock.now_ns() + RETRY_NS)

    def _release_waiter(self) -> None:
        with self._waiter_lock:
            if self._waiter is not None:
                self._waiter.close()
                self._waiter = None


@dataclass(frozen=True)
class SpoolSafety:
    """How much a power loss may cost, and how much space is kept for closing a take.

    Raises:
        InvalidInputError: a period that is no positive number of seconds, or negative bytes.
    """

    flush_period_s: float = 0.5
    min_free_bytes: int = 64 * MEBIBYTE

    def __post_init__(self) -> None:
        if not 0 < self.flush_period_s <= 3600 or self.min_free_bytes < 0:
            raise InvalidInputError(
                f"spool safety: got a period of {self.flush_period_s} s and {self.min_free_bytes} "
                "bytes to keep free, expected 0 … 3600 s and no negative number"
            )


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


class SpoolFlusher:
    """A thread that makes a growing spool survive a power loss, again and again.

    It has its own descriptor of the log, so it needs no lock of the writers and they never wait
    for it; the disk's error, or a disk that is nearly full, ends it and is reported once.

    Args:
        path: of the spool.
        safety: how often, and how much space must be left.
        clock: of the station.
        on_tick: called in the thread before each flush.
        on_failure: called in the thread with what went wrong.
    """

    def __init__(
        self,
        path: Path,
        *,
        safety: SpoolSafety,
        clock: StationClock,
        on_tick: Callable[[], None],
        on_failure: Callable[[StorageError], None],
    ) -> None:
        self._path = path
        self._safety = safety
        self._clock = clock
        with disk_errors(f"open log of spool {path.name!r}"):
            self._log = os.open(path / LOG_FILE, os.O_RDONLY)
        self._waiter = clock.waiter()
        # The thread alone keeps the callbacks, and lets them go at its end. Kept here, they would
        # hold their take, which holds this: a circle, not free before it is looked for.
        self._thread = threading.Thread(
            target=self._run, args=(on_tick, on_failure), name="flush-spool", daemon=True
        )
        self._thread.start()

    def cancel(self) -> None:
        """End after the flush that is under way; waits for nothing."""
        self._waiter.cancel()

    def join(self) -> None:
        """Wait until it has ended (not to be called in its own thread)."""
        self._waiter.cancel()
        self._thread.join()

    def _run(self, on_tick: Callable[[], None], on_failure: Callable[[StorageError], None]) -> None:
        period_ns = round(self._safety.flush_period_s * 1e9)
        # A simulated clock stands still until the failure is reported: the waiter closes after it.
        with closing(self._waiter) as waiter:
            try:
                due_ns = self._clock.now_ns() + period_ns
                while waiter.wait_until(due_ns):
                    on_tick()
                    self._flush()
                    # After a long stop of the process one flush is enough.
                    due_ns = max(due_ns, self._clock.now_ns()) + period_ns
            except StorageError as error:
                on_failure(error)
            finally:
                os.close(self._log)

    def _flush(self) -> None:
        check_free_space(self._path, self._safety)
        with disk_errors(f"flush spool {self._path.name!r}"):
            os.fdatasync(self._log)
