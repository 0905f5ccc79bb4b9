"""Health monitor of a station, which evaluates all of its streams once a second."""

import threading
import time
from collections.abc import Mapping, Sequence

from dextouch import schemas
from dextouch.streams import BODIES, StreamDescriptor
from services.acquisition.clock import PeriodicCall, StationClock
from services.acquisition.drivers.base import Driver
from services.acquisition.health.causes import SIMULATED_ADVICE, find_causes
from services.acquisition.health.cells import TaxelCheck, cell_judge
from services.acquisition.health.clock import ClockCheck, CountingCheck
from services.acquisition.health.codes import CODES, SEVERITY
from services.acquisition.health.evaluation import (
    Block,
    Board,
    Evaluation,
    EventLog,
    HealthCheck,
    raised_finding,
    worst,
)
from services.acquisition.health.glove_records import glove_record, is_ours, refused_taxels
from services.acquisition.health.history import STATION_FIGURES, HealthHistory, StreamMeter
from services.acquisition.health.station import (
    CalibrationCheck,
    HostCheck,
    HostClockCheck,
    PathCheck,
    tared_unix_s,
)
from services.acquisition.health.streams import (
    BodiesCheck,
    CameraCheck,
    FiniteCheck,
    HandsCheck,
    LinkCheck,
    PlausibilityCheck,
    PoseCheck,
    SampleQueue,
    TrackingCheck,
)
from services.acquisition.supervisor import DeviceSupervisor
from services.acquisition.watches import FollowWatch, PathWatch

TICK_NS = 100_000_000
PERIOD_NS = 1_000_000_000
# Without a tick for so long the monitor counts as stalled.
STALL_NS = 10_000_000_000
CONFIRM_NS = 200_000_000
# A device may take this long after the start before its silence is an event.
START_NS = 1_000_000_000
STALE_AFTER_NS = {"image": 500_000_000}
STALE_AFTER_OTHERS_NS = 200_000_000
LATE_PERIODS = round(CODES["late"].warn)
STATION = "station"


def longest_gap_ns(descriptor: StreamDescriptor) -> int:
    """How long a stream may give nothing: a slow one for 3 of its periods at least."""
    limit_ns = STALE_AFTER_NS.get(descriptor.kind, STALE_AFTER_OTHERS_NS)
    return max(limit_ns, LATE_PERIODS * descriptor.period_ns())


class _Watched:
    """The station or one of its streams, with its checks and their latest results."""

    def __init__(self, name: str, judges: list[HealthCheck]) -> None:
        self.name = name
        self.judges = judges
        self.board = Board()
        self.latest = Evaluation(0)

    def evaluate(self, now_ns: int) -> Evaluation:
        evaluation = Evaluation(now_ns, self.take())
        for judge in self.judges:
            judge(evaluation)
        return evaluation

    def take(self) -> Block:
        """Samples since the last evaluation; none of the station itself."""
        return Evaluation(0).block


class _WatchedStream(_Watched):
    """One stream of a device, and its samples that wait for the next evaluation.

    A silent stream is detected for every report; it has no figures.
    """

    def __init__(
        self, supervisor: DeviceSupervisor, descriptor: StreamDescriptor, judges: list[HealthCheck]
    ) -> None:
        super().__init__(descriptor.name, judges)
        self._supervisor = supervisor
        self._descriptor = descriptor
        self.counters = supervisor.streams[descriptor.name]
        self.queue = SampleQueue(descriptor)
        self.meter = StreamMeter(
            lambda: supervisor.driver.statistics, descriptor, self.queue.capacity
        )
        self.tared_unix_s: float | None = None
        # As the event log knows it.
        self.stale: schemas.StaleCode | None = None

    def take(self) -> Block:
        block = self.queue.take()
        self.meter.add(block)
        return block

    def stale_code(self, now_ns: int) -> schemas.StaleCode | None:
        """Why the stream is stale, None when it is not.

        "unplugged" when the device is not open, "silent" when it is and nothing comes.
        """
        if not self._supervisor.connected.is_set():
            return "unplugged"
        limit_ns, last_ns = longest_gap_ns(self._descriptor), self.counters.last_t_host_ns
        return "silent" if last_ns is None or now_ns - last_ns > limit_ns else None

    def health(self, now_ns: int) -> schemas.StreamHealth:
        descriptor, driver = self._descriptor, self._supervisor.driver
        findings, figures = self.board.active(now_ns), self.latest.figures
        last_ns, stale = self.counters.last_t_host_ns, self.stale_code(now_ns)
        age_ns = None if last_ns is None else max(0, now_ns - last_ns)
        if stale is not None:
            text = self._stale_words(stale, age_ns)
            is_stale = raised_finding(stale, "STALE", text, lasted_ns=age_ns)
            findings, figures = (is_stale, *findings), {}
        elif not findings and age_ns is not None and age_ns > LATE_PERIODS * descriptor.period_ns():
            findings = (raised_finding("late", "WARN", "late", lasted_ns=age_ns),)
        skew = figures.get("clock_skew_ratio")
        residual_s = figures.get("clock_residual_p95_seconds")
        return schemas.StreamHealth(
            stream=self.name,
            device=driver.name,
            hand=descriptor.side,
            level=worst([finding.level for finding in findings]),
            stale=stale,
            reasons=tuple(finding.message for finding in findings),
            findings=findings,
            figures=figures,
            rate_hz=figures.get("rate_hz"),
            nominal_rate_hz=descriptor.nominal_rate_hz,
            age_s=None if age_ns is None else age_ns / 1e9,
            num_samples=self.counters.num_samples,
            received=driver.statistics.packets,
            lost=driver.statistics.lost,
            skew_ppm=None if skew is None else skew * 1e6,
            clock_residual_ms=None if residual_s is None else residual_s * 1e3,
            taxels={} if stale else self.latest.taxels,
            tare_age_s=None if self.tared_unix_s is None else time.time() - self.tared_unix_s,
            layout=descriptor.layout,
        )

    def _stale_words(self, stale: schemas.StaleCode, age_ns: int | None) -> str:
        if self._supervisor.last_error is not None:
            return self._supervisor.last_error
        if stale == "unplugged":
            return "not connected"
        return "no data yet" if age_ns is None else f"no data for {age_ns * 1e-9:.1f} s"


class HealthMonitor:
    """Evaluates all streams once a second, in its own thread; readers never wait for it.

    New findings are evaluated again after 0.2 s, so that a fault is confirmed quickly. Silent
    streams are detected every 0.1 s for the event log, and immediately in every report.

    `simulated` devices are mocks, of which nothing can be plugged or replaced. `queues` are filled
    by the reader threads with what they have spooled; `history` has a row of each regular
    evaluation.
    """

    def __init__(  # noqa: PLR0913 - all but the first by name
        self,
        supervisors: Sequence[DeviceSupervisor],
        *,
        station: str,
        calibration: Mapping[str, schemas.Matrix],
        clock: StationClock,
        paths: PathWatch | None = None,
        follow: FollowWatch | None = None,
        simulated: bool = False,
    ) -> None:
        self._station = station
        self._simulated = simulated
        self._follow = follow
        self._supervisors = list(supervisors)
        self._clock = clock
        self._log = EventLog()
        descriptors = [descriptor for s in supervisors for descriptor in s.driver.descriptors]
        # Heads and wrists of robots may be anywhere.
        of_robot = any(descriptor.kind == "robot_state" for descriptor in descriptors)
        person = None if of_robot else (BodiesCheck(calibration), HandsCheck(calibration))
        streams = [stream for s in supervisors for stream in _watch(s, calibration, paths, person)]
        self._streams = {stream.name: stream for stream in streams}
        self.queues = {stream.name: stream.queue for stream in streams}
        self.nominal_rates_hz = {d.name: d.nominal_rate_hz for d in descriptors}
        self.history = HealthHistory(list(self._streams))
        host = HostCheck()
        itself = (CalibrationCheck(descriptors, calibration), host, HostClockCheck(clock))
        self._itself = _Watched(STATION, [*itself, self._judge_itself])
        self._all = [*streams, self._itself]
        self._started_ns = clock.now_ns()
        self._due_ns = self._started_ns + PERIOD_NS
        # One evaluates at a time; the other lock guards what a report reads.
        self._ticked_ns = 0
        self._evaluating = threading.Lock()
        self._lock = threading.Lock()
        self._ticks = PeriodicCall(
            self.tick, period_ns=TICK_NS, clock=clock, name="health", on_wake=host.note
        )

    def watch(self, judge: HealthCheck) -> None:
        """Add a check of the station itself, such as that of its disk."""
        self._itself.judges.append(judge)

    def start(self) -> None:
        """Start evaluating."""
        self._started_ns = self._ticked_ns = self._clock.now_ns()
        self._due_ns = self._started_ns + PERIOD_NS
        self._ticks.start()

    @property
    def is_running(self) -> bool:
        """Whether the evaluation is called, many times more often than this asks for."""
        return self._clock.now_ns() - self._ticked_ns < STALL_NS

    def stop(self) -> None:
        """End the thread."""
        self._ticks.stop()

    def evaluate(self) -> None:
        """One regular evaluation now."""
        now_ns = self._clock.now_ns()
        with self._evaluating:
            for watched in self._all:
                self._evaluate(watched, now_ns, confirming=False)
            self._remember(now_ns)

    def tick(self) -> None:
        """Run what is due: silence detection, confirmations, regular evaluations."""
        now_ns = self._ticked_ns = self._clock.now_ns()
        self._notice_silence(now_ns)
        if now_ns >= self._due_ns:
            # After a long stop of the process one evaluation is enough.
            self._due_ns = now_ns + PERIOD_NS
            self.evaluate()
            return
        with self._evaluating:
            for watched in self._all:
                waits = watched.board.is_rising or watched.latest.suspicious
                if waits and now_ns >= watched.latest.now_ns + CONFIRM_NS:
                    self._evaluate(watched, now_ns, confirming=True)

    def report(self) -> schemas.StationHealth:
        """Current health of every stream and device."""
        now_ns = self._clock.now_ns()
        with self._lock:
            streams = tuple(self._health(stream, now_ns) for stream in self._streams.values())
            findings, figures = self._itself.board.active(now_ns), self._itself.latest.figures
        levels = [stream.level for stream in streams] + [finding.level for finding in findings]
        devices = tuple(_device_health(s, simulated=self._simulated) for s in self._supervisors)
        return schemas.StationHealth(
            station=self._station,
            level=worst(levels, default="STALE"),
            causes=find_causes(streams, devices, findings, figures.get("host_cpu_10s_ratio", 0.0)),
            findings=findings,
            figures=figures,
            streams=streams,
            devices=devices,
        )

    def _health(self, stream: _WatchedStream, now_ns: int) -> schemas.StreamHealth:
        """A stream at this moment, without advice about plugs and cables that a mock has not."""
        health = stream.health(now_ns)
        if self._follow is not None and (following := self._follow.live(stream.name, now_ns)):
            health = health.model_copy(update={"following": following})
        if not self._simulated:
            return health
        findings = [f.model_copy(update={"advice": SIMULATED_ADVICE}) for f in health.findings]
        return health.model_copy(update={"findings": tuple(findings)})

    def events(self, since_ns: int = 0) -> schemas.HealthEvents:
        """Changes of levels from a moment on the station's clock, oldest first."""
        return schemas.HealthEvents(now_ns=self._clock.now_ns(), events=self._log.events(since_ns))

    def raised(self) -> dict[tuple[str, str], int]:
        """How often each (stream, code) was raised since the station's start."""
        return self._log.raised()

    def _judge_itself(self, evaluation: Evaluation) -> None:
        """How many samples were not evaluated because the evaluation did not keep up."""
        num_unjudged = sum(stream.queue.num_dropped for stream in self._streams.values())
        evaluation.figures["unjudged_samples"] = float(num_unjudged)

    def _evaluate(self, watched: _Watched, now_ns: int, *, confirming: bool) -> None:
        evaluation = watched.evaluate(now_ns)
        with self._lock:
            changes = watched.board.update(evaluation.findings, now_ns, confirming=confirming)
            watched.latest = evaluation
        for code, level in changes:
            self._log.add(now_ns, watched.name, code, level)

    def _remember(self, now_ns: int) -> None:
        figures = self._itself.latest.figures
        station = {name: figures[key] for name, key in STATION_FIGURES.items() if key in figures}
        streams: dict[str, dict[str, float]] = {}
        levels: list[schemas.HealthLevel] = [f.level for f in self._itself.board.active(now_ns)]
        for name, stream in self._streams.items():
            level = stream.health(now_ns).level
            levels.append(level)
            figures = stream.latest.figures
            streams[name] = stream.meter.row(now_ns, SEVERITY.index(level), figures)
        station["level"] = float(SEVERITY.index(worst(levels)))
        self.history.add(now_ns, station, streams)

    def _notice_silence(self, now_ns: int) -> None:
        for name, stream in self._streams.items():
            stale, code = stream.stale, stream.stale_code(now_ns)
            never = stream.counters.last_t_host_ns is None
            if code == stale or (never and now_ns < self._started_ns + START_NS):
                continue
            if stale is not None:
                self._log.add(now_ns, name, stale, "OK")
            if code is not None:
                self._log.add(now_ns, name, code, "STALE")
            stream.stale = code


def _watch(
    supervisor: DeviceSupervisor,
    calibration: Mapping[str, schemas.Matrix],
    paths: PathWatch | None,
    person: tuple[BodiesCheck, HandsCheck] | None,
) -> list[_WatchedStream]:
    """The streams of one device, each with the checks for its kind."""
    watched = []
    clock: ClockCheck | None = None
    driver = supervisor.driver
    for descriptor in driver.descriptors:
        judges: list[HealthCheck] = [LinkCheck(supervisor, descriptor)]
        if descriptor.capabilities.device_time and clock is None:
            clock = ClockCheck(descriptor)
            judges.append(clock)
        elif descriptor.capabilities.device_time and clock is not None:
            # All streams of a device share their timestamps: the first one's result is theirs.
            judges.append(clock.repeat)
        elif not descriptor.capabilities.sequence:
            judges.append(CountingCheck(descriptor))
        judges += _value_judges(driver, descriptor, calibration)
        if descriptor.kind == "image":
            bodies = None if person is None else person[0]
            judges.append(CameraCheck(driver, descriptor.name, bodies))
        if person is not None and descriptor.name in BODIES:
            judges.append(person[0].of(descriptor.name))
        if person is not None and descriptor.name.startswith(("keypoints", "tactile", "wrist")):
            judges.append(person[1].of(descriptor))
        if "occluded" in driver.events():
            judges.append(TrackingCheck(supervisor.events))
        if paths is not None and paths.num_failures(descriptor.name) is not None:
            judges.append(PathCheck(descriptor.name, paths, calibration))
        stream = _WatchedStream(supervisor, descriptor, judges)
        stream.tared_unix_s = tared_unix_s(descriptor, calibration)
        watched.append(stream)
    return watched


def _value_judges(
    driver: Driver, descriptor: StreamDescriptor, calibration: Mapping[str, schemas.Matrix]
) -> list[HealthCheck]:
    """Checks of sample values, by the kind of the stream."""
    if descriptor.kind == "tactile":
        record = glove_record(descriptor, calibration) if is_ours(descriptor) else None
        cells = (
            TaxelCheck(
                record,
                refused_taxels(descriptor, calibration, record),
                descriptor.tactile_layout,
            )
            if record
            else cell_judge(driver.decoder, calibration)
        )
        nan = FiniteCheck("nan", "taxels are no numbers")
        return [nan] if cells is None else [nan, cells]
    if descriptor.kind == "keypoints":
        return [FiniteCheck("tracking", "nodes are not seen"), PlausibilityCheck(descriptor)]
    if descriptor.kind == "pose":
        of_robot = any(other.kind == "robot_state" for other in driver.descriptors)
        return [PoseCheck(descriptor), PlausibilityCheck(descriptor, of_robot=of_robot)]
    if descriptor.kind == "robot_state":
        return [PlausibilityCheck(descriptor)]
    return []


def _device_health(supervisor: DeviceSupervisor, *, simulated: bool) -> schemas.DeviceHealth:
    """A device's counters, and what it shares with others."""
    driver, events = supervisor.driver, supervisor.events()
    sides = {descriptor.side for descriptor in driver.descriptors}
    return schemas.DeviceHealth.model_validate(
        {
            **{name: events[name] for name in schemas.DeviceHealth.model_fields if name in events},
            "device": driver.name,
            "hand": sides.pop() if len(sides) == 1 else None,
            "simulated": simulated,
            "shares": supervisor.shares,
            "connected": supervisor.connected.is_set(),
            "address": str(driver.info),
            "queue_dropped": events.get("queue", 0),
            "reconnects": supervisor.reconnects,
            "failures": events["driver_failure"],
            "last_error": supervisor.last_error,
        }
    )
