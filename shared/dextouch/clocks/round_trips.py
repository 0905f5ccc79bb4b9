"""Clock offset between two hosts from round-trip exchanges, with its standard deviation.

The forward path bounds the offset from above, the return path from below: remote minus local lies
between (reply sent - reply received) and (request received - request sent). Over many exchanges the
fastest paths of either direction leave a narrow band (as NTP does with the minimum round trip, here
with drift: Zhang, Liu, Xia 2002). The position within the band is unobservable, since the two path
delays may differ; sigma accounts for it.
"""

import math
from dataclasses import dataclass

from dextouch.clocks.envelopes import LowerHull
from dextouch.errors import ClockFitError, InvalidInputError

WINDOW_S = 600.0
# Upper bound of the drift between two crystals; estimating it needs a span of exchanges.
MAX_SKEW_PPM = 100.0
MIN_SLOPE_SPAN_S = 30.0
MIN_SLOPE_EXCHANGES = 10
# The standard deviation of a uniform distribution is its half width over the root of three.
BAND_SIGMA = 1 / math.sqrt(12)


@dataclass(frozen=True)
class RoundTrip:
    """One exchange: request sent and reply received on the local clock, the rest on the remote.

    A device that only reports its time has two equal remote stamps.
    """

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

    Used for devices (stamps against the host's clock) and for other hosts (their clock against the
    station's reference clock). A step of the remote clock by more than the band, counted in
    `num_steps`, is detected at once and restarts the estimate, of `num_exchanges` exchanges since;
    memory is bounded. `resolution_ns` is that of the remote stamps.
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
        """Add one exchange, in order of the requests.

        Raises InvalidInputError for a reply before its request, or out of order.
        """
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

        `skew`, of another source, is used if it is more accurate than that of the exchanges.

        Raises ClockFitError without an exchange (`details["cause"]` is "too_few").
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
        """Path latency that is still contained in a device's corrected times.

        It comes from a sample's device time, and its time by `OnlineClock` or `fit_clock`.
        """
        offset = self.estimate(t_estimated_ns, skew=skew)
        true_ns = t_remote_ns - offset.offset_ns
        return PathLatency(t_estimated_ns - true_ns, offset.sigma_ns)

    def _x_s(self, at_local_ns: int) -> float:
        start_ns = 0 if self._reference is None else self._reference[0]
        return (at_local_ns - start_ns) * 1e-9

    def _slope(self) -> tuple[float, float]:
        """Drift in ns per second, and its uncertainty."""
        span_s = min(self._upper.span_s, self._lower.span_s)
        if span_s < MIN_SLOPE_SPAN_S or self.num_exchanges < MIN_SLOPE_EXCHANGES:
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
        """Whether an exchange lies entirely outside the band of the others."""
        slope, uncertainty = self._slope()
        band_high_ns, band_low_ns, age_s = self._band(x_s, slope)
        slack_ns = 2 * uncertainty * age_s + self._resolution_ns
        return high_ns < band_low_ns - slack_ns or low_ns > band_high_ns + slack_ns
