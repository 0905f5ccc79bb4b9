"""One take from its first reading to its check, in a spool that outlives the process."""

import threading
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, fields, replace

import structlog

from dextouch.episodes.spool import SpoolWriter, StreamRecord
from dextouch.errors import StorageError
from dextouch.schemas import LedgerEntry
from dextouch.streams import Sample, SampleBatch
from services.acquisition.clock import HostWatch, StationClock
from services.acquisition.completeness import (
    StreamFacts,
    TakeSpan,
    check_take,
    take_ledger,
    take_quality,
)
from services.acquisition.counters import StreamCounters
from services.acquisition.drivers.base import Driver, Readings
from services.acquisition.drivers.image_encoding import take_gates
from services.acquisition.drivers.packet_search import DecoderStatistics
from services.acquisition.schemas import TakeCheck
from services.acquisition.supervisor import JUDGED_EVENTS, SpoolFlusher, SpoolSafety
from services.acquisition.take_findings import HealthSource, TakeFindings

logger = structlog.get_logger(__name__)

DeviceEvents = Mapping[str, Mapping[str, int]]


def _no_events() -> DeviceEvents:
    return {}


@dataclass(frozen=True)
class TakeOptions:
    """How takes are kept, and who counts what happens to devices besides their decoders.

    `device_events` gives, by device, counts of named events since the station's start; `health`
    provides the findings of the station in the meantime.
    """

    safety: SpoolSafety = field(default_factory=SpoolSafety)
    device_events: Callable[[], DeviceEvents] = _no_events
    health: HealthSource | None = None


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
        self.failure: str | None = None
        self.span: TakeSpan | None = None
        self.facts: list[StreamFacts] = []
        self.streams = {d.name: StreamCounters() for d in spool.attributes.streams}
        self._drivers = drivers
        self._clock = clock
        self._options = options
        self._started_ns = clock.now_ns()
        self._before = {name: _copy(d.statistics) for name, d in drivers.items()}
        self._events_before = options.device_events()
        self._events: dict[str, dict[str, int]] = {}
        self._watch = HostWatch(clock)
        self._findings = TakeFindings(options.health, self._started_ns)
        self._lock = threading.Lock()
        self._gates = take_gates(spool.attributes.streams)
        self.flusher = SpoolFlusher(
            spool.path,
            safety=options.safety,
            clock=clock,
            on_tick=self._look_around,
            on_failure=self._fail,
        )

    @property
    def has_ended(self) -> bool:
        """Whether it takes no more readings: stopped, or failed."""
        return self.span is not None

    @property
    def duration_s(self) -> float:
        """Length up to now, or up to the end."""
        if self.span is not None:
            return self.span.duration_s
        return (self._clock.now_ns() - self._started_ns) / 1e9

    def accept(self, readings: Readings) -> None:
        """Append new readings (called by the reader threads); nothing after the end.

        A stream's readings come from one thread, so its bytes are made before the lock is taken.
        """
        if self.has_ended:
            return
        encoded = [self._encode(name, samples) for name, samples in readings.items()]
        with self._lock:
            if self.span is not None:
                return
            try:
                for record, samples in encoded:
                    if record is not None:
                        self.spool.append_record(record)
                        self.streams[record.stream_name].add(samples)
            except StorageError as error:
                self._end(error)

    def _encode(self, name: str, samples: list[Sample]) -> tuple[StreamRecord | None, list[Sample]]:
        if name in self._gates:
            # Of video only what can be looked at without what came before the take.
            samples = self._gates[name].admit(samples)
        if not samples:
            return None, samples
        return self.spool.encode(name, SampleBatch.from_samples(samples)), samples

    def end(self) -> TakeCheck:
        """Accept no more readings, flush the spool to the disk and check the take."""
        with self._lock:
            span = self._end(None)
        self.flusher.join()
        self._watch.look()
        if self.failure is None:
            try:
                self.spool.flush()
            except StorageError as error:
                self.failure = error.message
        check = check_take(self.facts, span)
        found = self._findings.problems(self.streams, check.problems)
        return check.model_copy(update={"problems": (*check.problems, *found)})

    def release(self) -> None:
        """Give threads and files back; what was spooled stays as it is."""
        with self._lock:
            self._end(None)
        self.flusher.join()
        self.spool.abandon()

    def problems(self) -> tuple[str, ...]:
        """What ended or disturbed the take as a whole."""
        failure = (self.failure,) if self.failure else ()
        return (*failure, *self._watch.problems())

    def ledger(self) -> tuple[LedgerEntry, ...]:
        """Everything that was noticed during the take, counted."""
        entries = list(take_ledger(self.facts))
        known = {(entry.stream, entry.event) for entry in entries}
        for fact in self.facts:
            name = fact.descriptor.name
            device_events = self._events.get(fact.descriptor.device or "", {})
            entries += [
                LedgerEntry(stream=name, event=event, count=count)
                for event, count in device_events.items()
                if count and (name, event) not in known
            ]
            entries += [
                LedgerEntry(
                    stream=name, event=event, count=e.count, first_t_host_ns=e.first_t_host_ns
                )
                for event, e in self._watch.events.items()
                if e.count
            ]
        known = {(entry.stream, entry.event) for entry in entries}
        # Where the devices count the same event themselves, their count is the exact one.
        found = self._findings.entries(self.streams)
        return (*entries, *(e for e in found if (e.stream, e.event) not in known))

    def quality(self) -> dict[str, float]:
        """Figures of the ended take by stream."""
        if self.span is None:
            return {}
        judged = {
            f"{fact.descriptor.name}_num_{event}": float(count)
            for fact in self.facts
            for event, count in self._events.get(fact.descriptor.device or "", {}).items()
            if event in JUDGED_EVENTS
        }
        return {**self._findings.quality(), **judged, **take_quality(self.facts, self.span)}

    def _look_around(self) -> None:
        self._watch.look()
        self._findings.look()

    def _fail(self, error: StorageError) -> None:
        with self._lock:
            self._end(error)

    def _end(self, error: StorageError | None) -> TakeSpan:
        """Freeze the facts at this moment; the caller holds the lock."""
        if self.span is not None:
            return self.span
        if error is not None:
            self.failure = error.message
            logger.error("stop_take_by_disk", error=error.message)
        self._findings.end()
        self._events = _grown(self._options.device_events(), self._events_before)
        self.facts = [
            StreamFacts(
                descriptor,
                self.streams[descriptor.name],
                self._counted(name, driver),
            )
            for name, driver in self._drivers.items()
            for descriptor in driver.descriptors
        ]
        self.span = TakeSpan(self._started_ns, self._clock.now_ns())
        self.flusher.cancel()
        return self.span

    def _counted(self, device: str, driver: Driver) -> DecoderStatistics:
        """What the decoder counted during the take."""
        counted = _difference(driver.statistics, self._before[device])
        # What was missing before the take and came in it is no loss of the take, nor a gain.
        return replace(counted, lost=max(0, counted.lost))


def _grown(after: DeviceEvents, before: DeviceEvents) -> dict[str, dict[str, int]]:
    return {
        device: {name: n - before.get(device, {}).get(name, 0) for name, n in counts.items()}
        for device, counts in after.items()
    }


def _copy(statistics: DecoderStatistics) -> DecoderStatistics:
    return _difference(statistics, DecoderStatistics())


def _difference(later: DecoderStatistics, earlier: DecoderStatistics) -> DecoderStatistics:
    return DecoderStatistics(
        **{f.name: getattr(later, f.name) - getattr(earlier, f.name) for f in fields(later)}
    )
