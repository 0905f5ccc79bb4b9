"""Counters of the readers come in; a level with reasons for every stream goes out."""

import threading
from collections import deque
from collections.abc import Sequence
from contextlib import closing
from dataclasses import dataclass, field
from typing import Literal

import numpy as np

from dextouch.streams.descriptors import StreamDescriptor
from services.acquisition.clock import StationClock, Waiter
from services.acquisition.drivers.tactile_glove import FULL_SCALE_COUNTS
from services.acquisition.live import LiveView
from services.acquisition.schemas import DeviceHealth, Level, StationHealth, StreamHealth
from services.acquisition.supervisor import DeviceSupervisor

PERIOD_NS = 1_000_000_000
WINDOW_EVALUATIONS = 10
TAXEL_WINDOW_EVALUATIONS = 5
RAISE_AFTER = 2
CLEAR_AFTER = 5
RATE_LIMITS = (0.02, 0.10)
DROP_LIMITS = (0.001, 0.01)
DEAD_LIMITS = (1.0, 18.0)  # taxels of 360: any, 5 %
STALE_AFTER_NS = {"image": 500_000_000}
STALE_AFTER_OTHERS_NS = 200_000_000
LATE_PERIODS = 3
SEVERITY: tuple[Level, ...] = ("OK", "WARN", "ERROR", "STALE")

Judgement = Literal["OK", "WARN", "ERROR"]


@dataclass
class Hysteresis:
    """A level that rises after 2 and falls after 5 evaluations that agree."""

    level: Judgement = "OK"
    _candidate: Judgement = "OK"
    _count: int = 0

    def update(self, judgement: Judgement) -> Judgement:
        """One evaluation."""
        if judgement == self.level:
            self._count = 0
            return self.level
        self._count = self._count + 1 if judgement == self._candidate else 1
        self._candidate = judgement
        rises = SEVERITY.index(judgement) > SEVERITY.index(self.level)
        if self._count >= (RAISE_AFTER if rises else CLEAR_AFTER):
            self.level, self._count = judgement, 0
        return self.level


@dataclass(frozen=True)
class _Snapshot:
    """Counts of one stream and its device at one evaluation."""

    t_host_ns: int
    num_samples: int
    packets: int
    lost: int
    damaged: int
    reconnects: int


@dataclass
class _StreamState:
    snapshots: deque[_Snapshot] = field(
        default_factory=lambda: deque(maxlen=WINDOW_EVALUATIONS + 1)
    )
    pinned: deque[np.ndarray] = field(
        default_factory=lambda: deque(maxlen=TAXEL_WINDOW_EVALUATIONS)
    )
    hysteresis: Hysteresis = field(default_factory=Hysteresis)
    reasons: tuple[str, ...] = ()
    rate_hz: float | None = None


class HealthMonitor:
    """Evaluates all streams once a second, in its own thread; readers never wait for it.

    Staleness is judged whenever someone asks, since it must show within 0.3 s.
    """

    def __init__(
        self,
        supervisors: Sequence[DeviceSupervisor],
        *,
        live: LiveView,
        clock: StationClock,
        station: str,
    ) -> None:
        self._supervisors = list(supervisors)
        self._live = live
        self._clock = clock
        self._station = station
        self._states = {
            d.name: _StreamState() for s in self._supervisors for d in s.driver.descriptors
        }
        self._lock = threading.Lock()
        self._waiter: Waiter | None = None
        self._thread = threading.Thread(target=self._run, name="health", daemon=True)

    def start(self) -> None:
        """Start evaluating."""
        self._waiter = self._clock.waiter()
        self._thread.start()

    def stop(self) -> None:
        """End the thread."""
        if self._waiter is not None:
            self._waiter.cancel()
            self._thread.join()

    def evaluate(self) -> None:
        """One evaluation now."""
        now_ns = self._clock.now_ns()
        with self._lock:
            for supervisor in self._supervisors:
                for descriptor in supervisor.driver.descriptors:
                    self._evaluate(supervisor, descriptor, now_ns)

    def report(self) -> StationHealth:
        """Every stream and device at this moment."""
        now_ns = self._clock.now_ns()
        with self._lock:
            streams = [
                self._stream_health(supervisor, descriptor, now_ns)
                for supervisor in self._supervisors
                for descriptor in supervisor.driver.descriptors
            ]
        worst: Level = max((s.level for s in streams), key=SEVERITY.index, default="STALE")
        return StationHealth(
            station=self._station,
            level=worst,
            streams=tuple(streams),
            devices=tuple(device_health(s) for s in self._supervisors),
        )

    def _run(self) -> None:
        if self._waiter is None:
            return
        with closing(self._waiter) as waiter:
            due_ns = self._clock.now_ns() + PERIOD_NS
            while waiter.wait_until(due_ns):
                self.evaluate()
                # After a long stop of the process one evaluation is enough.
                due_ns = max(due_ns, self._clock.now_ns()) + PERIOD_NS

    def _evaluate(
        self, supervisor: DeviceSupervisor, descriptor: StreamDescriptor, now_ns: int
    ) -> None:
        state = self._states[descriptor.name]
        statistics = supervisor.driver.statistics
        state.snapshots.append(
            _Snapshot(
                now_ns,
                supervisor.counters.streams[descriptor.name].num_samples,
                statistics.packets,
                statistics.lost,
                statistics.crc_errors + statistics.length_errors + statistics.refused,
                supervisor.counters.reconnects,
            )
        )
        if len(state.snapshots) < 2:
            return
        first, last = state.snapshots[0], state.snapshots[-1]
        elapsed_s = max(1, last.t_host_ns - first.t_host_ns) / 1e9
        state.rate_hz = (last.num_samples - first.num_samples) / elapsed_s
        findings = judge_window(first, last, rate_hz=state.rate_hz, descriptor=descriptor)
        if descriptor.kind == "tactile":
            findings += self._judge_taxels(descriptor.name, state)
        worst: Judgement = "OK"
        for judgement, _ in findings:
            worst = max(worst, judgement, key=SEVERITY.index)
        state.hysteresis.update(worst)
        state.reasons = tuple(reason for _, reason in findings)

    def _judge_taxels(self, stream: str, state: _StreamState) -> list[tuple[Judgement, str]]:
        counts = self._live.take_counts(stream)
        if len(counts):
            pinned = np.all(counts == 0, axis=0) | np.all(counts == FULL_SCALE_COUNTS, axis=0)
            state.pinned.append(pinned)
        if len(state.pinned) < TAXEL_WINDOW_EVALUATIONS:
            return []
        num_dead = int(np.logical_and.reduce(list(state.pinned)).sum())
        if num_dead < DEAD_LIMITS[0]:
            return []
        return [_finding(float(num_dead), DEAD_LIMITS, f"{num_dead} taxels dead or saturated")]

    def _stream_health(
        self, supervisor: DeviceSupervisor, descriptor: StreamDescriptor, now_ns: int
    ) -> StreamHealth:
        state = self._states[descriptor.name]
        counters = supervisor.counters.streams[descriptor.name]
        level: Level = state.hysteresis.level
        reasons = state.reasons if level != "OK" else ()
        age_ns = None
        if counters.last_t_host_ns is not None:
            age_ns = max(0, now_ns - counters.last_t_host_ns)
        stale_ns = STALE_AFTER_NS.get(descriptor.kind, STALE_AFTER_OTHERS_NS)
        if age_ns is None or age_ns > stale_ns:
            level = "STALE"
            reasons = (supervisor.counters.last_error or "no data", *reasons)
        elif age_ns > LATE_PERIODS * descriptor.period_ns() and level == "OK":
            level, reasons = "WARN", ("late",)
        statistics = supervisor.driver.statistics
        return StreamHealth(
            stream=descriptor.name,
            device=supervisor.driver.name,
            level=level,
            reasons=reasons,
            rate_hz=state.rate_hz,
            nominal_rate_hz=descriptor.nominal_rate_hz,
            age_s=None if age_ns is None else age_ns / 1e9,
            received=statistics.packets,
            lost=statistics.lost,
        )


def judge_window(
    first: _Snapshot, last: _Snapshot, *, rate_hz: float, descriptor: StreamDescriptor
) -> list[tuple[Judgement, str]]:
    """What two snapshots of a stream say about the time between them."""
    findings: list[tuple[Judgement, str]] = []
    off = abs(rate_hz / descriptor.nominal_rate_hz - 1.0)
    if off > RATE_LIMITS[0]:
        text = f"{rate_hz:.1f} Hz, expected {descriptor.nominal_rate_hz:g} Hz"
        findings.append(_finding(off, RATE_LIMITS, text))
    lost, packets = last.lost - first.lost, last.packets - first.packets
    ratio = lost / max(1, lost + packets)
    if ratio > DROP_LIMITS[0]:
        findings.append(_finding(ratio, DROP_LIMITS, f"{ratio:.1%} of packets lost"))
    damaged = last.damaged - first.damaged
    ratio = damaged / max(1, damaged + packets)
    if ratio > DROP_LIMITS[0]:
        findings.append(_finding(ratio, DROP_LIMITS, f"{damaged} packets damaged"))
    if last.reconnects > first.reconnects:
        findings.append(("WARN", f"{last.reconnects - first.reconnects} reconnects"))
    return findings


def device_health(supervisor: DeviceSupervisor) -> DeviceHealth:
    """A device's counters."""
    statistics, counters = supervisor.driver.statistics, supervisor.counters
    return DeviceHealth(
        device=supervisor.driver.name,
        connected=counters.is_connected,
        address=str(supervisor.driver.info),
        packets=statistics.packets,
        lost=statistics.lost,
        crc_errors=statistics.crc_errors,
        length_errors=statistics.length_errors,
        resync_bytes=statistics.resync_bytes,
        refused=statistics.refused,
        reconnects=counters.reconnects,
        last_error=counters.last_error,
    )


def _finding(value: float, limits: tuple[float, float], text: str) -> tuple[Judgement, str]:
    return ("ERROR" if value >= limits[1] else "WARN"), text
