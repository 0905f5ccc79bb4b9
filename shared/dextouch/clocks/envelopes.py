"""Lower envelopes of (device time, apparent offset) points, the basis of clock fits.

A sample cannot arrive before it was sent, so the true offset between two clocks lies on the
lower edge of the cloud of apparent offsets (Moon, Skelly, Towsley 1999; Zhang, Liu, Xia 2002): the
edge of the lower convex hull at a time is the highest line there that stays below every point.
"""

import math
from collections import deque
from collections.abc import Iterator
from itertools import pairwise
from statistics import fmean, median
from typing import NamedTuple

MAX_VERTICES = 256
WINDOW_S = 60.0
# Below this span the slope from before the last step is kept (initially 0).
MIN_SLOPE_SPAN_S = 3.0
# This many points determine a slope, whatever their span.
MIN_SLOPE_POINTS = 30
# A slope fitted over this span is better than one of a shorter span after a step.
GOOD_SLOPE_SPAN_S = 20.0
# 100 ppm, the tolerance of crystals: a slope that differs by more was one of a slewed clock.
MAX_KEPT_NS_PER_S = 1e5
# In its first second the line may still rest on a single late sample, and cannot reveal a step.
SETTLED_S = 1.0
STEP_NS = 1_000_000.0
# The spread above the line depends on the path: thresholds scale with it.
LATE_SPREADS = 0.5
EARLY_SPREADS = 0.25
# While the slope is unknown.
UNSURE_STEP_NS = 4_000_000.0
UNSURE_SPREADS = 4.0
CONFIRM_S = 1.0
# If the stamps of a regular device kept their distance, its clock did not jump: the host is busy.
# After this time the path delay is assumed to have increased.
BUSY_S = 10.0
# This many in a row are late by half the mean delay or more only if all of them are.
MIN_CONFIRM_SAMPLES = 30
# Late samples may have arrived before the step itself.
DOUBTFUL_S = 0.4
SPREAD_RATE = 0.005
# The number of whole periods of a step is determined only if delays are below a period.
MIN_PERIOD_SPREADS = 4.0
MAX_PERIODS = 100
# A shifted line may lie this share of a period above the first point.
BELOW_SHARE = 0.1
# Points must soon reach a shifted line, and none may fall below it.
TRIAL_SAMPLES = 1000
MIN_TRIAL_SAMPLES = 2
TRIAL_NS = 100_000.0
TRIAL_ABOVE_SPREADS = 3.0
TRIAL_BELOW_SPREADS = 0.1
# Regular distances of stamps.
LEARNED_DISTANCES = 32
# Minimum share of distances that are one period long; the others are lost samples.
MIN_REGULAR_SHARE = 0.75
NEAR_SHARE = 0.05
RATE = 0.01
# Maximum mean deviation from the period for a regular device.
MAX_SCATTER_S = 100e-6
ODD_S = 100e-6
ODD_SCATTERS = 5.0
# After this many irregular distances in a row, the period is learned again.
MAX_ODD = 8


class Line(NamedTuple):
    """y = y_at_x + slope · (x - x_at); x in seconds, y in nanoseconds."""

    x_at_s: float
    y_at_ns: float
    slope_ns_per_s: float

    def at(self, x_s: float) -> float:
        """Value of the line."""
        return self.y_at_ns + self.slope_ns_per_s * (x_s - self.x_at_s)


class LowerHull:
    """Incremental lower convex hull, at most `MAX_VERTICES`; old points can be removed."""

    def __init__(self) -> None:
        self._vertices: deque[tuple[float, float]] = deque()

    def __iter__(self) -> Iterator[tuple[float, float]]:
        """Vertices in order of x."""
        return iter(self._vertices)

    def moved(self, x_s: float, y_ns: float) -> "LowerHull":
        """A hull of the same points, translated."""
        hull = LowerHull()
        hull._vertices = deque((x + x_s, y + y_ns) for x, y in self._vertices)
        return hull

    @property
    def span_s(self) -> float:
        """Time between the first and the last vertex."""
        return self._vertices[-1][0] - self._vertices[0][0] if self._vertices else 0.0

    def add(self, x_s: float, y_ns: float) -> None:
        """Add a point; its x must not precede the last one's."""
        vertices = self._vertices
        if vertices and vertices[-1][0] == x_s:
            y_ns = min(y_ns, vertices.pop()[1])
        while len(vertices) >= 2:
            (xa, ya), (xb, yb) = vertices[-2], vertices[-1]
            if (yb - ya) * (x_s - xa) < (y_ns - ya) * (xb - xa):
                break
            vertices.pop()
        vertices.append((x_s, y_ns))
        if len(vertices) > MAX_VERTICES:
            last = vertices[-1]
            self._vertices = deque([*list(vertices)[:-1:2], last])

    def forget_before(self, x_s: float) -> None:
        """Drop vertices older than `x_s`, all but the last two."""
        vertices = self._vertices
        while len(vertices) > 2 and vertices[0][0] < x_s:
            vertices.popleft()

    def supporting_line(self, x_s: float) -> Line:
        """The hull's edge that spans `x_s`, or the nearest; horizontal for a single vertex."""
        vertices = self._vertices
        if len(vertices) < 2:
            x, y = vertices[0]
            return Line(x, y, 0.0)
        edges = pairwise(vertices)
        last = (vertices[-2], vertices[-1])
        (xa, ya), (xb, yb) = next((edge for edge in edges if edge[1][0] >= x_s), last)
        return Line(xa, ya, (yb - ya) / (xb - xa))

    def line_of_slope(self, slope_ns_per_s: float) -> Line:
        """The highest line of a given slope that stays below every point."""
        x, y = min(self._vertices, key=lambda vertex: vertex[1] - slope_ns_per_s * vertex[0])
        return Line(x, y, slope_ns_per_s)


class _Trial:
    """Whether a line that was shifted at a step agrees with the points since then (`hull`)."""

    def __init__(self, hull: LowerHull) -> None:
        self.hull = hull
        self._num = 0
        self._least_ns = math.inf

    @property
    def is_over(self) -> bool:
        """Whether enough points confirm the line."""
        return self._num >= TRIAL_SAMPLES

    def fails(self, x_s: float, y_ns: float, residual_ns: float, spread_ns: float) -> bool:
        """Add a point; whether the shifted line is refuted: the nearest of n must lie near it."""
        self.hull.add(x_s, y_ns)
        self._num += 1
        self._least_ns = min(self._least_ns, residual_ns)
        if self._least_ns < -TRIAL_NS - TRIAL_BELOW_SPREADS * spread_ns:
            return True
        near_ns = TRIAL_NS + TRIAL_ABOVE_SPREADS * spread_ns / math.sqrt(self._num)
        return self._num >= MIN_TRIAL_SAMPLES and self._least_ns > near_ns


class RunningEnvelope:
    """Lower envelope of apparent offsets with step detection; O(vertices) time and memory.

    A point far below the line cannot be a delay: the clock was stepped and the line is restarted at
    once. Points that all lie above it for a second, in device and host time, are a step too, unless
    the stamps of a regular device kept their distance: then the host was busy. The distance of such
    stamps gives the size of a step modulo the period: the line is shifted by it at once, and
    restarted only where later points disagree.

    Args:
        resolution_ns: of the device's stamps; smaller steps are not detectable.
        min_slope_span_s: the slope is 0 until the points span this many seconds.
        is_counted: device time is a sample count, whose distances are always regular.

    Attributes:
        num_steps: restarts of the line so far.
        slope_ns_per_s: of the line.
        spread_ns: mean distance of the last few hundred points above the line.
        uncertainty_ns: how far the last point lies above the line if that is no usual delay, or 0.
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
        self.num_steps = 0
        self._num_points = self._num_pending = 0
        self.spread_ns = self._spread_before_ns = 0.0
        self.uncertainty_ns = 0.0
        self.slope_ns_per_s = 0.0
        self._slope_span_s = 0.0
        self._last_x_s = 0.0
        self._rhythm = Rhythm()
        self._broken_x_s = -math.inf
        self._start(LowerHull())

    def at(self, x_s: float) -> float:
        """Value of the line in ns; 0 before the first point."""
        return 0.0 if self._line is None else self._line.at(x_s)

    def add(self, x_s: float, y_ns: float, now_s: float) -> float:
        """Add a point (device time, apparent offset, arrival); returns the line there, in ns."""
        if self._line is None:
            offset_ns = self._follow(x_s, y_ns)
        else:
            distance_s = x_s - self._last_x_s
            is_odd = self._rhythm.is_odd(distance_s)
            if is_odd:
                self._odd = x_s, distance_s
            if not self._rhythm.is_kept(distance_s):
                self._broken_x_s = x_s
            self._rhythm.add(distance_s)
            is_pending = self._is_pending(self._line, x_s, y_ns, now_s)
            # A single wrong stamp would hold the line down for a minute.
            is_left_out = is_pending or (is_odd and self._line is not None)
            offset_ns = self._line.at(x_s) if is_left_out else self._follow(x_s, y_ns)
        self._last_x_s = x_s
        above_ns = y_ns - offset_ns
        self.uncertainty_ns = above_ns if above_ns > self._thresholds_ns()[1] else 0.0
        return offset_ns

    def _start(self, hull: LowerHull) -> None:
        if self._num_pending:
            # The pending points were not late.
            self.spread_ns = self._spread_before_ns
        self._hull = hull
        self._line: Line | None = None
        self._num_followed = 0
        self._num_pending = 0
        self._pending_since: tuple[float, float] = (0.0, 0.0)
        self._pending = LowerHull()
        self._trial: _Trial | None = None
        # The newest stamp at an irregular distance from the one before, and that distance.
        self._odd = -math.inf, 0.0

    def _is_pending(self, line: Line, x_s: float, y_ns: float, now_s: float) -> bool:
        """Step detection; returns whether the point is pending and must not affect the line."""
        residual_ns = y_ns - line.at(x_s)
        early_ns, late_ns = self._thresholds_ns()
        settled = self._hull.span_s >= SETTLED_S
        if x_s < self._last_x_s or (settled and residual_ns < -early_ns):
            self.num_steps += self._trial is None
            step_s = self._step_s(line, x_s - self._last_x_s, (x_s, y_ns))
            self._start_after(step_s, _Trial(LowerHull()))
            return False
        self._measure_spread(residual_ns)
        if self._trial is not None and self._trial.fails(x_s, y_ns, residual_ns, self.spread_ns):
            self._start(self._trial.hull)
            return False
        if residual_ns <= late_ns or not settled:
            self._num_pending = 0
            return False
        if not self._has_lasted(x_s, y_ns, now_s):
            return True
        self.num_steps += 1
        self._confirm(line)
        return False

    def _confirm(self, line: Line) -> None:
        """Confirm that the pending points lie above the line because of a step."""
        (odd_x_s, distance_s), pending = self._odd, self._pending
        if pending.span_s >= MIN_SLOPE_SPAN_S:
            own = pending.supporting_line(self._last_x_s - pending.span_s / 2)
            if abs(own.slope_ns_per_s - self.slope_ns_per_s) > MAX_KEPT_NS_PER_S:
                self.slope_ns_per_s = own.slope_ns_per_s
                self._slope_span_s = pending.span_s
                self._start(pending)
                return
        if odd_x_s < self._pending_since[0]:
            self._start(pending)
            return
        lowest = pending.line_of_slope(line.slope_ns_per_s)
        step_s = self._step_s(line, distance_s, (lowest.x_at_s, lowest.y_at_ns))
        self._start_after(step_s, _Trial(pending))

    def _step_s(self, line: Line, distance_s: float, point: tuple[float, float]) -> float | None:
        """Size of a step from the stamps around it; None if they do not determine it."""
        period_s = self._rhythm.period_s
        if period_s is None or period_s * 1e9 < MIN_PERIOD_SPREADS * self.spread_ns:
            return None
        step_s = distance_s - period_s
        residual_s = (point[1] - line.at(point[0] - step_s)) * 1e-9 + step_s
        num_more = math.floor(residual_s / period_s + BELOW_SHARE)
        # A sample delayed by more than a period at the step hides whole ones; the next reveal them.
        if abs(num_more) > MAX_PERIODS or (num_more < 0 and self._trial is None):
            return None
        return step_s - num_more * period_s

    def _start_after(self, step_s: float | None, trial: _Trial) -> None:
        """Continue after a step: with the shifted line if the size is known, else anew."""
        if step_s is None:
            self._start(trial.hull)
            return
        hull, num_followed = self._hull.moved(step_s, -step_s * 1e9), self._num_followed
        for x_s, y_ns in trial.hull:
            hull.add(x_s, y_ns)
        self._start(hull)
        self._num_followed, self._trial = num_followed, trial

    def _has_lasted(self, x_s: float, y_ns: float, now_s: float) -> bool:
        """Add a point above the line; whether all have been above it long enough."""
        if self._num_pending == 0:
            self._pending_since = (x_s, now_s)
            self._spread_before_ns = self.spread_ns
            self._pending = LowerHull()
        self._num_pending += 1
        lasted_s = min(x_s - self._pending_since[0], now_s - self._pending_since[1])
        if lasted_s >= DOUBTFUL_S:
            self._pending.add(x_s, y_ns)
        may_have_jumped = self._is_counted or self._broken_x_s >= self._pending_since[0]
        needed_s = CONFIRM_S if may_have_jumped else BUSY_S
        return lasted_s >= needed_s and self._num_pending >= MIN_CONFIRM_SAMPLES

    def _thresholds_ns(self) -> tuple[float, float]:
        """Detection thresholds below and above the line."""
        # Points that may follow a step say nothing about delays.
        spread_ns = self._spread_before_ns if self._num_pending else self.spread_ns
        late_ns = self._step_ns + LATE_SPREADS * spread_ns
        if self._slope_span_s < MIN_SLOPE_SPAN_S:
            unsure_ns = UNSURE_STEP_NS + UNSURE_SPREADS * spread_ns
            return unsure_ns, unsure_ns
        return self._step_ns + EARLY_SPREADS * spread_ns, late_ns

    def _measure_spread(self, residual_ns: float) -> None:
        """Update the mean distance to the line, robust against outliers and steps."""
        self._num_points += 1
        bounded_ns = min(abs(residual_ns), UNSURE_STEP_NS + UNSURE_SPREADS * self.spread_ns)
        rate = max(SPREAD_RATE, 1.0 / self._num_points)
        self.spread_ns += rate * (bounded_ns - self.spread_ns)

    def _follow(self, x_s: float, y_ns: float) -> float:
        hull = self._hull
        hull.add(x_s, y_ns)
        hull.forget_before(x_s - WINDOW_S)
        span_s = hull.span_s
        self._num_followed += 1
        needed_s = max(self._min_slope_span_s, min(self._slope_span_s, GOOD_SLOPE_SPAN_S))
        if span_s < needed_s or self._num_followed < MIN_SLOPE_POINTS:
            line = hull.line_of_slope(self.slope_ns_per_s)
        else:
            line = hull.supporting_line(x_s - span_s / 2)
            self.slope_ns_per_s = line.slope_ns_per_s
            self._slope_span_s = span_s
        self._line = line
        if self._trial is not None and self._trial.is_over:
            self._trial = None
        return line.at(x_s)


class Rhythm:
    """Regularity of a timer's stamps: whole periods apart, but where it jumps or restarts."""

    def __init__(self) -> None:
        self._distances: list[float] = []
        self._period_s = 0.0
        self._scatter_s = 0.0
        self._num_odd = 0

    @property
    def period_s(self) -> float | None:
        """Sample period by the device's clock; None while unknown or irregular."""
        if self._period_s > 0.0 and self._scatter_s <= MAX_SCATTER_S:
            return self._period_s
        return None

    def is_odd(self, distance_s: float) -> bool:
        """Whether a distance is not a whole number of periods of a regular device."""
        period_s = self.period_s
        if period_s is None:
            return False
        num = max(1, round(distance_s / period_s))
        return abs(distance_s - num * period_s) > ODD_S + ODD_SCATTERS * self._scatter_s

    def is_kept(self, distance_s: float) -> bool:
        """Whether a distance is exactly one period of a regular device: no jump, no loss."""
        period_s = self.period_s
        return (
            period_s is not None
            and round(distance_s / period_s) == 1
            and not self.is_odd(distance_s)
        )

    def add(self, distance_s: float) -> None:
        """Add the next distance, of either sign."""
        if self._period_s <= 0.0:
            self._learn(distance_s)
            return
        departure_s = distance_s - self._period_s
        if abs(departure_s) <= NEAR_SHARE * self._period_s:
            self._num_odd = 0
            self._period_s += RATE * departure_s
            self._scatter_s += RATE * (abs(departure_s) - self._scatter_s)
            return
        self._num_odd += 1
        if self._num_odd > MAX_ODD:
            self._period_s = 0.0

    def _learn(self, distance_s: float) -> None:
        self._distances.append(distance_s)
        if len(self._distances) < LEARNED_DISTANCES:
            return
        distances, self._distances = self._distances, []
        period_s = median(distances)
        near = [abs(d - period_s) for d in distances if abs(d - period_s) <= NEAR_SHARE * period_s]
        if len(near) >= MIN_REGULAR_SHARE * LEARNED_DISTANCES:
            self._period_s, self._scatter_s, self._num_odd = period_s, fmean(near), 0
