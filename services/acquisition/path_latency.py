"""Measurement of path delays of devices that answer requests for their time.

Exchanges with a device that answers time requests measure the offset of its clock, which one-way
timestamps cannot. The difference to the estimated sample times is the path delay.
"""

import math
from collections import deque
from collections.abc import Collection, Mapping, Sequence
from typing import Protocol, runtime_checkable

import structlog

from dextouch.clocks import KnownSkew, OnlineClock, PathLatency, RoundTrip, RoundTripClock
from dextouch.errors import DeviceError, InvalidInputError, PacketError
from dextouch.schemas import Matrix
from dextouch.streams import Sample, StreamDescriptor
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

    def follow(self) -> None:
        """Estimate the times of the samples since the last call."""
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
                continue
            if self._clock.uncertainty_ns == 0.0:
                self._newest = (t_device_ns, estimate_ns)
            self._num_samples += 1
            if self._clock.num_steps > self._num_steps:
                self._num_steps, self._num_samples = self._clock.num_steps, 0

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
        ticks_ns = [descriptor.capabilities.tick_ns for descriptor in stamped]
        self._trips = RoundTripClock(resolution_ns=max(ticks_ns, default=1))
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
            stream.follow()
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
