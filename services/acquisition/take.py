"""One take from its first reading to its check, in a spool that outlives the process."""

import threading
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field

import structlog

from dextouch.clocks import PathLatency
from dextouch.episodes.spool import SpoolWriter
from dextouch.errors import StorageError
from dextouch.schemas import LedgerEntry, TakeCheck
from dextouch.streams import H264_UNIT, EncodedBatch, Sample, SampleBatch
from services.acquisition.clock import HostWatch, StationClock
from services.acquisition.drivers.base import Driver, Readings
from services.acquisition.drivers.image_encoding import GroupGate
from services.acquisition.health import HealthMonitor
from services.acquisition.supervisor import SpoolFlusher, SpoolSafety, StreamCounters
from services.acquisition.take_check import (
    StreamFacts,
    TakeFindings,
    check_take,
    take_ledger,
    take_quality,
)

logger = structlog.get_logger(__name__)

DeviceEvents = Mapping[str, Mapping[str, int]]


@dataclass(frozen=True)
class TakeOptions:
    """How takes are kept, and who knows what happens to devices besides their drivers.

    `device_events` gives, by device, counts of named events since the station's start (those of the
    drivers if None); `health` provides the findings of the station in the meantime, `latencies` the
    measured path delays of streams whose delay the calibration does not name.
    """

    safety: SpoolSafety = field(default_factory=SpoolSafety)
    device_events: Callable[[], DeviceEvents] | None = None
    health: HealthMonitor | None = None
    latencies: Callable[[], Mapping[str, PathLatency]] = dict


class Take:
    """One running or ended take: reader threads append to its spool, a thread of its own flushes.

    The only lock that readers take is held for the write of one append: data is encoded before, and
    other threads wait for the disk.

    Args:
        spool: new, of this take.
        drivers: whose streams are recorded, by name.
        clock: of the station.
        options: of the recorder.
    """

    def __init__(
        self,
        spool: SpoolWriter,
        *,
        drivers: Mapping[str, Driver],
        clock: StationClock,
        options: TakeOptions,
    ) -> None:
        self.spool = spool
        self.streams = {d.name: StreamCounters() for d in spool.attributes.streams}
        self._failure: str | None = None
        self._drivers = drivers
        self._clock = clock
        self._count = options.device_events or (
            lambda: {name: driver.events() for name, driver in drivers.items()}
        )
        self._started_ns = clock.now_ns()
        self._stopped_ns: int | None = None
        self._before = self._count()
        self._facts: list[StreamFacts] = []
        self._watch = HostWatch(clock)
        self._findings = TakeFindings(options.health, self._started_ns)
        self._lock = threading.RLock()
        self._gates = {s.name: GroupGate() for s in spool.attributes.streams if s.unit == H264_UNIT}
        self._flusher = SpoolFlusher(
            spool.path,
            safety=options.safety,
            clock=clock,
            on_tick=self._look_around,
            on_failure=self._end,
        )

    @property
    def has_ended(self) -> bool:
        """Whether it takes no more readings: stopped, or failed."""
        return self._stopped_ns is not None

    @property
    def duration_s(self) -> float:
        """Length up to now, or up to the end."""
        stop_ns = self._clock.now_ns() if self._stopped_ns is None else self._stopped_ns
        return (stop_ns - self._started_ns) / 1e9

    def accept(self, readings: Readings) -> None:
        """Append new readings (called by the reader threads); nothing after the end.

        A stream's readings come from one thread, so its bytes are made before the lock is taken.
        """
        if self.has_ended:
            return
        encoded = [self._encode(name, samples) for name, samples in readings.items()]
        with self._lock:
            if self._stopped_ns is not None:
                return
            try:
                for record, samples in encoded:
                    if record is not None:
                        self.spool.append_record(record)
                        self.streams[record.stream_name].add(samples)
            except StorageError as error:
                self._end(error)

    def _encode(self, name: str, samples: list[Sample]) -> tuple[EncodedBatch | None, list[Sample]]:
        if name in self._gates:
            # Of video only what can be looked at without what came before the take.
            samples = self._gates[name].admit(samples)
        if not samples:
            return None, samples
        return self.spool.encode(name, SampleBatch.from_samples(samples)), samples

    def end(self) -> TakeCheck:
        """Accept no more readings, flush the spool to the disk and check the take."""
        self._end()
        self._flusher.join()
        self._watch.look()
        if self._failure is None:
            try:
                self.spool.flush()
            except StorageError as error:
                self._failure = error.message
        return check_take(self._facts, self.duration_s, self._findings)

    def release(self) -> None:
        """Give threads and files back; what was spooled stays as it is."""
        self._end()
        self._flusher.join()
        self.spool.abandon()

    def problems(self) -> tuple[str, ...]:
        """What ended or disturbed the take as a whole."""
        failure = (self._failure,) if self._failure else ()
        return (*failure, *self._watch.problems())

    def ledger(self) -> tuple[LedgerEntry, ...]:
        """Everything that was noticed during the take, counted."""
        entries = take_ledger(self._facts)
        entries += [
            LedgerEntry(stream=name, event=event, count=e.count, first_t_host_ns=e.first_t_host_ns)
            for name in self.streams
            for event, e in self._watch.events.items()
            if e.count
        ]
        known = {(entry.stream, entry.event) for entry in entries}
        # Where the devices count the same event themselves, their count is the exact one.
        found = self._findings.entries(self.streams)
        return (*entries, *(e for e in found if (e.stream, e.event) not in known))

    def quality(self) -> dict[str, float]:
        """Figures of the ended take by stream."""
        return {**self._findings.quality(), **take_quality(self._facts)}

    def _look_around(self) -> None:
        self._watch.look()
        self._findings.look()

    def _end(self, error: StorageError | None = None) -> None:
        """Freeze what is known of the take at this moment."""
        with self._lock:
            if self.has_ended:
                return
            if error is not None:
                self._failure = error.message
                logger.error("stop_take_by_disk", error=error.message)
            self._findings.end()
            after, stopped_ns = self._count(), self._clock.now_ns()
            for name, driver in self._drivers.items():
                before = self._before[name]
                events = {event: count - before[event] for event, count in after[name].items()}
                # What was missing before the take and came in it is no loss of the take, nor a
                # gain.
                events["lost"] = max(0, events["lost"])
                judged = driver.events().keys() - vars(driver.statistics).keys()
                span_ns = (self._started_ns, stopped_ns)
                self._facts += [
                    StreamFacts(d, self.streams[d.name], events, span_ns, judged)
                    for d in driver.descriptors
                ]
            self._stopped_ns = stopped_ns
            self._flusher.cancel()
