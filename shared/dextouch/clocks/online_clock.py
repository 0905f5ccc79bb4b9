"""Samples as they arrive in, their time on the host's clock out: causal, monotonic, bounded."""

from typing import Protocol, runtime_checkable

from dextouch.clocks.lower_hull import Line, LowerHull
from dextouch.errors import InvalidInputError

WINDOW_S = 60.0
# Below this span the slope of before the last step is kept (at the start: 0 ppm).
MIN_SLOPE_SPAN_S = 3.0
STEP_THRESHOLD_NS = 4_000_000.0
SPREAD_FACTOR = 4.0
CONFIRM_S = 1.0
MIN_CONFIRM_SAMPLES = 10
ABSENT = -1


@runtime_checkable
class Capabilities(Protocol):
    """What `dextouch.streams.descriptors.ClockCapabilities` tells about a device's counters."""

    @property
    def sequence_bits(self) -> int:
        """Width of the sequence number."""

    @property
    def tick_ns(self) -> int:
        """Resolution of the device's stamp."""

    @property
    def device_time_bits(self) -> int:
        """Width of the device's stamp, in ticks."""


@runtime_checkable
class ClockSource(Protocol):
    """The part of a stream's descriptor that a clock needs."""

    @property
    def capabilities(self) -> Capabilities:
        """Counters of the device."""

    def period_ns(self) -> int:
        """Nominal distance of two samples."""


class OnlineClock:
    """Running estimate of when each sample left its device, on the host's clock.

    The line under the (device time, apparent offset) points of the last minute, as in
    `fit_clock`, but looking back only. A sample far below the line cannot be a delay: the clock
    was stepped and the line starts anew at once. Samples far above it for a second are a step too.
    Without device time the sequence number times the nominal period is the device's clock; without
    either the arrival itself is returned.

    Args:
        descriptor: the stream's descriptor; needed for wrapping or coarse stamps and for streams
            that have only a sequence number.
    """

    def __init__(self, descriptor: ClockSource | None = None) -> None:
        self._descriptor = descriptor
        self._period_ns = 0 if descriptor is None else descriptor.period_ns()
        self._counter = _Straight(None)
        self._source: str | None = None
        self._num_steps = 0
        self._last_ns: int | None = None
        self._reference: tuple[int, int] = (0, 0)
        self._spread_ns = 0.0
        self._last_x_s = 0.0
        self._slope_ns_per_s = 0.0
        self._start(LowerHull())

    @property
    def source(self) -> str | None:
        """What the clock runs on: device, sequence or arrival; None before the first sample."""
        return self._source

    @property
    def num_steps(self) -> int:
        """Steps and restarts of the device's clock found so far."""
        return self._num_steps

    @property
    def skew_ppm(self) -> float:
        """How much faster the host's clock runs than the device's, present estimate."""
        return self._slope_ns_per_s * 1e-3

    def update(
        self, *, t_host_ns: int, t_device_ns: int | None = None, sequence: int | None = None
    ) -> int:
        """Corrected host time of one sample, strictly later than the one before.

        Args:
            t_host_ns: arrival on the host's monotonic clock.
            t_device_ns: the device's stamp as it came (wrapping as the descriptor says); None or
                -1 where the device gives none.
            sequence: the device's sequence number; None or -1 likewise.

        Raises:
            InvalidInputError: a stamp or number that earlier samples had is missing.
        """
        counted = self._device_time(t_host_ns, t_device_ns, sequence)
        estimate_ns = t_host_ns if counted is None else self._estimate(counted, t_host_ns)
        if self._last_ns is not None:
            estimate_ns = max(estimate_ns, self._last_ns + 1)
        self._last_ns = estimate_ns
        return estimate_ns

    def _device_time(
        self, t_host_ns: int, t_device_ns: int | None, sequence: int | None
    ) -> int | None:
        has_time = t_device_ns is not None and t_device_ns != ABSENT
        has_sequence = sequence is not None and sequence != ABSENT
        if self._source is None:
            counts = has_sequence and self._descriptor is not None
            self._source = "device" if has_time else "sequence" if counts else "arrival"
            self._counter = _Straight(_modulus(self._descriptor, self._source))
        if self._source == "arrival":
            return None
        if self._source == "device" and t_device_ns is not None and has_time:
            return self._counter.unwrap(t_device_ns, t_host_ns)
        if self._source == "sequence" and sequence is not None and has_sequence:
            return self._counter.unwrap(sequence * self._period_ns, t_host_ns)
        raise InvalidInputError(
            f"online clock: a sample at {t_host_ns} ns came without its {self._source} stamp, "
            "which earlier samples had; expected the same fields in every sample of a stream"
        )

    def _start(self, hull: LowerHull) -> None:
        self._hull = hull
        self._line: Line | None = None
        self._pending = LowerHull()
        self._num_pending = 0
        self._pending_since_s = 0.0

    def _estimate(self, device_ns: int, t_host_ns: int) -> int:
        if self._last_ns is None:
            self._reference = (device_ns, t_host_ns - device_ns)
        x_s = (device_ns - self._reference[0]) * 1e-9
        y_ns = float(t_host_ns - device_ns - self._reference[1])
        if self._line is not None and self._is_late(self._line, x_s, y_ns):
            offset_ns = self._line.at(x_s)
        else:
            offset_ns = self._follow(x_s, y_ns)
        self._last_x_s = x_s
        return device_ns + self._reference[1] + round(offset_ns)

    def _is_late(self, line: Line, x_s: float, y_ns: float) -> bool:
        """Sort out steps; whether the sample awaits confirmation and must not move the line."""
        residual_ns = y_ns - line.at(x_s)
        threshold_ns = STEP_THRESHOLD_NS + SPREAD_FACTOR * self._spread_ns
        # In the first second the line itself may still hang on one late sample.
        settled = self._hull.span_s >= CONFIRM_S
        if x_s < self._last_x_s or (settled and residual_ns < -threshold_ns):
            self._num_steps += 1
            self._start(LowerHull())
            return False
        if residual_ns <= threshold_ns:
            self._spread_ns += 0.01 * (abs(residual_ns) - self._spread_ns)
            self._pending, self._num_pending = LowerHull(), 0
            return False
        if self._num_pending == 0:
            self._pending_since_s = x_s
        self._pending.add(x_s, y_ns)
        self._num_pending += 1
        lasted_s = x_s - self._pending_since_s
        if lasted_s < CONFIRM_S or self._num_pending < MIN_CONFIRM_SAMPLES:
            return True
        self._num_steps += 1
        self._start(self._pending)
        return False

    def _follow(self, x_s: float, y_ns: float) -> float:
        hull = self._hull
        hull.add(x_s, y_ns)
        hull.forget_before(x_s - WINDOW_S)
        if hull.span_s < MIN_SLOPE_SPAN_S:
            line = hull.line_of_slope(self._slope_ns_per_s)
        else:
            line = hull.supporting_line(x_s - hull.span_s / 2)
            self._slope_ns_per_s = line.slope_ns_per_s
        self._line = line
        return line.at(x_s)


class _Straight:
    """Unwraps one counter as it comes, by the host's clock."""

    def __init__(self, modulus_ns: int | None) -> None:
        self._modulus_ns = modulus_ns
        self._last: tuple[int, int] | None = None

    def unwrap(self, count_ns: int, t_host_ns: int) -> int:
        straight = count_ns
        if self._modulus_ns is not None and self._last is not None:
            expected = self._last[0] + t_host_ns - self._last[1]
            half = self._modulus_ns // 2
            straight = expected + (count_ns - expected + half) % self._modulus_ns - half
        self._last = (straight, t_host_ns)
        return straight


def _modulus(descriptor: ClockSource | None, source: str) -> int | None:
    """Nanoseconds after which the device's counter starts again, if ever."""
    if descriptor is None:
        return None
    device = descriptor.capabilities
    bits, unit_ns = (
        (device.device_time_bits, device.tick_ns)
        if source == "device"
        else (device.sequence_bits, descriptor.period_ns())
    )
    return None if bits > 62 else int(2**bits * unit_ns)
