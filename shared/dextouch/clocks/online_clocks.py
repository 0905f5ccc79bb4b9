"""Host times of samples as they arrive, by device time, counting or round trips of requests."""

import math
from collections import deque
from dataclasses import dataclass
from typing import Literal, NamedTuple

import numpy as np
from jaxtyping import Int64

from dextouch.clocks.envelopes import MIN_SLOPE_SPAN_S, LowerHull, RunningEnvelope
from dextouch.errors import ClockFitError, InvalidInputError, ShapeError
from dextouch.streams import StreamDescriptor

# Stamps coarser than this share of the sample period are less accurate than counting samples.
COARSE_SHARE = 0.25
ABSENT = -1
# A nominal rate can be off by percents, a crystal by tens of ppm: counted samples need a slope
# earlier than stamped ones.
COUNTED_SLOPE_SPAN_S = 0.5
Source = Literal["device", "sequence", "arrival"]
LOOK_AHEAD = 10
# A sample is lost where all behind it are later by nearly a period: delays are far more common.
LOST_SHARE = 0.75
# While a queue drains, the look-ahead may be extended by this factor.
MAX_WAIT = 6
# A device whose samples are counted must be a steady one. Beyond these its nominal rate is wrong
# or it samples when it likes, and its arrivals say more.
MAX_STEADY_SKEW_PPM = 20_000.0
MAX_STEADY_LOSS = 0.1
MAX_STEPS_PER_SAMPLE = 0.001
# Of round trips.
WINDOW_S = 600.0
# Upper bound of the drift between two crystals; estimating it needs a span of exchanges.
MAX_SKEW_PPM = 100.0
MIN_SKEW_SPAN_S = 30.0
MIN_SKEW_EXCHANGES = 10
# The standard deviation of a uniform distribution is its half width over the root of three.
BAND_SIGMA = 1 / math.sqrt(12)


def nearest_congruent(count: int, expected: int, modulus: int) -> int:
    """The number nearest to `expected` that is congruent to `count` modulo `modulus`."""
    half = modulus // 2
    return expected + (count - expected + half) % modulus - half


def prefers_sequence(tick_ns: int, period_ns: int) -> bool:
    """Whether stamps are so coarse that sequence numbers are the better clock."""
    return tick_ns > COARSE_SHARE * period_ns


def unwrap_counter(
    raw: np.ndarray, *, modulus: int, hint: np.ndarray | None = None
) -> Int64[np.ndarray, " n"]:
    """Unwrap integer counts [n] in 0 … modulus - 1 of a counter that wraps at `modulus`, 2 … 2**62.

    `hint` is another clock in the same unit [n] (arrival times). It gives the number of wraps in a
    gap longer than a wrap; without it a step of more than half a modulus counts as one wrap, a
    smaller step back as a step back.

    Raises:
        ShapeError: not one axis of integers, or a hint of another length.
        InvalidInputError: a count outside 0 … modulus - 1, or an invalid modulus.
    """
    counts = np.asarray(raw)
    if counts.ndim != 1 or not np.issubdtype(counts.dtype, np.integer):
        raise ShapeError(f"counter: got {counts.dtype} {counts.shape}, expected integers [n]")
    if not 2 <= modulus <= 2**62:
        raise InvalidInputError(f"counter: got modulus {modulus}, expected 2 … 2**62")
    if counts.size and (int(counts.min()) < 0 or int(counts.max()) >= modulus):
        raise InvalidInputError(
            f"counter: got counts {counts.min()} … {counts.max()}, expected 0 … {modulus - 1}"
        )
    straight = counts.astype(np.int64)
    steps: Int64[np.ndarray, " m"] = np.diff(straight)
    expected = np.zeros_like(steps) if hint is None else np.diff(np.asarray(hint, dtype=np.int64))
    if expected.shape != steps.shape:
        raise ShapeError(f"counter: got {counts.size} counts and a hint of another length")
    half = modulus // 2
    # The congruent step nearest to the expected one.
    steps = expected + np.mod(steps - expected + half, modulus) - half
    return np.concatenate([straight[:1], straight[:1] + np.cumsum(steps)]).astype(np.int64)


def count_lost_samples(sequence: np.ndarray, *, bits: int = 64) -> int:
    """Samples missing from a sequence [n] of 8 … 64 bits; none where the device restarts."""
    if not 8 <= bits <= 64:
        raise InvalidInputError(f"sequence: got a counter of {bits} bits, expected 8 … 64")
    numbers = np.asarray(sequence, dtype=np.int64)
    straight = numbers if bits > 62 else unwrap_counter(numbers, modulus=2**bits)
    return int(np.maximum(np.diff(straight) - 1, 0).sum())


class OnlineClock:
    """Running estimate of the time at which each sample left its device, on the host's clock.

    The line under the (device time, apparent offset) points of the last minute, as in `fit_clock`,
    but causal (`RunningEnvelope`). Without device time, or where it is very coarse, the sequence
    number times the nominal period is the device's clock; without either, the arrival itself is
    returned. Wrapping or coarse stamps, or sequence numbers alone, need the stream's descriptor.
    """

    def __init__(self, descriptor: StreamDescriptor | None = None) -> None:
        self._counter = DeviceCounter(descriptor)
        self._envelope = RunningEnvelope()
        self._last_ns: int | None = None
        # Device time of the first sample, and its arrival minus that.
        self._start: tuple[int, int] | None = None

    @property
    def source(self) -> Source | None:
        """Source of the clock: device, sequence or arrival; None before the first sample."""
        return self._counter.source

    @property
    def num_steps(self) -> int:
        """Steps and restarts of the device's clock found so far."""
        return self._envelope.num_steps

    @property
    def skew_ppm(self) -> float:
        """How much faster the host's clock runs than the device's, present estimate."""
        return self._envelope.slope_ns_per_s * 1e-3

    @property
    def spread_ns(self) -> float:
        """Recent mean of the path delay above its minimum."""
        return self._envelope.spread_ns

    @property
    def uncertainty_ns(self) -> float:
        """How much later than estimated the last sample may be; 0 if it came promptly."""
        return self._envelope.uncertainty_ns

    def update(
        self, *, t_host_ns: int, t_device_ns: int | None = None, sequence: int | None = None
    ) -> int:
        """Corrected host time of one sample, strictly increasing.

        The arrival is on the host's monotonic clock; the device's raw stamp and sequence number are
        None
        or -1 if it has none. Raises InvalidInputError if one that earlier samples had is missing.
        """
        device_ns = self._counter.straighten(t_host_ns, t_device_ns, sequence)
        estimate_ns = t_host_ns if device_ns is None else self._estimate(device_ns, t_host_ns)
        if self._last_ns is not None and estimate_ns <= self._last_ns:
            estimate_ns = self._last_ns + 1
        self._last_ns = estimate_ns
        return estimate_ns

    def _estimate(self, device_ns: int, t_host_ns: int) -> int:
        if self._start is None:
            self._start = device_ns, t_host_ns - device_ns
            counted = self._counter.source == "sequence"
            self._envelope = RunningEnvelope(
                resolution_ns=self._counter.resolution_ns,
                min_slope_span_s=COUNTED_SLOPE_SPAN_S if counted else MIN_SLOPE_SPAN_S,
                is_counted=counted,
            )
        start_ns, reference_ns = self._start
        since_ns, ahead_ns = device_ns - start_ns, t_host_ns - device_ns - reference_ns
        now_s = (since_ns + ahead_ns) * 1e-9
        offset_ns = self._envelope.add(since_ns * 1e-9, float(ahead_ns), now_s)
        # Stamps are truncated to whole ticks: on average the sample is half a tick later. The line
        # does not show it, since it is determined by the stamps with the smallest truncation.
        estimate_ns = min(device_ns + reference_ns + round(offset_ns), t_host_ns)
        return estimate_ns + self._counter.resolution_ns // 2


class DeviceCounter:
    """Continuous device time of stamps or, where these are coarse, of sequence numbers."""

    def __init__(self, descriptor: StreamDescriptor | None) -> None:
        self._descriptor = descriptor
        self._period_ns = 0 if descriptor is None else descriptor.period_ns()
        self.resolution_ns = 0
        self._modulus_ns: int | None = None
        self._last: tuple[int, int] | None = None
        self.source: Source | None = None

    def straighten(
        self, t_host_ns: int, t_device_ns: int | None, sequence: int | None
    ) -> int | None:
        """Device time of one sample, in ns; None if the device provides no counter."""
        t_device_ns = None if t_device_ns == ABSENT else t_device_ns
        sequence = None if sequence == ABSENT else sequence
        if self.source is None:
            self._choose(has_time=t_device_ns is not None, has_sequence=sequence is not None)
        if self.source == "arrival":
            return None
        count_ns = t_device_ns
        if self.source == "sequence":
            count_ns = None if sequence is None else sequence * self._period_ns
        if count_ns is None:
            raise InvalidInputError(
                f"online clock: a sample at {t_host_ns} ns came without its {self.source} stamp, "
                "which earlier samples had; expected the same fields in every sample of a stream"
            )
        if self._modulus_ns is not None and self._last is not None:
            expected_ns = self._last[0] + t_host_ns - self._last[1]
            count_ns = nearest_congruent(count_ns, expected_ns, self._modulus_ns)
        self._last = (count_ns, t_host_ns)
        return count_ns

    def _choose(self, *, has_time: bool, has_sequence: bool) -> None:
        if self._descriptor is None:
            self.source = "device" if has_time else "arrival"
            return
        device = self._descriptor.capabilities
        if has_time and not (has_sequence and prefers_sequence(device.tick_ns, self._period_ns)):
            self.source = "device"
            self.resolution_ns = device.tick_ns
            bits, unit_ns = device.device_time_bits, device.tick_ns
        elif has_sequence:
            self.source = "sequence"
            bits, unit_ns = device.sequence_bits, self._period_ns
        else:
            self.source = "arrival"
            return
        # A wider counter never wraps.
        self._modulus_ns = 2**bits * unit_ns if bits <= 62 else None


class CountedSample(NamedTuple):
    """A counted sample.

    Attributes:
        number: inferred sample number, 0 for the first.
        t_host_ns: time at which it left the device, on the host's clock.
    """

    number: int
    t_host_ns: int


class CountingClock:
    """Estimates the times of samples of a steady device without stamps and sequence numbers.

    Times are available ten samples later, or once a queue has drained. The nominal period is
    accurate within a few percent; `num_lost` counts lost samples up to the last final time.
    """

    def __init__(self, period_ns: int) -> None:
        if period_ns < 1:
            raise InvalidInputError(
                f"counting clock: got a period of {period_ns} ns, expected at least 1"
            )
        self._period_ns = period_ns
        self._waiting: deque[int] = deque()
        self._envelope = RunningEnvelope(min_slope_span_s=COUNTED_SLOPE_SPAN_S, is_counted=True)
        self._start_ns: int | None = None
        self._index = -1
        self.num_lost = 0
        self._last_final_ns: int | None = None

    @property
    def num_steps(self) -> int:
        """Number of device restarts and of corrected miscounts."""
        return self._envelope.num_steps

    @property
    def skew_ppm(self) -> float:
        """Relative excess of the sample period over the nominal one, in ppm."""
        return self._envelope.slope_ns_per_s * 1e-3

    @property
    def is_steady(self) -> bool:
        """Whether the device is so steady that counting is more accurate than arrival times."""
        num_arrived = self._index + 1 - self.num_lost
        return (
            abs(self.skew_ppm) <= MAX_STEADY_SKEW_PPM
            and self.num_lost <= MAX_STEADY_LOSS * num_arrived
            and self.num_steps <= MAX_STEPS_PER_SAMPLE * num_arrived
        )

    def advance(self, t_host_ns: int) -> tuple[CountedSample, ...]:
        """Add an arrival, not before the last one; returns the samples decided by it."""
        if self._waiting and t_host_ns < self._waiting[-1]:
            raise InvalidInputError(
                f"counting clock: got an arrival at {t_host_ns} ns after one at "
                f"{self._waiting[-1]} ns, expected the order of arrival"
            )
        if self._start_ns is None:
            self._start_ns = t_host_ns
        self._waiting.append(t_host_ns)
        final: list[CountedSample] = []
        while len(self._waiting) > LOOK_AHEAD and (sample := self._decide()) is not None:
            final.append(sample)
        return tuple(final)

    def flush(self) -> tuple[CountedSample, ...]:
        """Final times of the pending samples, with less than the full look-ahead."""
        decided = (self._decide(is_last_chance=True) for _ in range(len(self._waiting)))
        return tuple(sample for sample in decided if sample is not None)

    def _lateness_ns(self, count: int) -> list[float]:
        """Delay of the first pending samples if none were lost."""
        start_ns = self._start_ns if self._start_ns is not None else 0
        period_ns = self._period_ns * (1 + self._envelope.slope_ns_per_s * 1e-9)
        x_ns = (self._index + 1) * self._period_ns
        origin_ns = start_ns + x_ns + round(self._envelope.at(x_ns * 1e-9))
        return [self._waiting[k] - origin_ns - k * period_ns for k in range(count)]

    def _num_lost_before(self, *, is_last_chance: bool) -> int | None:
        """Number of samples lost before the oldest pending one; None while undecided."""
        if self._index < 0:
            return 0
        threshold_ns = LOST_SHARE * self._period_ns
        if self._lateness_ns(1)[0] < threshold_ns:
            return 0
        late_ns = self._lateness_ns(len(self._waiting))
        least_ns = min(late_ns)
        if least_ns < threshold_ns:
            return 0
        # A queue that is still draining: the following samples are delayed less.
        draining = late_ns[-1] <= least_ns
        if draining and not is_last_chance and len(late_ns) < MAX_WAIT * LOOK_AHEAD:
            return None
        return int(least_ns / self._period_ns + 1.0 - LOST_SHARE)

    def _decide(self, *, is_last_chance: bool = False) -> CountedSample | None:
        num_lost = self._num_lost_before(is_last_chance=is_last_chance)
        if num_lost is None or self._start_ns is None:
            return None
        self.num_lost += num_lost
        self._index += 1 + num_lost
        since_ns = self._waiting.popleft() - self._start_ns
        x_ns = self._index * self._period_ns
        offset_ns = self._envelope.add(x_ns * 1e-9, float(since_ns - x_ns), since_ns * 1e-9)
        final_ns = self._start_ns + x_ns + round(offset_ns)
        if self._last_final_ns is not None:
            final_ns = max(final_ns, self._last_final_ns + 1)
        self._last_final_ns = final_ns
        return CountedSample(self._index, final_ns)


@dataclass(frozen=True)
class CountedTake:
    """Estimated times of a whole take without stamps.

    Attributes:
        number: inferred sample numbers, 0 for the first.
        t_host_ns: times at which samples left the device, on the host's clock, strictly increasing.
        skew_ppm: relative excess of the sample period over the nominal one, at the end.
        num_lost: number of lost samples.
        num_steps: number of device restarts and of corrected miscounts.
        is_steady: whether these times are more accurate than the arrivals.
    """

    number: Int64[np.ndarray, " n"]
    t_host_ns: Int64[np.ndarray, " n"]
    skew_ppm: float
    num_lost: int
    num_steps: int
    is_steady: bool


def date_by_counting(t_host_ns: np.ndarray, *, period_ns: int) -> CountedTake:
    """Sample times of a steady device (nominal period within percents) from arrivals [n] alone."""
    clock = CountingClock(period_ns)
    counted: list[CountedSample] = []
    for arrival_ns in np.asarray(t_host_ns, dtype=np.int64).tolist():
        counted.extend(clock.advance(arrival_ns))
    counted.extend(clock.flush())
    return CountedTake(
        number=np.array([sample.number for sample in counted], dtype=np.int64),
        t_host_ns=np.array([sample.t_host_ns for sample in counted], dtype=np.int64),
        skew_ppm=clock.skew_ppm,
        num_lost=clock.num_lost,
        num_steps=clock.num_steps,
        is_steady=clock.is_steady,
    )


@dataclass(frozen=True)
class RoundTrip:
    """One request with its reply; the remote stamps are equal where a device has only one."""

    sent_ns: int
    remote_received_ns: int
    remote_sent_ns: int
    received_ns: int

    @property
    def delay_ns(self) -> int:
        """Round-trip delay without the remote's processing time."""
        return self.received_ns - self.sent_ns - (self.remote_sent_ns - self.remote_received_ns)


@dataclass(frozen=True)
class ClockOffset:
    """Remote clock minus local clock at one local time.

    Attributes:
        sigma_ns: standard deviation, for arbitrary asymmetry of the path delays.
        delay_ns: minimum round-trip delay, the width of the offset's band.
        skew_ppm: how much faster the remote clock runs.
    """

    at_local_ns: int
    offset_ns: int
    sigma_ns: float
    delay_ns: float
    skew_ppm: float


@dataclass(frozen=True)
class PathLatency:
    """Constant latency between a sample and its stamp on the host's clock."""

    latency_ns: int
    sigma_ns: float


@dataclass(frozen=True)
class KnownSkew:
    """How much faster a remote clock runs, with its standard deviation."""

    skew_ppm: float
    sigma_ppm: float


class RoundTripClock:
    """Estimates the offset between the local clock and a remote one that replies to requests.

    The forward path bounds the offset from above, the return path from below; the fastest of many
    exchanges leave a narrow band (as NTP's minimum round trip, here with drift: Zhang, Liu, Xia
    2002). The position in the band cannot be observed: sigma accounts for it. A step of the remote
    clock by more than the band restarts the estimate at once. `resolution_ns` is that of the remote
    stamps.
    """

    def __init__(self, *, resolution_ns: int = 1) -> None:
        self._resolution_ns = resolution_ns
        self.num_steps = 0
        self._reference: tuple[int, int] | None = None
        self._last_ns = 0
        self._start()

    def _start(self) -> None:
        self._upper, self._lower = LowerHull(), LowerHull()
        self.num_exchanges = 0

    def add(self, exchange: RoundTrip) -> None:
        """Add an exchange, in order; raises InvalidInputError for a reply before its request."""
        if exchange.received_ns < exchange.sent_ns or exchange.sent_ns < self._last_ns:
            raise InvalidInputError(
                f"round trip: got a question at {exchange.sent_ns} ns and its answer at "
                f"{exchange.received_ns} ns after one at {self._last_ns} ns; expected answers "
                "after their questions, in order, all by the same local clock"
            )
        if exchange.delay_ns < -self._resolution_ns:
            raise InvalidInputError(
                f"round trip: {exchange.delay_ns} ns on the way; the remote held the question "
                "longer than the exchange took: check the remote stamps' unit"
            )
        above_ns = exchange.remote_received_ns + self._resolution_ns - exchange.sent_ns
        below_ns = exchange.remote_sent_ns - exchange.received_ns
        if self._reference is None:
            self._reference = (exchange.sent_ns, below_ns)
        self._last_ns = exchange.sent_ns
        x_s = self._x_s(exchange.sent_ns)
        high, low = (float(value - self._reference[1]) for value in (above_ns, below_ns))
        if self.num_exchanges and self._contradicts(x_s, high, low):
            self.num_steps += 1
            self._start()
        self._upper.add(x_s, high)
        self._lower.add(x_s, -low)
        self.num_exchanges += 1
        for hull in (self._upper, self._lower):
            hull.forget_before(x_s - WINDOW_S)

    def estimate(
        self, at_local_ns: int | None = None, *, skew: KnownSkew | None = None
    ) -> ClockOffset:
        """Offset at a local time; by default at the last exchange.

        `skew`, of another source, is used if it is more accurate than that of the exchanges. Raises
        ClockFitError without an exchange (`details["cause"]` is "too_few").
        """
        if self._reference is None:
            raise ClockFitError("round trip clock: no exchange yet", cause="too_few")
        at_local_ns = self._last_ns if at_local_ns is None else at_local_ns
        x_s = self._x_s(at_local_ns)
        slope, uncertainty = self._slope()
        if skew is not None and skew.sigma_ppm * 1e3 < uncertainty:
            slope, uncertainty = skew.skew_ppm * 1e3, skew.sigma_ppm * 1e3
        high_ns, low_ns, age_s = self._band(x_s, slope)
        width_ns = max(0.0, high_ns - low_ns)
        drift_ns = uncertainty * age_s
        return ClockOffset(
            at_local_ns=at_local_ns,
            offset_ns=self._reference[1] + round((high_ns + low_ns) / 2),
            sigma_ns=math.hypot(width_ns * BAND_SIGMA, drift_ns),
            delay_ns=width_ns,
            skew_ppm=slope * 1e-3,
        )

    def latency(
        self, *, t_remote_ns: int, t_estimated_ns: int, skew: KnownSkew | None = None
    ) -> PathLatency:
        """Path latency still contained in a sample's time by `OnlineClock` or `fit_clock`."""
        offset = self.estimate(t_estimated_ns, skew=skew)
        true_ns = t_remote_ns - offset.offset_ns
        return PathLatency(t_estimated_ns - true_ns, offset.sigma_ns)

    def _x_s(self, at_local_ns: int) -> float:
        start_ns = 0 if self._reference is None else self._reference[0]
        return (at_local_ns - start_ns) * 1e-9

    def _slope(self) -> tuple[float, float]:
        """Drift in ns per second, and its uncertainty."""
        span_s = min(self._upper.span_s, self._lower.span_s)
        if span_s < MIN_SKEW_SPAN_S or self.num_exchanges < MIN_SKEW_EXCHANGES:
            return 0.0, MAX_SKEW_PPM * 1e3 * BAND_SIGMA * 2
        middle_s = self._x_s(self._last_ns) - span_s / 2
        above = self._upper.supporting_line(middle_s).slope_ns_per_s
        below = -self._lower.supporting_line(middle_s).slope_ns_per_s
        return (above + below) / 2, abs(above - below) / 2

    def _band(self, x_s: float, slope: float) -> tuple[float, float, float]:
        """Upper and lower bound (ns), and distance (s) from the exchanges that define them."""
        high, low = self._upper.line_of_slope(slope), self._lower.line_of_slope(-slope)
        age_s = max(abs(x_s - line.x_at_s) for line in (high, low))
        return high.at(x_s), -low.at(x_s), age_s

    def _contradicts(self, x_s: float, high_ns: float, low_ns: float) -> bool:
        slope, uncertainty = self._slope()
        band_high_ns, band_low_ns, age_s = self._band(x_s, slope)
        slack_ns = 2 * uncertainty * age_s + self._resolution_ns
        return high_ns < band_low_ns - slack_ns or low_ns > band_high_ns + slack_ns
