"""Points of (device time, apparent offset) as they come in, the line under the last minute out.

The line looks back only. It tells delays from steps of the device's clock: a delay only ever adds
and ends; a step may go either way and stays.
"""

from dextouch.clocks.lower_hull import Line, LowerHull

WINDOW_S = 60.0
# Below this span the slope of before the last step is kept (at the start: 0).
MIN_SLOPE_SPAN_S = 3.0
# So many points make a slope, however long they span.
MIN_SLOPE_POINTS = 30
# A slope that was fitted over so long is better than one of a shorter stretch after a step.
GOOD_SLOPE_SPAN_S = 20.0
# Within its first second the line may still hang on one late sample, and cannot show a step.
SETTLED_S = 1.0
STEP_NS = 1_000_000.0
# How far single samples stand above the line is a matter of the path: thresholds grow with it.
LATE_SPREADS = 0.5
EARLY_SPREADS = 0.25
# Until the slope is known.
UNSURE_STEP_NS = 4_000_000.0
UNSURE_SPREADS = 4.0
CONFIRM_S = 1.0
# So many in a row are late by half the mean delay or more only where all of them are.
MIN_CONFIRM_SAMPLES = 30
# Samples that were merely late may have come before the step itself.
DOUBTFUL_S = 0.4
SPREAD_RATE = 0.005


class RunningEnvelope:
    """The line under apparent offsets, with a detector of steps; O(vertices) work and memory.

    A point far below the line cannot be a delay: the clock was stepped and the line starts anew
    at once. Points that all lie above it for a second, by the device's time and by the host's, are
    a step too (a burst of packets after a stall is a second of device time only).

    Args:
        resolution_ns: of the device's stamps; steps below it do not show.
        min_slope_span_s: the slope is 0 until the points span so many seconds.
    """

    def __init__(
        self, *, resolution_ns: int = 0, min_slope_span_s: float = MIN_SLOPE_SPAN_S
    ) -> None:
        self._step_ns = STEP_NS + resolution_ns
        self._min_slope_span_s = min_slope_span_s
        self._num_steps = 0
        self._num_points = 0
        self._spread_ns = 0.0
        self._slope_ns_per_s = 0.0
        self._slope_span_s = 0.0
        self._last_x_s = 0.0
        self._start(LowerHull())

    @property
    def num_steps(self) -> int:
        """How often the line was started anew."""
        return self._num_steps

    @property
    def slope_ns_per_s(self) -> float:
        """Present slope."""
        return self._slope_ns_per_s

    @property
    def spread_ns(self) -> float:
        """How far points stand above the line, in the mean of the last few hundred."""
        return self._spread_ns

    def at(self, x_s: float) -> float:
        """The line's value, ns; 0 before the first point."""
        return 0.0 if self._line is None else self._line.at(x_s)

    def add(self, x_s: float, y_ns: float, now_s: float) -> float:
        """Take in a point and tell the line's value there, ns.

        Args:
            x_s: device time.
            y_ns: apparent offset, arrival minus device time.
            now_s: arrival.
        """
        if self._line is not None and self._is_pending(self._line, x_s, y_ns, now_s):
            offset_ns = self._line.at(x_s)
        else:
            offset_ns = self._follow(x_s, y_ns)
        self._last_x_s = x_s
        return offset_ns

    def _start(self, hull: LowerHull) -> None:
        self._hull = hull
        self._line: Line | None = None
        self._num_followed = 0
        self._num_pending = 0
        self._pending_since: tuple[float, float] = (0.0, 0.0)
        self._pending = LowerHull()

    def _is_pending(self, line: Line, x_s: float, y_ns: float, now_s: float) -> bool:
        """Sort out steps; whether the point awaits confirmation and must not move the line."""
        residual_ns = y_ns - line.at(x_s)
        early_ns, late_ns = self._thresholds_ns()
        settled = self._hull.span_s >= SETTLED_S
        if x_s < self._last_x_s or (settled and residual_ns < -early_ns):
            self._num_steps += 1
            self._start(LowerHull())
            return False
        self._measure_spread(residual_ns)
        if residual_ns <= late_ns or not settled:
            self._num_pending = 0
            return False
        if not self._has_lasted(x_s, y_ns, now_s):
            return True
        self._num_steps += 1
        self._start(self._pending)
        return False

    def _has_lasted(self, x_s: float, y_ns: float, now_s: float) -> bool:
        """Take in a point above the line; whether they have all been above it long enough."""
        if self._num_pending == 0:
            self._pending_since = (x_s, now_s)
            self._pending = LowerHull()
        self._num_pending += 1
        lasted_s = min(x_s - self._pending_since[0], now_s - self._pending_since[1])
        if lasted_s >= DOUBTFUL_S:
            self._pending.add(x_s, y_ns)
        return lasted_s >= CONFIRM_S and self._num_pending >= MIN_CONFIRM_SAMPLES

    def _thresholds_ns(self) -> tuple[float, float]:
        """How far below, and how far above the line a point is remarkable."""
        spread_ns = self._spread_ns
        late_ns = self._step_ns + LATE_SPREADS * spread_ns
        if self._slope_span_s < MIN_SLOPE_SPAN_S:
            unsure_ns = UNSURE_STEP_NS + UNSURE_SPREADS * spread_ns
            return unsure_ns, unsure_ns
        return self._step_ns + EARLY_SPREADS * spread_ns, late_ns

    def _measure_spread(self, residual_ns: float) -> None:
        """Follow the mean distance to the line; one outlier or a step must not throw it."""
        self._num_points += 1
        bounded_ns = min(abs(residual_ns), UNSURE_STEP_NS + UNSURE_SPREADS * self._spread_ns)
        rate = max(SPREAD_RATE, 1.0 / self._num_points)
        self._spread_ns += rate * (bounded_ns - self._spread_ns)

    def _follow(self, x_s: float, y_ns: float) -> float:
        hull = self._hull
        hull.add(x_s, y_ns)
        hull.forget_before(x_s - WINDOW_S)
        span_s = hull.span_s
        self._num_followed += 1
        needed_s = max(self._min_slope_span_s, min(self._slope_span_s, GOOD_SLOPE_SPAN_S))
        if span_s < needed_s or self._num_followed < MIN_SLOPE_POINTS:
            line = hull.line_of_slope(self._slope_ns_per_s)
        else:
            line = hull.supporting_line(x_s - span_s / 2)
            self._slope_ns_per_s = line.slope_ns_per_s
            self._slope_span_s = span_s
        self._line = line
        return line.at(x_s)
