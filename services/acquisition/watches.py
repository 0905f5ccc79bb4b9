"""Watches beside a station's readers: of path delays, and of what the robot's hand can follow.

Exchanges with a device that answers time requests measure the offset of its clock, which one-way
timestamps cannot. The difference to the estimated sample times is the path delay.

The check of what the robot's hand can do is given to the station (`services.pipelines.station`).
It runs in a thread of its own on the newest sample of each hand; a slow check skips samples.
"""

import math
from collections import Counter, deque
from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Final, Protocol, runtime_checkable

import numpy as np
import structlog

from dextouch.clocks import KnownSkew, OnlineClock, PathLatency, RoundTrip, RoundTripClock
from dextouch.errors import DeviceError, DexTouchError, InvalidInputError, PacketError
from dextouch.schemas import FollowCause, Matrix, RobotFollowing
from dextouch.streams import Sample, StreamDescriptor
from dextouch.tactile.layout import Side
from services.acquisition.clock import PeriodicCall, StationClock, VirtualClock
from services.acquisition.drivers.base import Readings
from services.acquisition.supervisor import DeviceSupervisor

logger = structlog.get_logger(__name__)

PERIOD_NS = 1_000_000_000
MAX_BACK_OFF = 5
# Samples kept between two looks, some seconds of the fastest glove; what falls out is not needed.
KEPT_SAMPLES = 2048
# After a step of the device's clock, no latency is reported before so many samples.
MIN_EXCHANGES = 5
MIN_SAMPLES = 120
WINDOW_S = 60.0
# The lower edge of n samples is known to about twice their mean wait over the root of n.
EDGE_SPREADS = 2.0
# No sample arrives before it was taken: a delay so many sigmas below nothing is a wrong one.
IMPOSSIBLE_SIGMAS = 3.0
# Chosen: 30 Hz, the rate of a slow tracker, and ten checks before a cause has lasted 0.3 s.
FOLLOW_PERIOD_NS: Final = 33_333_333
# A cause is shown for so long after it was last found: pages ask several times a second, and one
# that comes and goes within less than a reaction time is one to the operator.
HOLD_NS: Final = 300_000_000
MAX_AGE_NS: Final = 500_000_000
# A second of checks; the share in fewer says nothing of a take.
MIN_CHECKS: Final = 30
MAX_NAMED: Final = 3
WORDS: Final[Mapping[FollowCause, str]] = {
    "limit": "at the joint limit",
    "speed": "too fast",
    "reach": "out of reach",
    "unseen": "not tracked",
}
LOADING: Final = "robot's hand: not checked yet"
# Of keypoints [25, 3] as the tracker sends them and the seconds since the sample before: cause by
# finger of those that the robot cannot follow; None while the check cannot say. A DexTouchError
# says why not, and the next sample is tried again.
FollowCheck = Callable[[np.ndarray, float], Mapping[str, FollowCause] | None]
# Makes the check of a hand with the calibration of the station; may take seconds.
MakeFollowCheck = Callable[[Side, Mapping[str, Matrix]], FollowCheck]


@runtime_checkable
class AnswersTime(Protocol):
    """A driver whose device can be asked for its time while another thread reads it."""

    def time_round_trip(self) -> RoundTrip:
        """One request for the time of the device's clock, the one that stamps its samples."""
        ...


class _StreamPath:
    """The samples of one stream, dated as they come."""

    def __init__(self, descriptor: StreamDescriptor) -> None:
        self.name = descriptor.name
        self._descriptor = descriptor
        self._queue: deque[tuple[int, int]] = deque(maxlen=KEPT_SAMPLES)
        self._rate_hz = descriptor.nominal_rate_hz
        self._restart()

    def _restart(self) -> None:
        self._clock = OnlineClock(self._descriptor)
        self._num_steps = 0
        self._num_samples = 0
        # Device time of the newest sample, and when it left the device by our estimate.
        self._newest: tuple[int, int] | None = None

    def accept(self, samples: Sequence[Sample]) -> None:
        self._queue.extend((sample.t_host_ns, sample.t_device_ns) for sample in samples)

    def follow(self) -> bool:
        """Estimate times of the samples since the last call; whether the device's clock stepped."""
        has_stepped = False
        if self._queue:
            # Samples of uncertain time show no delay.
            self._newest = None
        for _ in range(len(self._queue)):
            t_host_ns, t_device_ns = self._queue.popleft()
            try:
                estimate_ns = self._clock.update(t_host_ns=t_host_ns, t_device_ns=t_device_ns)
            except InvalidInputError:
                # The device left its stamp out; health says so.
                self._restart()
                has_stepped = True
                continue
            if self._clock.uncertainty_ns == 0.0:
                self._newest = (t_device_ns, estimate_ns)
            self._num_samples += 1
            if self._clock.num_steps > self._num_steps:
                self._num_steps, self._num_samples = self._clock.num_steps, 0
                has_stepped = True
        return has_stepped

    def latency(self, trips: RoundTripClock) -> PathLatency | None:
        """The stream's path delay; None while too little is known."""
        if self._newest is None or self._num_samples < MIN_SAMPLES:
            return None
        t_remote_ns, t_estimated_ns = self._newest
        num = min(self._num_samples, WINDOW_S * self._rate_hz)
        edge_ns = EDGE_SPREADS * self._clock.spread_ns / math.sqrt(num)
        # Many samples tell the drift sooner than few exchanges; two ends of the edge make it.
        skew_sigma_ppm = 2e-3 * edge_ns * self._rate_hz / num
        found = trips.latency(
            t_remote_ns=t_remote_ns,
            t_estimated_ns=t_estimated_ns,
            skew=KnownSkew(-self._clock.skew_ppm, skew_sigma_ppm),
        )
        sigma_ns = math.hypot(found.sigma_ns, edge_ns)
        if found.latency_ns < -IMPOSSIBLE_SIGMAS * sigma_ns:
            return None
        return PathLatency(max(0, found.latency_ns), sigma_ns)


class _DevicePath:
    """One device that answers: its exchanges and its streams."""

    def __init__(self, supervisor: DeviceSupervisor, driver: AnswersTime) -> None:
        self.name = supervisor.driver.name
        stamped = [d for d in supervisor.driver.descriptors if d.capabilities.device_time]
        self.streams = [_StreamPath(descriptor) for descriptor in stamped]
        self.num_failures = 0
        self._supervisor = supervisor
        self._driver = driver
        self._resolution_ns = max((one.capabilities.tick_ns for one in stamped), default=1)
        self._trips = RoundTripClock(resolution_ns=self._resolution_ns)
        self._num_silent = 0
        self._rounds_to_skip = 0

    def ask(self) -> None:
        """One exchange with a device that is there; one that was silent is left alone a while."""
        if not self._supervisor.connected.is_set():
            return
        if self._rounds_to_skip:
            self._rounds_to_skip -= 1
            return
        try:
            self._trips.add(self._driver.time_round_trip())
        except (DeviceError, PacketError, InvalidInputError) as error:
            self.num_failures += 1
            self._num_silent = min(self._num_silent + 1, MAX_BACK_OFF)
            self._rounds_to_skip = 2**self._num_silent - 1
            logger.info("miss_time_answer", device=self.name, error=error.message)
        else:
            self._num_silent = 0

    def latencies(self) -> dict[str, PathLatency]:
        found = {}
        for stream in self.streams:
            if stream.follow():
                # A restarted device that does not answer yet: its answers are of the clock before.
                self._trips = RoundTripClock(resolution_ns=self._resolution_ns)
            if self._trips.num_exchanges >= MIN_EXCHANGES:
                latency = stream.latency(self._trips)
                if latency is not None:
                    found[stream.name] = latency
        return found


class PathWatch:
    """Requests the time of every device that can answer once a second, in a separate thread.

    Readers only append timestamps; only this thread waits for answers. With a virtual clock there
    are no requests: its time does not advance during an exchange, and the replies would change
    which packets of a take arrive together.
    """

    def __init__(self, supervisors: Sequence[DeviceSupervisor], *, clock: StationClock) -> None:
        self._devices = [
            _DevicePath(supervisor, supervisor.driver)
            for supervisor in supervisors
            if isinstance(supervisor.driver, AnswersTime) and not isinstance(clock, VirtualClock)
        ]
        self._paths = {stream.name: stream for d in self._devices for stream in d.streams}
        # Whether there is anybody to ask; without one nobody needs to tell of samples either.
        self.asks = bool(self._devices)
        # Replaced as a whole, never changed: whoever reads it needs no lock.
        self._latencies: dict[str, PathLatency] = {}
        self._looks = PeriodicCall(self.look, period_ns=PERIOD_NS, clock=clock, name="path-latency")

    def start(self) -> None:
        """Start asking, if there is anybody to ask."""
        if self.asks:
            self._looks.start()

    def stop(self) -> None:
        """End the thread, after the exchange that is under way."""
        self._looks.stop()

    def accept(self, readings: Readings) -> None:
        """Remember stamps (called by the reader threads)."""
        for name, samples in readings.items():
            if name in self._paths:
                self._paths[name].accept(samples)

    def look(self) -> None:
        """One round: ask all devices, then tell what is known."""
        found: dict[str, PathLatency] = {}
        for device in self._devices:
            try:
                device.ask()
                found |= device.latencies()
            except Exception:
                # One device must not end the measuring of all others for the station's whole life.
                device.num_failures += 1
                logger.exception("fail_path_latency", device=device.name)
        self._latencies = found

    def latencies(self) -> Mapping[str, PathLatency]:
        """Path delays by stream, those known now."""
        return self._latencies

    def num_failures(self, stream: str) -> int | None:
        """Requests that the stream's device did not answer; None of one that is never asked."""
        devices = (d for d in self._devices for path in d.streams if path.name == stream)
        return next((device.num_failures for device in devices), None)


def add_latencies(
    calibration: Mapping[str, Matrix],
    measured: Mapping[str, PathLatency],
    *,
    stated: Collection[str],
) -> dict[str, Matrix]:
    """A recording's calibration, updated with more accurate measured path delays.

    Delays of the names `stated`, which the station's calibration gives, are never replaced.
    """
    added = dict(calibration)
    for stream, latency in measured.items():
        name, sigma_name = f"{stream}_latency_ns", f"{stream}_latency_sigma_ns"
        before = added.get(sigma_name) if name in added else None
        is_better = before is None or latency.sigma_ns < before[0][0]
        if name not in stated and is_better:
            added[name] = ((float(latency.latency_ns),),)
            added[sigma_name] = ((latency.sigma_ns,),)
    return added


@dataclass(frozen=True)
class FollowCounts:
    """Checks of one hand, those in which it could not be followed, and by finger and cause."""

    num_checks: int = 0
    num_missed: int = 0
    causes: Counter[tuple[str, FollowCause]] = field(default_factory=Counter)

    def plus(self, causes: Mapping[str, FollowCause]) -> "FollowCounts":
        """With one more check."""
        counted = self.causes + Counter(causes.items())
        return FollowCounts(self.num_checks + 1, self.num_missed + bool(causes), counted)

    def since(self, before: "FollowCounts") -> "FollowCounts":
        """Only what came after an earlier count."""
        num_checks = self.num_checks - before.num_checks
        causes = self.causes - before.causes
        return FollowCounts(num_checks, self.num_missed - before.num_missed, causes)

    def share(self, num: int) -> float:
        """A number of checks as a share of all."""
        return num / max(1, self.num_checks)

    def figures(self) -> dict[str, float]:
        """Share of the checks not followed, and of the worst finger by each cause that was found.

        None of less than a second of checks.
        """
        if self.num_checks < MIN_CHECKS:
            return {}
        # From the rarest to the most frequent, which stays.
        rising = reversed(self.causes.most_common())
        worst = {f"not_followed_{cause}_ratio": self.share(n) for (_, cause), n in rising}
        return {"not_followed_ratio": self.share(self.num_missed), **worst}

    def words(self) -> str:
        """The share and its most frequent causes, for the check of a take."""
        causes = ", ".join(
            f"{finger} {WORDS[cause]} {_percent(self.share(num))}"
            for (finger, cause), num in self.causes.most_common(MAX_NAMED)
        )
        share = _percent(self.share(self.num_missed))
        return f"the robot's hand could not follow {share} of the time: {causes}"


class _Hand:
    """One stream of keypoints; `newest` is written by its reader, all else by the thread."""

    def __init__(self, side: Side, period_ns: int) -> None:
        self._side: Side = side
        self._period_ns = period_ns
        self.newest: Sample | None = None
        # Replaced as a whole, never changed: whoever reads it needs no lock.
        self.counts = FollowCounts()
        self.note = LOADING
        self._check: FollowCheck | None = None
        self._before_ns: int | None = None
        # When the hand began not to be followed, and when each cause was last found.
        self._since_ns = self._until_ns = -HOLD_NS
        self._found: dict[str, tuple[FollowCause, int]] = {}

    def look(self, make: MakeFollowCheck, calibration: Mapping[str, Matrix]) -> None:
        """Check the newest sample, if it is new."""
        if self._check is None:
            if self.note != LOADING:
                return  # It could not be made, and nothing changes that.
            self._check = make(self._side, calibration)
        sample, before_ns = self.newest, self._before_ns
        if sample is None or (before_ns is not None and sample.t_host_ns <= before_ns):
            return
        self._before_ns = now_ns = sample.t_host_ns
        period_ns = self._period_ns if before_ns is None else now_ns - before_ns
        causes = self._check(sample.values, period_ns / 1e9)
        if causes is None:
            return
        self.note = ""
        self.counts = self.counts.plus(causes)
        if causes:
            if now_ns - self._until_ns > HOLD_NS:
                self._since_ns = now_ns
            self._until_ns = now_ns
            self._found = self._found | {f: (cause, now_ns) for f, cause in causes.items()}

    def live(self, now_ns: int) -> RobotFollowing | None:
        """What is known at a moment; None while no samples come."""
        sample, found = self.newest, self._found
        if sample is None or now_ns - sample.t_host_ns > MAX_AGE_NS:
            return None
        if self.note:
            return RobotFollowing(level="STALE", message=self.note)
        fingers = {f: cause for f, (cause, t_ns) in found.items() if now_ns - t_ns <= HOLD_NS}
        if not fingers:
            return RobotFollowing(level="OK", message="robot follows")
        return RobotFollowing(
            level="WARN",
            message=f"robot cannot follow: {_by_cause(fingers)}",
            fingers=fingers,
            lasted_s=max(0, self._until_ns - self._since_ns) / 1e9,
        )


class FollowWatch:
    """Checks the tracked hands of a station 30 times a second at most.

    Those of keypoints with a side are checked; without `make` none is.
    """

    def __init__(
        self,
        descriptors: Sequence[StreamDescriptor],
        calibration: Mapping[str, Matrix],
        make: MakeFollowCheck | None,
        *,
        clock: StationClock,
    ) -> None:
        self._hands = {
            d.name: _Hand(d.side, d.period_ns())
            for d in descriptors
            if make is not None and d.kind == "keypoints" and d.side is not None
        }
        self._make = make
        self._calibration = calibration
        self._looks = PeriodicCall(
            self.look, period_ns=FOLLOW_PERIOD_NS, clock=clock, name="follow"
        )

    def start(self) -> None:
        """Start checking, if there is a hand to check."""
        if self._hands:
            self._looks.start()

    def stop(self) -> None:
        """End the thread; what it loads or checks at this moment is not waited for."""
        self._looks.cancel()

    def accept(self, readings: Readings) -> None:
        """Remember the newest sample of a hand (called by the reader threads)."""
        for name, samples in readings.items():
            if name in self._hands:
                self._hands[name].newest = samples[-1]

    def look(self) -> None:
        """Check each hand once."""
        for name, hand in self._hands.items():
            try:
                if self._make is not None:
                    hand.look(self._make, self._calibration)
            except DexTouchError as error:
                if hand.note != (note := f"robot's hand not checked: {error.message}"):
                    logger.warning("refuse_follow_check", stream=name, error=error.message)
                hand.note = note
            except Exception:
                # A check that fails must not end those of the other hand.
                if hand.note in {"", LOADING}:
                    logger.exception("fail_follow_check", stream=name)
                hand.note = "robot's hand not checked: the check failed, see the station's log"

    def counts(self) -> dict[str, FollowCounts]:
        """Checks since the station's start, by stream."""
        return {name: hand.counts for name, hand in self._hands.items()}

    def live(self, stream: str, now_ns: int) -> RobotFollowing | None:
        """Whether the robot's hand can follow now; None of streams that are not checked."""
        hand = self._hands.get(stream)
        return None if hand is None else hand.live(now_ns)


def _percent(share: float) -> str:
    return f"{share * 100:.0f} %"


def _by_cause(fingers: Mapping[str, FollowCause]) -> str:
    """Fingers and causes in words, such as "index, middle at the joint limit · thumb too fast"."""
    return " · ".join(
        f"{', '.join(named)} {words}"
        for cause, words in WORDS.items()
        if (named := [finger for finger, other in fingers.items() if other == cause])
    )
