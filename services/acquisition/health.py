"""Health monitor of a station, which evaluates all of its streams once a second."""

import threading
from collections.abc import Callable, Mapping, Sequence
from contextlib import closing
from dataclasses import dataclass, field
from pathlib import Path
from typing import Protocol, runtime_checkable

from dextouch.streams import StreamDescriptor
from services.acquisition.clock import StationClock, Waiter
from services.acquisition.drivers.base import Driver
from services.acquisition.health_blocks import Block
from services.acquisition.health_camera import CameraJudge
from services.acquisition.health_cells import CellJudge, cells_of
from services.acquisition.health_clock import ClockJudge, CountingJudge
from services.acquisition.health_events import EventLog
from services.acquisition.health_levels import Board, Verdict, worst
from services.acquisition.health_link import LinkJudge
from services.acquisition.health_path import PathJudge
from services.acquisition.health_report import device_health, stale_code, stream_health
from services.acquisition.health_station import CalibrationJudge, DiskJudge, UploadJudge
from services.acquisition.health_taxels import TaxelJudge
from services.acquisition.health_tracking import (
    FiniteJudge,
    PoseJudge,
    TellsTracking,
    TrackingJudge,
)
from services.acquisition.live import LiveView
from services.acquisition.path_latency import PathWatch
from services.acquisition.schemas import (
    HealthEvent,
    HealthEvents,
    StaleCode,
    StationHealth,
    StreamHealth,
)
from services.acquisition.supervisor import DeviceSupervisor

TICK_NS = 100_000_000
PERIOD_NS = 1_000_000_000
CONFIRM_NS = 200_000_000
# A device may take this long after the start before its silence is an event.
START_NS = 1_000_000_000
STATION = "station"


@runtime_checkable
class Judge(Protocol):
    """Check of one aspect of one stream, run at every evaluation."""

    def judge(self, block: Block, now_ns: int) -> Verdict:
        """Evaluate the samples since the last evaluation."""
        ...


@dataclass
class _Watched:
    """One stream with its checks and their latest results."""

    supervisor: DeviceSupervisor
    descriptor: StreamDescriptor
    judges: list[Judge]
    board: Board = field(default_factory=Board)
    figures: dict[str, float] = field(default_factory=dict)
    evaluated_ns: int = 0
    is_suspicious: bool = False
    stale: StaleCode | None = None


class HealthMonitor:
    """Evaluates all streams once a second, in its own thread; readers never wait for it.

    New findings are evaluated again after 0.2 s, so that a fault is confirmed quickly. Silent
    streams are detected every 0.1 s for the event log, and immediately in every report.
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
        self._log = EventLog()
        self._streams = [watched for s in self._supervisors for watched in watch(s, live)]
        self._board = Board()
        self._figures: dict[str, float] = {}
        self._station_evaluated_ns = 0
        self._disk: DiskJudge | None = None
        self._uploads: UploadJudge | None = None
        self._calibration = CalibrationJudge(
            [watched.descriptor for watched in self._streams], live.calibration
        )
        live.blocks.time_by(clock)
        self._started_ns = clock.now_ns()
        self._due_ns = self._started_ns + PERIOD_NS
        # One evaluates at a time; the other lock guards what a report reads.
        self._evaluating = threading.Lock()
        self._lock = threading.Lock()
        self._waiter: Waiter | None = None
        self._thread = threading.Thread(target=self._run, name="health", daemon=True)

    def watch_disk(self, spool_root: Path) -> None:
        """Start monitoring the free space on the disk of the takes."""
        self._disk = DiskJudge(spool_root, self._supervisors)
        # The first look begins the measurement of what arrives.
        self._disk.judge(self._clock.now_ns())

    def watch_uploads(self, refused: Callable[[], Mapping[str, str]]) -> None:
        """Start monitoring which takes the store refused, and why."""
        self._uploads = UploadJudge(refused)

    def watch_paths(self, paths: PathWatch) -> None:
        """Start comparing measured path delays with the calibration."""
        for watched in self._streams:
            name = watched.descriptor.name
            if paths.num_failures(name) is not None:
                watched.judges.append(PathJudge(name, paths, self._live.calibration))

    def start(self) -> None:
        """Start evaluating."""
        self._waiter = self._clock.waiter()
        self._started_ns = self._clock.now_ns()
        self._due_ns = self._started_ns + PERIOD_NS
        self._thread.start()

    def stop(self) -> None:
        """End the thread."""
        if self._waiter is not None:
            self._waiter.cancel()
            self._thread.join()

    def evaluate(self) -> None:
        """One regular evaluation now."""
        now_ns = self._clock.now_ns()
        with self._evaluating:
            for watched in self._streams:
                self._evaluate(watched, now_ns, confirming=False)
            self._evaluate_station(now_ns, confirming=False)

    def tick(self) -> None:
        """Run what is due: silence detection, confirmations, regular evaluations."""
        now_ns = self._clock.now_ns()
        self._notice_silence(now_ns)
        if now_ns >= self._due_ns:
            # After a long stop of the process one evaluation is enough.
            self._due_ns = now_ns + PERIOD_NS
            self.evaluate()
            return
        with self._evaluating:
            for watched in self._streams:
                waits = watched.board.is_rising or watched.is_suspicious
                if waits and now_ns >= watched.evaluated_ns + CONFIRM_NS:
                    self._evaluate(watched, now_ns, confirming=True)
            if self._board.is_rising and now_ns >= self._station_evaluated_ns + CONFIRM_NS:
                self._evaluate_station(now_ns, confirming=True)

    def report(self) -> StationHealth:
        """Current health of every stream and device."""
        now_ns = self._clock.now_ns()
        with self._lock:
            streams = tuple(self._stream_health(watched, now_ns) for watched in self._streams)
            findings, figures = self._board.active(now_ns), dict(self._figures)
        levels = [stream.level for stream in streams] + [finding.level for finding in findings]
        return StationHealth(
            station=self._station,
            level=worst(levels, default="STALE"),
            findings=findings,
            figures=figures,
            streams=streams,
            devices=tuple(device_health(s) for s in self._supervisors),
        )

    def events(self, since_ns: int = 0) -> HealthEvents:
        """Changes of levels from a moment on the station's clock, oldest first."""
        found: tuple[HealthEvent, ...] = self._log.events(since_ns)
        return HealthEvents(now_ns=self._clock.now_ns(), events=found)

    def raised(self) -> dict[tuple[str, str], int]:
        """How often each (stream, code) was raised since the station's start."""
        return self._log.raised()

    @property
    def num_unjudged(self) -> int:
        """Number of samples that were not evaluated because the evaluation did not keep up."""
        return self._live.blocks.dropped

    def _run(self) -> None:
        if self._waiter is None:
            return
        with closing(self._waiter) as waiter:
            while waiter.wait_until(self._clock.now_ns() + TICK_NS):
                self.tick()

    def _evaluate(self, watched: _Watched, now_ns: int, *, confirming: bool) -> None:
        block = self._live.blocks.take(watched.descriptor.name)
        verdicts = [judge.judge(block, now_ns) for judge in watched.judges]
        findings = [finding for verdict in verdicts for finding in verdict.findings]
        with self._lock:
            changes = watched.board.update(findings, now_ns, confirming=confirming)
            watched.figures = {k: v for verdict in verdicts for k, v in verdict.figures.items()}
            watched.is_suspicious = any(verdict.suspicious for verdict in verdicts)
            watched.evaluated_ns = now_ns
        for code, level in changes:
            self._log.add(now_ns, watched.descriptor.name, code, level)

    def _evaluate_station(self, now_ns: int, *, confirming: bool) -> None:
        verdicts = [self._calibration.judge(now_ns)]
        verdicts += [judge.judge(now_ns) for judge in (self._disk, self._uploads) if judge]
        findings = [finding for verdict in verdicts for finding in verdict.findings]
        with self._lock:
            changes = self._board.update(findings, now_ns, confirming=confirming)
            self._station_evaluated_ns = now_ns
            self._figures = {k: v for verdict in verdicts for k, v in verdict.figures.items()}
            self._figures["unjudged_samples"] = float(self.num_unjudged)
        for code, level in changes:
            self._log.add(now_ns, STATION, code, level)

    def _notice_silence(self, now_ns: int) -> None:
        for watched in self._streams:
            name, stale = watched.descriptor.name, watched.stale
            code = stale_code(watched.supervisor, watched.descriptor, now_ns)
            never = watched.supervisor.counters.streams[name].last_t_host_ns is None
            if code == stale or (never and now_ns < self._started_ns + START_NS):
                continue
            if stale is not None:
                self._log.add(now_ns, name, stale, "OK")
            if code is not None:
                self._log.add(now_ns, name, code, "STALE")
            watched.stale = code

    def _stream_health(self, watched: _Watched, now_ns: int) -> StreamHealth:
        return stream_health(
            watched.supervisor,
            watched.descriptor,
            now_ns,
            findings=watched.board.active(now_ns),
            figures=watched.figures,
        )


class _SameAs:
    """Latest verdict of another stream's check, for streams that share their timestamps."""

    def __init__(self, first: "_Remembering") -> None:
        self._first = first

    def judge(self, block: Block, now_ns: int) -> Verdict:
        del block, now_ns
        return self._first.verdict


class _Remembering:
    def __init__(self, judge: Judge) -> None:
        self._judge = judge
        self.verdict = Verdict()

    def judge(self, block: Block, now_ns: int) -> Verdict:
        self.verdict = self._judge.judge(block, now_ns)
        return self.verdict


def watch(supervisor: DeviceSupervisor, live: LiveView) -> list[_Watched]:
    """The streams of one device, each with the checks for its kind."""
    watched = []
    clock: _Remembering | None = None
    driver = supervisor.driver
    for descriptor in driver.descriptors:
        judges: list[Judge] = [LinkJudge(supervisor, descriptor)]
        if descriptor.capabilities.device_time and clock is None:
            clock = _Remembering(ClockJudge(descriptor))
            judges.append(clock)
        elif descriptor.capabilities.device_time and clock is not None:
            judges.append(_SameAs(clock))
        elif not descriptor.capabilities.sequence:
            judges.append(CountingJudge(descriptor))
        judges += _value_judges(driver, descriptor, live)
        if isinstance(driver.decoder, TellsTracking):
            judges.append(TrackingJudge(driver))
        watched.append(_Watched(supervisor, descriptor, judges))
    return watched


def _value_judges(driver: Driver, descriptor: StreamDescriptor, live: LiveView) -> list[Judge]:
    """Checks of sample values, by the kind of the stream."""
    if descriptor.kind == "tactile":
        glove = live.glove(descriptor.name)
        cells = cells_of(driver.decoder, live.calibration)
        judges: list[Judge] = [FiniteJudge("nan", "taxels are no numbers")]
        if glove is not None:
            judges.append(TaxelJudge(descriptor, glove))
        elif cells is not None:
            judges.append(CellJudge(cells))
        return judges
    if descriptor.kind == "keypoints":
        return [FiniteJudge("tracking", "nodes are not seen")]
    if descriptor.kind == "pose":
        return [PoseJudge(descriptor)]
    return [CameraJudge(driver)] if descriptor.kind == "image" else []
