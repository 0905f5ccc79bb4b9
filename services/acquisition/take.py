"""A take: its samples in the spool, and what is said of it: its check, ledger and quality.

Completeness is judged by the take's own samples. What the station's health found meanwhile adds
warnings to the check, entries to the ledger and figures to the quality.
"""

import os
import threading
from collections import Counter
from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from dataclasses import dataclass
from itertools import dropwhile
from pathlib import Path
from typing import Final, Literal

import structlog

from dextouch.episodes import disk_errors, is_keyframe
from dextouch.episodes.spool import LOG_FILE, SpoolWriter
from dextouch.errors import StorageError, StorageFullError
from dextouch.schemas import (
    MAX_CAUSE,
    HealthCause,
    LedgerEntry,
    StreamTake,
    TakeCause,
    TakeCheck,
    TakeProblem,
)
from dextouch.streams import H264_UNIT, EncodedBatch, Sample, SampleBatch, StreamDescriptor
from services.acquisition.clock import HostWatch, PeriodicCall, StationClock
from services.acquisition.drivers.base import Driver, Readings
from services.acquisition.health.causes import SIMULATED_ADVICE
from services.acquisition.health.cells import count_taxels
from services.acquisition.health.codes import CODES
from services.acquisition.health.glove_records import is_ours
from services.acquisition.health.monitor import HealthMonitor, longest_gap_ns
from services.acquisition.settings import SpoolSafety
from services.acquisition.supervisor import StreamCounters
from services.acquisition.watches import FollowCounts, FollowWatch

logger = structlog.get_logger(__name__)

# What the check of the take reports itself, by the code of the health finding behind it.
IN_THE_CHECK: Final[Mapping[str, tuple[str, ...]]] = {
    "silent": ("gap", "missing_stream"),
    "unplugged": ("gap", "missing_stream"),
    "gap": ("gap", "missing_stream"),
    "rate": ("rate", "missing_stream"),
    "loss": ("loss",),
    "taxels_dead": ("dead_taxels",),
    "taxels_stuck": ("stuck_taxels",),
    "taxels_saturated": ("saturated_taxels",),
}
SUSPENDED: Final = "Switch off the suspend mode of this computer and record the take again."
BROKEN_DISK: Final = "Check the disk of the spool: its cable, whether it is mounted and writable."
# Gravest first; other codes follow.
_ORDER: Final = ("missing_stream", "gap", "rate", "loss")
# Code of the health finding whose advice fits a problem of the check.
_ADVICE: Final = {
    "missing_stream": "silent",
    "dead_taxels": "taxels_dead",
    "stuck_taxels": "taxels_stuck",
    "saturated_taxels": "taxels_saturated",
}
# A take may lose more than a running station before it is not worth keeping.
LOSS_ERROR = 0.05
# Shorter takes say nothing about rates and loss ratios.
MIN_JUDGED_S = 1.0
# What stands in the take's quality in a form of its own (`_rate_hz`), or counts from the
# station's start.
OTHER_FIGURES = {"rate_hz", "clock_offset_seconds", "clock_resets"}
MEBIBYTE = 2**20
# A disk may be slow for this long before the take counts as stalled.
STALL_NS = 10_000_000_000
DeviceEvents = Mapping[str, Mapping[str, int]]


def root_cause(
    problems: Sequence[TakeProblem], causes: Sequence[HealthCause], simulated: Collection[str] = ()
) -> TakeCause | None:
    """The cause of the gravest problem; None without problems.

    Causes are those that the station's health saw during the take, widest first.
    """
    if not problems:
        return None
    worst = min(problems, key=_rank)
    for cause in causes:
        codes = [IN_THE_CHECK.get(code, (code,)) for code in cause.findings]
        if worst.stream in cause.streams and any(worst.code in explained for explained in codes):
            return TakeCause(message=cause.message, advice=cause.advice)
    alike = {p.stream for p in problems if (p.code, p.level) == (worst.code, worst.level)}
    others = len(alike) - 1
    more = f" (and in {others} other {'stream' if others == 1 else 'streams'})" if others else ""
    advice = CODES[_ADVICE.get(worst.code, worst.code)].advice
    if worst.stream in simulated:
        advice = SIMULATED_ADVICE
    return TakeCause(message=worst.message + more, advice=advice)


def incomplete_cause(check: TakeCheck) -> str:
    """Why a take is incomplete, for its attributes; empty of a complete one."""
    if check.complete:
        return ""
    errors = "; ".join(p.message for p in check.problems if p.level == "ERROR")
    return (check.cause.message if check.cause else errors)[:MAX_CAUSE]


def _rank(problem: TakeProblem) -> tuple[bool, int]:
    known = problem.code in _ORDER
    return problem.level != "ERROR", _ORDER.index(problem.code) if known else len(_ORDER)


@dataclass(frozen=True)
class StreamFacts:
    """One stream of a take, with all that its device and its reader counted during the take.

    `span_ns` are start and end of the take on the host's clock. `judged` names the events that are
    figures of the take's quality, too.
    """

    descriptor: StreamDescriptor
    counters: StreamCounters
    events: Mapping[str, int]
    span_ns: tuple[int, int]
    judged: Collection[str] = ()

    @property
    def loss_ratio(self) -> float:
        """Share of the packets that were lost."""
        lost = self.events["lost"]
        return lost / max(1, lost + self.events["packets"])

    @property
    def rate_hz(self) -> float | None:
        """Mean rate between the first and the last sample; None of less than two."""
        first_ns, last_ns = self.counters.first_t_host_ns, self.counters.last_t_host_ns
        if first_ns is None or last_ns is None or last_ns <= first_ns:
            return None
        return (self.counters.num_samples - 1) * 1e9 / (last_ns - first_ns)

    @property
    def largest_gap_s(self) -> float:
        """Longest time without a sample, the take's ends included."""
        start_ns, stop_ns = self.span_ns
        first_ns, last_ns = self.counters.first_t_host_ns, self.counters.last_t_host_ns
        if first_ns is None or last_ns is None:
            return (stop_ns - start_ns) / 1e9
        return max(self.counters.largest_gap_ns, first_ns - start_ns, stop_ns - last_ns) / 1e9

    def taxels(self) -> dict[str, int]:
        """Numbers of dead, stuck and saturated taxels; none for streams of other devices.

        Cells of other gloves are checked by health monitoring, whose findings the check includes.
        """
        side, low, high = self.descriptor.side, self.counters.low_counts, self.counters.high_counts
        if side is None or low is None or high is None or not is_ours(self.descriptor):
            return {}
        return count_taxels(low, high, side=side, layout=self.descriptor.tactile_layout)

    def problems(self) -> Iterator[TakeProblem]:
        """What is wrong with the stream's samples."""
        name = self.descriptor.name
        if self.counters.num_samples == 0:
            text = "no sample arrived; is it connected?"
            yield _problem(name, "missing_stream", "ERROR", text)
            return
        max_gap_s = longest_gap_ns(self.descriptor) / 1e9
        if self.largest_gap_s > max_gap_s:
            text = f"{self.largest_gap_s:.2f} s without a sample, expected at most {max_gap_s:g} s"
            yield _problem(name, "gap", "ERROR", text)
        if self.span_ns[1] - self.span_ns[0] < max(MIN_JUDGED_S, max_gap_s) * 1e9:
            return
        rate_hz, nominal_hz = self.rate_hz or 0.0, self.descriptor.nominal_rate_hz
        off = abs(rate_hz / nominal_hz - 1.0)
        if off > CODES["rate"].warn:
            text = f"{rate_hz:.1f} Hz, expected {nominal_hz:g} Hz"
            yield _problem(name, "rate", "ERROR" if off > CODES["rate"].error else "WARN", text)
        loss = self.loss_ratio
        if loss > CODES["loss"].warn:
            lost, damaged = self.events["lost"], self.events["crc_errors"]
            text = f"{lost} packets lost ({loss:.1%}), {damaged} corrupt"
            yield _problem(name, "loss", "ERROR" if loss > LOSS_ERROR else "WARN", text)
        for event, count in self.taxels().items():
            if count:
                text = f"{count} {event.replace('_', ' ')} during the whole take"
                num_taxels = self.descriptor.tactile_layout.num_taxels
                is_error = count >= CODES["taxels_dead"].error * num_taxels
                yield _problem(name, event, "ERROR" if is_error else "WARN", text)


class TakeFindings:
    """Health findings in streams since this object was created.

    A finding counts as often as its level was raised or changed during the take, and once more if
    it was already raised when the take began. Findings that were not confirmed before the end are
    not included.
    """

    def __init__(self, health: HealthMonitor | None, t_host_ns: int) -> None:
        self._health = health
        self._started_ns = t_host_ns
        self._before = Counter(health.raised() if health else {})
        raised = [
            (stream.stream, finding.code)
            for stream in (health.report().streams if health else ())
            for finding in stream.findings
        ]
        # What was never raised is no finding yet: a stream that is about to begin.
        self._first_ns = {key: t_host_ns for key in raised if key in self._before}
        self._counts = Counter(self._first_ns.keys())
        self._worst: dict[str, float] = {}
        self._causes: dict[tuple[str, str], HealthCause] = {}
        self._simulated: set[str] = set()

    def look(self) -> None:
        """Update causes and the worst of each figure; called repeatedly during the take."""
        health = self._health  # Another thread may end the take meanwhile.
        if health is None:
            return
        report = health.report()
        self._causes |= {(cause.code, cause.subject): cause for cause in report.causes}
        simulated = {device.device for device in report.devices if device.simulated}
        for stream in report.streams:
            if stream.device in simulated:
                self._simulated.add(stream.stream)
            for figure, value in stream.figures.items():
                name = f"{stream.stream}_worst_{figure}"
                if figure not in OTHER_FIGURES and abs(value) >= abs(self._worst.get(name, 0.0)):
                    self._worst[name] = value

    def end(self) -> None:
        """Count what was raised; what comes later is not of this take."""
        if self._health is None:
            return
        self.look()
        self._counts += Counter(self._health.raised()) - self._before
        for event in self._health.events(self._started_ns).events:
            if event.level != "OK":
                self._first_ns.setdefault((event.stream, event.code), event.t_host_ns)
        self._health = None

    def entries(self, streams: Collection[str]) -> list[LedgerEntry]:
        """One entry a finding of these streams, named by its code."""
        return [
            LedgerEntry(
                stream=stream,
                event=code,
                count=count,
                first_t_host_ns=self._first_ns.get((stream, code)),
            )
            for (stream, code), count in self._counts.items()
            if stream in streams
        ]

    def quality(self) -> dict[str, float]:
        """The worst of each figure of health during the take, as `STREAM_worst_FIGURE`."""
        return dict(self._worst)

    def cause(self, problems: Sequence[TakeProblem]) -> TakeCause | None:
        """Root cause of the gravest problem, by the causes that health named during the take."""
        return root_cause(problems, tuple(self._causes.values()), self._simulated)

    def problems(
        self, streams: Collection[str], known: Collection[TakeProblem]
    ) -> list[TakeProblem]:
        """The findings of these streams in words, but for those that the check names already.

        They are warnings: whether a take is complete is judged by its own samples.
        """
        known_codes = {(problem.stream, problem.code) for problem in known}
        found = []
        for entry in self.entries(streams):
            codes = IN_THE_CHECK.get(entry.event, (entry.event,))
            if any((entry.stream, code) in known_codes for code in codes):
                continue
            times = "once" if entry.count == 1 else f"{entry.count} times"
            # Nothing of a simulated device can be plugged or replaced.
            is_simulated = entry.stream in self._simulated
            advice = "" if is_simulated else f". {CODES[entry.event].advice}"
            text = f"{entry.event} found {times}{advice}"
            found.append(_problem(entry.stream, entry.event, "WARN", text))
        return found


class TakeWatch:
    """What happens to the streams, devices and host of a take, from now until `end`.

    `device_events` gives counts of named events by device, since the station's start.

    Attributes:
        streams: counters by name of the samples that the take keeps.
        has_ended: whether what comes is no longer of the take.
        started_ns: when it began, on the station's clock.
    """

    def __init__(
        self,
        drivers: Mapping[str, Driver],
        clock: StationClock,
        *,
        device_events: Callable[[], DeviceEvents] | None = None,
        health: HealthMonitor | None = None,
        follow: FollowWatch | None = None,
    ) -> None:
        self.streams = {
            d.name: StreamCounters() for driver in drivers.values() for d in driver.descriptors
        }
        self.has_ended = False
        self._drivers = drivers
        self._clock = clock
        self._count = device_events or (
            lambda: {name: driver.events() for name, driver in drivers.items()}
        )
        self.started_ns = clock.now_ns()
        self._stopped_ns = 0
        self._before = self._count()
        self._facts: list[StreamFacts] = []
        self._host = HostWatch(clock)
        self._findings = TakeFindings(health, self.started_ns)
        self._count_follow = follow.counts if follow else dict[str, FollowCounts]
        self._follow = self._count_follow()

    @property
    def duration_s(self) -> float:
        """Length up to now, or up to the end."""
        stop_ns = self._stopped_ns if self.has_ended else self._clock.now_ns()
        return (stop_ns - self.started_ns) / 1e9

    def look(self) -> None:
        """Notice what does not last; called repeatedly during the take and once after its end."""
        self._host.look()
        self._findings.look()

    def end(self) -> None:
        """Freeze what is known at this moment, once."""
        if self.has_ended:
            return
        self._findings.end()
        after_follow = self._count_follow()
        self._follow = {n: after_follow[n].since(c) for n, c in self._follow.items()}
        after, self._stopped_ns = self._count(), self._clock.now_ns()
        for name, driver in self._drivers.items():
            before = self._before[name]
            events = {event: count - before[event] for event, count in after[name].items()}
            # What was missing before the take and came in it is no loss of the take, nor a gain.
            events["lost"] = max(0, events["lost"])
            judged = driver.events().keys() - vars(driver.statistics).keys()
            span_ns = (self.started_ns, self._stopped_ns)
            self._facts += [
                StreamFacts(d, self.streams[d.name], events, span_ns, judged)
                for d in driver.descriptors
            ]
        self.has_ended = True

    def host_problems(self) -> tuple[str, ...]:
        """What the host did to the take as a whole."""
        return self._host.problems()

    def check(self) -> TakeCheck:
        """Judge the ended take: complete means no problem of level ERROR."""
        own = [problem for fact in self._facts for problem in fact.problems()]
        streams = tuple(
            StreamTake(
                stream=fact.descriptor.name,
                num_samples=fact.counters.num_samples,
                rate_hz=fact.rate_hz,
                largest_gap_s=fact.largest_gap_s,
                lost=fact.events["lost"],
                crc_errors=fact.events["crc_errors"],
            )
            for fact in self._facts
        )
        followed = self._follow_problems()
        problems = (*own, *followed, *self._findings.problems(self.streams, own))
        cause = self._findings.cause(problems)
        if self._host.events["host_suspended"]:
            cause = TakeCause(message=self.host_problems()[0], advice=SUSPENDED)
        return TakeCheck(
            complete=all(problem.level != "ERROR" for problem in own),
            duration_s=self.duration_s,
            streams=streams,
            problems=problems,
            cause=cause,
        )

    def _follow_problems(self) -> Iterator[TakeProblem]:
        for name, counts in self._follow.items():
            share = counts.figures().get("not_followed_ratio", 0.0)
            if share > CODES["not_followed"].warn:
                yield _problem(name, "not_followed", "WARN", counts.words())

    def ledger(self) -> tuple[LedgerEntry, ...]:
        """Everything that was noticed during the take, counted."""
        entries = []
        for fact in self._facts:
            counted = {**fact.events, **fact.taxels(), "packets": 0}
            name = fact.descriptor.name
            entries += [LedgerEntry(stream=name, event=e, count=n) for e, n in counted.items() if n]
        entries += [
            LedgerEntry(stream=name, event=event, count=len(e), first_t_host_ns=e[0][0])
            for name in self.streams
            for event, e in self._host.events.items()
            if e
        ]
        known = {(entry.stream, entry.event) for entry in entries}
        # Where the devices count the same event themselves, their count is the exact one.
        found = self._findings.entries(self.streams)
        return (*entries, *(e for e in found if (e.stream, e.event) not in known))

    def quality(self) -> dict[str, float]:
        """Figures of the ended take by stream; the episode takes them over."""
        quality = self._findings.quality()
        for name, counts in self._follow.items():
            quality |= {f"{name}_{figure}": n for figure, n in counts.figures().items()}
        for fact in self._facts:
            name, rate_hz = fact.descriptor.name, fact.rate_hz
            quality[f"{name}_largest_gap_s"] = fact.largest_gap_s
            if rate_hz is not None:
                quality[f"{name}_rate_hz"] = rate_hz
            if fact.descriptor.capabilities.sequence:
                quality[f"{name}_loss_ratio"] = fact.loss_ratio
            judged = {event: fact.events[event] for event in fact.judged}
            for event, count in {**judged, **fact.taxels()}.items():
                quality[f"{name}_num_{event}"] = float(count)
        return quality


def _problem(stream: str, code: str, level: Literal["WARN", "ERROR"], text: str) -> TakeProblem:
    return TakeProblem(stream=stream, code=code, level=level, message=f"{stream}: {text}")


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
        self._failure: StorageError | None = None
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
                self._failure = error
        check = self.watch.check()
        if self._failure is None:
            return check
        is_full = isinstance(self._failure, StorageFullError)
        advice = "Free space on the disk of the spool." if is_full else BROKEN_DISK
        cause = TakeCause(message=self._failure.message, advice=advice)
        return check.model_copy(update={"cause": cause})

    def release(self) -> None:
        """Give threads and files back; what was spooled stays as it is."""
        self._end()
        self._stop_flushing()
        self.spool.abandon()

    def problems(self) -> tuple[str, ...]:
        """What ended or disturbed the take as a whole."""
        failure = (self._failure.message,) if self._failure else ()
        return (*failure, *self.watch.host_problems())

    def _end(self, error: StorageError | None = None) -> None:
        with self._lock:
            if error is not None and not self.watch.has_ended:
                self._failure = error
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
