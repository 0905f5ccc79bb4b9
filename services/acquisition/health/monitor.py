"""Health monitor of a station, which evaluates all of its streams once a second."""

import threading
from collections.abc import Callable, Mapping, Sequence
from contextlib import closing
from functools import partial

from dextouch.schemas import HealthEvents, Matrix, StationHealth
from dextouch.streams import StreamDescriptor
from services.acquisition.clock import StationClock, Waiter
from services.acquisition.drivers.base import Driver
from services.acquisition.glove_record import glove_record, is_ours
from services.acquisition.health.cells import TaxelJudge, cell_judge
from services.acquisition.health.clock import ClockJudge, CountingJudge
from services.acquisition.health.levels import EventLog, Judge, Verdict, worst
from services.acquisition.health.link import LinkJudge, TrackingJudge
from services.acquisition.health.samples import Block, deliver
from services.acquisition.health.station import CalibrationJudge, PathJudge, judge_uploads
from services.acquisition.health.values import CameraJudge, FiniteJudge, PoseJudge
from services.acquisition.health.watched import Watched, WatchedStream, device_health
from services.acquisition.path_latency import PathWatch
from services.acquisition.supervisor import DeviceSupervisor

TICK_NS = 100_000_000
PERIOD_NS = 1_000_000_000
CONFIRM_NS = 200_000_000
# A device may take this long after the start before its silence is an event.
START_NS = 1_000_000_000
STATION = "station"


class HealthMonitor:
    """Evaluates all streams once a second, in its own thread; readers never wait for it.

    New findings are evaluated again after 0.2 s, so that a fault is confirmed quickly. Silent
    streams are detected every 0.1 s for the event log, and immediately in every report.

    Args:
        supervisors: of the station's devices.
        station: its name.
        calibration: of the station.
        clock: of the station.
        paths: measured path delays, which are compared with the calibration.
    """

    def __init__(
        self,
        supervisors: Sequence[DeviceSupervisor],
        *,
        station: str,
        calibration: Mapping[str, Matrix],
        clock: StationClock,
        paths: PathWatch | None = None,
    ) -> None:
        self._station = station
        self._supervisors = list(supervisors)
        self._clock = clock
        self._log = EventLog()
        streams = [watched for s in supervisors for watched in _watch(s, calibration, paths)]
        self._streams = {watched.name: watched for watched in streams}
        # Called by the reader threads with what they have spooled.
        self.accept = partial(deliver, {watched.name: watched.queue for watched in streams}, clock)
        descriptors = [watched.descriptor for watched in streams]
        calibrated = CalibrationJudge(descriptors, calibration)
        self._itself = Watched(STATION, [calibrated.judge, self._judge_itself])
        self._started_ns = clock.now_ns()
        self._due_ns = self._started_ns + PERIOD_NS
        # One evaluates at a time; the other lock guards what a report reads.
        self._evaluating = threading.Lock()
        self._lock = threading.Lock()
        self._waiter: Waiter | None = None
        self._thread = threading.Thread(target=self._run, name="health", daemon=True)

    def watch(self, judge: Judge) -> None:
        """Add a check of the station itself, such as that of its disk."""
        self._itself.judges.append(judge)

    def watch_uploads(self, refused: Callable[[], Mapping[str, str]]) -> None:
        """Start monitoring which takes the store refused, and why."""
        self.watch(lambda _block, _now_ns: judge_uploads(refused()))

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
            for watched in (*self._streams.values(), self._itself):
                self._evaluate(watched, now_ns, confirming=False)

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
            for watched in (*self._streams.values(), self._itself):
                waits = watched.board.is_rising or watched.is_suspicious
                if waits and now_ns >= watched.evaluated_ns + CONFIRM_NS:
                    self._evaluate(watched, now_ns, confirming=True)

    def report(self) -> StationHealth:
        """Current health of every stream and device."""
        now_ns = self._clock.now_ns()
        with self._lock:
            streams = tuple(watched.health(now_ns) for watched in self._streams.values())
            findings, figures = self._itself.board.active(now_ns), self._itself.figures
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
        return HealthEvents(now_ns=self._clock.now_ns(), events=self._log.events(since_ns))

    def raised(self) -> dict[tuple[str, str], int]:
        """How often each (stream, code) was raised since the station's start."""
        return self._log.raised()

    @property
    def num_unjudged(self) -> int:
        """Number of samples that were not evaluated because the evaluation did not keep up."""
        return sum(watched.queue.num_dropped for watched in self._streams.values())

    def _judge_itself(self, block: Block, now_ns: int) -> Verdict:
        del block, now_ns
        return Verdict((), {"unjudged_samples": float(self.num_unjudged)})

    def _run(self) -> None:
        if self._waiter is None:
            return
        with closing(self._waiter) as waiter:
            while waiter.wait_until(self._clock.now_ns() + TICK_NS):
                self.tick()

    def _evaluate(self, watched: Watched, now_ns: int, *, confirming: bool) -> None:
        verdicts = watched.verdicts(now_ns)
        findings = [finding for verdict in verdicts for finding in verdict.findings]
        with self._lock:
            changes = watched.board.update(findings, now_ns, confirming=confirming)
            watched.figures = {k: v for verdict in verdicts for k, v in verdict.figures.items()}
            watched.is_suspicious = any(verdict.suspicious for verdict in verdicts)
            watched.evaluated_ns = now_ns
        for code, level in changes:
            self._log.add(now_ns, watched.name, code, level)

    def _notice_silence(self, now_ns: int) -> None:
        for name, watched in self._streams.items():
            stale, code = watched.stale, watched.stale_code(now_ns)
            never = watched.counters.last_t_host_ns is None
            if code == stale or (never and now_ns < self._started_ns + START_NS):
                continue
            if stale is not None:
                self._log.add(now_ns, name, stale, "OK")
            if code is not None:
                self._log.add(now_ns, name, code, "STALE")
            watched.stale = code


def _watch(
    supervisor: DeviceSupervisor, calibration: Mapping[str, Matrix], paths: PathWatch | None
) -> list[WatchedStream]:
    """The streams of one device, each with the checks for its kind."""
    watched = []
    clock: ClockJudge | None = None
    driver = supervisor.driver
    for descriptor in driver.descriptors:
        judges: list[Judge] = [LinkJudge(supervisor, descriptor).judge]
        if descriptor.capabilities.device_time and clock is None:
            clock = ClockJudge(descriptor)
            judges.append(clock.judge)
        elif descriptor.capabilities.device_time and clock is not None:
            # All streams of a device share their timestamps: the first one's verdict is theirs.
            judges.append(clock.repeat)
        elif not descriptor.capabilities.sequence:
            judges.append(CountingJudge(descriptor).judge)
        judges += _value_judges(driver, descriptor, calibration)
        if "occluded" in driver.events():
            judges.append(TrackingJudge(supervisor.events).judge)
        if paths is not None and paths.num_failures(descriptor.name) is not None:
            judges.append(PathJudge(descriptor.name, paths, calibration).judge)
        watched.append(WatchedStream(supervisor, descriptor, judges))
    return watched


def _value_judges(
    driver: Driver, descriptor: StreamDescriptor, calibration: Mapping[str, Matrix]
) -> list[Judge]:
    """Checks of sample values, by the kind of the stream."""
    if descriptor.kind == "tactile":
        record = glove_record(descriptor, calibration) if is_ours(descriptor) else None
        cells = TaxelJudge(record) if record else cell_judge(driver.decoder, calibration)
        nan = FiniteJudge("nan", "taxels are no numbers")
        return [nan.judge] if cells is None else [nan.judge, cells.judge]
    if descriptor.kind == "keypoints":
        return [FiniteJudge("tracking", "nodes are not seen").judge]
    if descriptor.kind == "pose":
        return [PoseJudge(descriptor).judge]
    return [CameraJudge(driver).judge] if descriptor.kind == "image" else []
