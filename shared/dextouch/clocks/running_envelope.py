"""Points of (device time, apparent offset) as they come in, the line under the last minute out.

The line looks back only. It tells delays from steps of the device's clock: a delay only ever adds
and ends; a step may go either way and stays.
"""

import math
from typing import NamedTuple

from dextouch.clocks.lower_hull import Line, LowerHull
from dextouch.clocks.rhythm import Rhythm

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
# Where the stamps of a regular device kept their distance all the while, its clock did not jump:
# the host is busy, and may be for so long before the path is believed to have become longer.
BUSY_S = 10.0
# So many in a row are late by half the mean delay or more only where all of them are.
MIN_CONFIRM_SAMPLES = 30
# Samples that were merely late may have come before the step itself.
DOUBTFUL_S = 0.4
SPREAD_RATE = 0.005
# Which whole number of periods a step left out shows only where samples wait less than a period.
MIN_PERIOD_SPREADS = 4.0
MAX_PERIODS = 100
# A moved line may lie so much of a period above the first point.
BELOW_SHARE = 0.1
# A line that was moved by what the stamps tell must soon be met by points, and undercut by none.
TRIAL_SAMPLES = 1000
MIN_TRIAL_SAMPLES = 2
TRIAL_NS = 100_000.0
TRIAL_ABOVE_SPREADS = 3.0
TRIAL_BELOW_SPREADS = 0.1


class _Trial:
    """Whether a line that was moved at a step lies where the points since then want it.

    A device that was restarted samples at other moments than before; then it does not, and the
    points since the step are all that is known.

    Args:
        hull: of the points since the step.
        num: of these points.
        least_ns: how near they come to the moved line.
    """

    def __init__(self, hull: LowerHull, num: int = 0, least_ns: float = math.inf) -> None:
        self.hull = hull
        self._num = num
        self._least_ns = least_ns

    @property
    def is_over(self) -> bool:
        """Whether enough points agree."""
        return self._num >= TRIAL_SAMPLES

    def fails(self, x_s: float, y_ns: float, residual_ns: float, spread_ns: float) -> bool:
        """Take in a point; whether the moved line is refuted: the nearest of n lies near."""
        self.hull.add(x_s, y_ns)
        self._num += 1
        self._least_ns = min(self._least_ns, residual_ns)
        if self._least_ns < -TRIAL_NS - TRIAL_BELOW_SPREADS * spread_ns:
            return True
        near_ns = TRIAL_NS + TRIAL_ABOVE_SPREADS * spread_ns / math.sqrt(self._num)
        return self._num >= MIN_TRIAL_SAMPLES and self._least_ns > near_ns


class _Odd(NamedTuple):
    """Two stamps that are no whole number of periods apart: device time of the later, distance."""

    x_s: float
    distance_s: float


class RunningEnvelope:
    """The line under apparent offsets, with a detector of steps; O(vertices) work and memory.

    A point far below the line cannot be a delay: the clock was stepped and the line starts anew
    at once. Points that all lie above it for a second, by the device's time and by the host's, are
    a step too (a burst of packets after a stall is a second of device time only), unless the stamps
    of a regular device kept their distance all the while: then the host was busy.

    A device that samples regularly shows in the distance of its stamps by how much its clock was
    stepped, but for whole periods. Then the line and what it hangs on are moved by as much, instead
    of waiting for samples that hardly waited; points that disagree make it start anew after all.

    Args:
        resolution_ns: of the device's stamps; steps below it do not show.
        min_slope_span_s: the slope is 0 until the points span so many seconds.
        is_counted: device time is a count of samples, which keeps its distance whatever the device
            does.
    """

    def __init__(
        self,
        *,
        resolution_ns: int = 0,
        min_slope_span_s: float = MIN_SLOPE_SPAN_S,
        is_counted: bool = False,
    ) -> None:
        self._step_ns = STEP_NS + resolution_ns
        self._min_slope_span_s = min_slope_span_s
        self._is_counted = is_counted
        self._num_steps = 0
        self._num_points = 0
        self._spread_ns = 0.0
        self._slope_ns_per_s = 0.0
        self._slope_span_s = 0.0
        self._last_x_s = 0.0
        self._rhythm = Rhythm()
        self._odd: _Odd | None = None
        self._broken_x_s = -math.inf
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
        if self._line is None:
            offset_ns = self._follow(x_s, y_ns)
        else:
            distance_s = x_s - self._last_x_s
            if self._rhythm.is_odd(distance_s):
                self._odd = _Odd(x_s, distance_s)
            if not self._rhythm.is_kept(distance_s):
                self._broken_x_s = x_s
            self._rhythm.add(distance_s)
            is_pending = self._is_pending(self._line, x_s, y_ns, now_s)
            offset_ns = self._line.at(x_s) if is_pending else self._follow(x_s, y_ns)
        self._last_x_s = x_s
        return offset_ns

    def _start(self, hull: LowerHull) -> None:
        self._hull = hull
        self._line: Line | None = None
        self._num_followed = 0
        self._num_pending = 0
        self._pending_since: tuple[float, float] = (0.0, 0.0)
        self._pending = LowerHull()
        self._trial: _Trial | None = None
        self._odd = None

    def _is_pending(self, line: Line, x_s: float, y_ns: float, now_s: float) -> bool:
        """Sort out steps; whether the point awaits confirmation and must not move the line."""
        residual_ns = y_ns - line.at(x_s)
        early_ns, late_ns = self._thresholds_ns()
        settled = self._hull.span_s >= SETTLED_S
        if x_s < self._last_x_s or (settled and residual_ns < -early_ns):
            self._num_steps += self._trial is None
            step_s = self._step_s(line, x_s - self._last_x_s, (x_s, y_ns))
            self._start_after(step_s, _Trial(LowerHull()))
            return False
        self._measure_spread(residual_ns)
        if self._trial is not None and self._trial.fails(x_s, y_ns, residual_ns, self._spread_ns):
            self._start(self._trial.hull)
            return False
        if residual_ns <= late_ns or not settled:
            self._num_pending = 0
            return False
        if not self._has_lasted(x_s, y_ns, now_s):
            return True
        self._num_steps += 1
        self._confirm(line)
        return False

    def _confirm(self, line: Line) -> None:
        """The points that waited were above the line because of a step."""
        odd, pending = self._odd, self._pending
        if odd is None or odd.x_s < self._pending_since[0]:
            self._start(pending)
            return
        lowest = pending.line_of_slope(line.slope_ns_per_s)
        step_s = self._step_s(line, odd.distance_s, (lowest.x_at_s, lowest.y_at_ns))
        self._start_after(step_s, _Trial(pending))

    def _step_s(self, line: Line, distance_s: float, point: tuple[float, float]) -> float | None:
        """By how much the device's clock jumped; None where its stamps do not tell.

        Args:
            line: of before.
            distance_s: of the stamps before and after the step.
            point: device time and apparent offset of one after the step that hardly waited.
        """
        period_s = self._rhythm.period_s
        if period_s is None or period_s * 1e9 < MIN_PERIOD_SPREADS * self._spread_ns:
            return None
        step_s = distance_s - period_s
        residual_s = (point[1] - line.at(point[0] - step_s)) * 1e-9 + step_s
        num_more = math.floor(residual_s / period_s + BELOW_SHARE)
        # A sample that waited for longer than a period at the step itself hides whole periods of
        # it; the next ones show them.
        if abs(num_more) > MAX_PERIODS or (num_more < 0 and self._trial is None):
            return None
        return step_s - num_more * period_s

    def _start_after(self, step_s: float | None, trial: _Trial) -> None:
        """Go on after a step of known size with the moved line, of unknown size with new points."""
        if step_s is None:
            self._start(trial.hull)
            return
        hull, num_followed = self._hull.moved(step_s, -step_s * 1e9), self._num_followed
        for x_s, y_ns in trial.hull:
            hull.add(x_s, y_ns)
        self._start(hull)
        self._num_followed, self._trial = num_followed, trial

    def _has_lasted(self, x_s: float, y_ns: float, now_s: float) -> bool:
        """Take in a point above the line; whether they have all been above it long enough."""
        if self._num_pending == 0:
            self._pending_since = (x_s, now_s)
            self._pending = LowerHull()
        self._num_pending += 1
        lasted_s = min(x_s - self._pending_since[0], now_s - self._pending_since[1])
        if lasted_s >= DOUBTFUL_S:
            self._pending.add(x_s, y_ns)
        may_have_jumped = self._is_counted or self._broken_x_s >= self._pending_since[0]
        needed_s = CONFIRM_S if may_have_jumped else BUSY_S
        return lasted_s >= needed_s and self._num_pending >= MIN_CONFIRM_SAMPLES

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
        if self._trial is not None and self._trial.is_over:
            self._trial = None
        return line.at(x_s)
