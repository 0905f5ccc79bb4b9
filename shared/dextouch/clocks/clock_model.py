"""Clock model that maps device time to host time, fitted offline between the steps of the clock."""

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float64, Int64
from numpy.lib.stride_tricks import sliding_window_view

from dextouch.clocks.envelopes import Line, LowerHull
from dextouch.errors import ClockFitError, InvalidInputError

MIN_SAMPLES = 10
# Minimum number of samples of a second (or longer) for the lateness.
MIN_PROMPT_SAMPLES = 10
PROMPT_S = 1.0
# Chosen: longer than what hosts and paths hold back without pause, shorter than what a wrong fit
# does between two events.
PROMPT_SECONDS = 5
# A straight line fits a minute of crystal drift; longer takes get a piecewise linear model.
WINDOW_S = 60.0
# Below this many samples or seconds a segment's own slope is mostly noise.
MIN_SLOPE_SAMPLES = 50
MIN_SLOPE_SPAN_S = 1.0
# Next to a gap a line may rest on two late samples; it then deviates from its neighbours by more.
MAX_DRIFT_NS_PER_S = 1e6
SILENCE_S = 1.0
NEIGHBOURS = 2
CONFIRM_S = 1.0
STEP_NS = 1_000_000.0
# A step must also exceed the usual scatter of the one-second minima by this factor.
SPREAD_FACTOR = 8.0
# A single stamp is wrong if its deviation exceeds the usual one by this factor.
WRONG_SCATTERS = 3.0
# How near to a change of level a jump of the stamps lies, in samples: a few late ones before a
# rise look risen too. Without regular stamps to tell, only next to it.
REACH = 30
IRREGULAR_REACH = 3
# Tolerances for matching jumps of stamps to changes of level, as shares of a sample period and of
# the change: the levels scatter.
MATCH_SHARE = 0.2
MATCH_CHANGE_SHARE = 0.5
REGULAR_QUANTILE = 0.9
# A clock that stood still shows in no distance of stamps, only in the arrivals: within a fifth of a
# second they become late, and stay so. A rise of so much must last for so long, by both clocks; the
# smallest is above a USB frame of 1 ms, and a path may hold back all samples for some seconds.
SUDDEN_RISES = ((25e6, 1_000_000_000), (1.5e6, 7_000_000_000))
# The path may have become longer little by little and then stay so: the fit follows after a minute
# anyway. A continuing rise is a change of rate.
GRADUAL_RISE = (5e6, 60_000_000_000)
SUDDEN_S = 0.2
# It was a delay if this many arrivals return within this time; single stamps may be wrong.
RETURN_NS = 120_000_000_000
MIN_RETURNED = 3
# Chosen: no path holds a sample back for so long that the next one, on time, is so far ahead.
AHEAD_NS = 30_000_000_000
# So many samples in a row are hardly ever all late by chance.
NUM_BETWEEN = 5
# What rises so near to the end of a take, and stays, is more often a delay than a stop, unless it
# rises by more than paths hold back without pause.
END_NS = 5_000_000_000
MAX_END_DELAY_NS = 500e6


@dataclass(frozen=True)
class ClockSegment:
    """Part of a take in which the device's clock ran without a step.

    host = device + reference_offset_ns + (piecewise linear through knots of the offset), knots in
    seconds after `start_device_ns`. It covers arrivals from `start_host_ns` on, except the first
    `num_tied` with that exact stamp.
    """

    start_device_ns: int
    stop_device_ns: int
    start_host_ns: int
    num_tied: int
    reference_offset_ns: int
    knots_s: Float64[np.ndarray, " k"]
    knot_offsets_ns: Float64[np.ndarray, " k"]

    def to_host_ns(self, t_device_ns: np.ndarray) -> Int64[np.ndarray, " n"]:
        """Host times of device times."""
        x = (t_device_ns - self.start_device_ns).astype(np.float64) * 1e-9
        offset = np.interp(x, self.knots_s, self.knot_offsets_ns)
        for end, inner in ((0, 1), (-1, -2)):
            run = self.knots_s[end] - self.knots_s[inner]
            slope = (self.knot_offsets_ns[end] - self.knot_offsets_ns[inner]) / run
            outside = x < self.knots_s[0] if end == 0 else x > self.knots_s[-1]
            beyond = self.knot_offsets_ns[end] + slope * (x - self.knots_s[end])
            offset = np.where(outside, beyond, offset)
        return t_device_ns + self.reference_offset_ns + np.rint(offset).astype(np.int64)


@dataclass(frozen=True)
class ClockModel:
    """Piecewise map from device time to host time.

    Host times include the stream's smallest path delay, which one-way stamps cannot show; subtract
    the calibrated latency_ns.

    Attributes:
        segments: in order of arrival; more than one where the device's clock was stepped.
        skew_ppm: how much faster the host's clock runs, mean over all segments.
        residual_rms_ns: RMS of arrival minus fitted time: queueing on the path, not the fit's
            error.
        lateness_ns: of `lateness_ns`, without detected delays. Near zero for a good fit.
        has_unsure_stops: whether a stop may have been a delay or a slew, or a last delay a stop.
    """

    segments: tuple[ClockSegment, ...]
    skew_ppm: float
    residual_rms_ns: float
    lateness_ns: float = 0.0
    has_unsure_stops: bool = False

    @property
    def num_steps(self) -> int:
        """Number of steps and restarts of the device's clock."""
        return len(self.segments) - 1

    @property
    def is_ambiguous(self) -> bool:
        """Whether the device's clock went back, so that a device time can have two host times."""
        stops = [segment.stop_device_ns for segment in self.segments[:-1]]
        starts = [segment.start_device_ns for segment in self.segments[1:]]
        return any(start <= stop for stop, start in zip(stops, starts, strict=True))

    def to_host_ns(
        self, t_device_ns: np.ndarray, t_host_ns: np.ndarray | None = None
    ) -> Int64[np.ndarray, " n"]:
        """Host times of unwrapped device times [n], on the host's clock at the smallest path delay.

        Raises InvalidInputError where the device's clock went back, so that arrivals are needed to
        select the segment, and they are missing. No sample is dated after its arrival.
        """
        t_device_ns = np.asarray(t_device_ns, dtype=np.int64)
        if t_host_ns is None and self.is_ambiguous:
            raise InvalidInputError(
                f"clock: the device's clock went back ({self.num_steps} steps), so a device time "
                "can mean two moments; pass t_host_ns too"
            )
        if t_host_ns is None:
            starts = [segment.start_device_ns for segment in self.segments]
            keys = t_device_ns
        else:
            starts = [segment.start_host_ns for segment in self.segments]
            keys = np.asarray(t_host_ns, dtype=np.int64)
        chosen = np.clip(np.searchsorted(starts, keys, side="right") - 1, 0, len(starts) - 1)
        if t_host_ns is not None:
            for index, segment in enumerate(self.segments[1:]):
                tied = np.flatnonzero(keys == segment.start_host_ns)[: segment.num_tied]
                chosen[tied] = index
        host_ns = np.empty_like(t_device_ns)
        for index, segment in enumerate(self.segments):
            mine = chosen == index
            host_ns[mine] = segment.to_host_ns(t_device_ns[mine])
        return host_ns if t_host_ns is None else np.minimum(host_ns, keys)


def fit_clock(t_device_ns: np.ndarray, t_host_ns: np.ndarray) -> ClockModel:
    """Fit a clock model to a whole take by the lower convex hull, non-causally.

    Unwrapped device stamps and arrivals on the host's monotonic clock [n] are in order of arrival.
    Steps and restarts of the device's clock are detected, and segments fitted separately.

    Raises:
        ClockFitError: `details["cause"]` is "too_few" (below 10 samples), "not_finite" (no
            integers), "not_increasing" (arrivals go back, or device stamps go back more often than
            clock steps explain) or "length" (unequal lengths).
    """
    device, host = _checked(t_device_ns, t_host_ns)
    device = corrected_stamps(device, host)
    cuts, waiting, has_unsure_stops = find_steps(device, host)
    bounds = list(zip([0, *cuts], [*cuts, len(device)], strict=True))
    fitted_to = [a + np.flatnonzero(~waiting[a:b]) for a, b in bounds]
    slopes = [_slope(device[points], host[points]) for points in fitted_to]
    lengths = np.array(
        [b - a if slope is not None else 0 for (a, b), slope in zip(bounds, slopes, strict=True)]
    )
    known = np.array([0.0 if slope is None else slope for slope in slopes])
    mean_slope = float((known * lengths).sum() / max(lengths.sum(), 1))
    segments = tuple(
        _fit_segment(device, host, points, None if slope is not None else mean_slope)
        for points, slope in zip(fitted_to, slopes, strict=True)
    )
    fitted = np.concatenate(
        [segment.to_host_ns(device[a:b]) for segment, (a, b) in zip(segments, bounds, strict=True)]
    )
    residual_ns = (host - fitted).astype(np.float64)
    return ClockModel(
        segments,
        skew_ppm=mean_slope * 1e-3,
        residual_rms_ns=float(np.sqrt(np.mean(residual_ns**2))),
        lateness_ns=lateness_ns(residual_ns[~waiting], host[~waiting]),
        has_unsure_stops=has_unsure_stops,
    )


def lateness_ns(residual_ns: np.ndarray, host: np.ndarray) -> float:
    """Least lateness within five seconds (ten periods), the largest of the take."""
    if len(host) < MIN_PROMPT_SAMPLES:
        return 0.0
    second_ns = max(PROMPT_S * 1e9, MIN_PROMPT_SAMPLES * float(np.median(np.diff(host))))
    starts = np.unique((host - host[0]) // round(second_ns), return_index=True)[1]
    promptest_ns = np.minimum.reduceat(residual_ns, starts)
    is_full = np.diff(starts, append=len(host)) >= MIN_PROMPT_SAMPLES // 2
    full_ns = promptest_ns[is_full]
    num = min(PROMPT_SECONDS, len(full_ns))
    return float(sliding_window_view(full_ns, num).min(axis=1).max()) if num else 0.0


def _checked(
    t_device_ns: np.ndarray, t_host_ns: np.ndarray
) -> tuple[Int64[np.ndarray, " n"], Int64[np.ndarray, " n"]]:
    device, host = np.asarray(t_device_ns), np.asarray(t_host_ns)
    if device.ndim != 1 or device.shape != host.shape:
        raise _refusal("length", f"got shapes {device.shape} and {host.shape}, expected two [n]")
    if not all(np.issubdtype(array.dtype, np.integer) for array in (device, host)):
        raise _refusal(
            "not_finite", f"got {device.dtype} and {host.dtype}, expected int64 nanoseconds"
        )
    if len(device) < MIN_SAMPLES:
        raise _refusal("too_few", f"got {len(device)} samples, expected at least {MIN_SAMPLES}")
    device, host = device.astype(np.int64), host.astype(np.int64)
    backwards = int((np.diff(host) < 0).sum())
    if backwards:
        raise _refusal("not_increasing", f"{backwards} host arrivals lie before their predecessor")
    backwards = int((np.diff(device) < 0).sum())
    if backwards > max(1, len(device) // 100):
        raise _refusal(
            "not_increasing",
            f"{backwards} of {len(device)} device stamps run back, more than steps can explain; "
            "unwrap the counter and keep the order of arrival",
        )
    if device[0] == device[-1] and not np.diff(device).any():
        raise _refusal("not_increasing", "the device's stamp never changes")
    return device, host


def _refusal(cause: str, text: str) -> ClockFitError:
    return ClockFitError(f"clock fit: {text}", cause=cause)


def _offsets(device: np.ndarray, host: np.ndarray) -> tuple[list[float], list[float], int]:
    """Seconds of device time, apparent offsets in ns, and the subtracted int64 reference."""
    reference_ns = int(host[0] - device[0])
    x = (device - device[0]).astype(np.float64) * 1e-9
    y = (host - device - reference_ns).astype(np.float64)
    return x.tolist(), y.tolist(), reference_ns


def _hull(x: list[float], y: list[float]) -> LowerHull:
    hull = LowerHull()
    for x_s, y_ns in zip(x, y, strict=True):
        hull.add(x_s, y_ns)
    return hull


def _slope(device: np.ndarray, host: np.ndarray) -> float | None:
    """Drift of a segment in ns per second; None if it is too short."""
    if len(device) < MIN_SLOPE_SAMPLES or device[-1] - device[0] < MIN_SLOPE_SPAN_S * 1e9:
        return None
    x, y, _ = _offsets(device, host)
    return _hull(x, y).supporting_line(x[-1] / 2).slope_ns_per_s


def _fit_segment(
    device: np.ndarray, host: np.ndarray, points: np.ndarray, slope: float | None
) -> ClockSegment:
    first = points[0]
    x, y, reference_ns = _offsets(device[points], host[points])
    knots = _knots(x, y) if slope is None else _straight(x, _hull(x, y).line_of_slope(slope))
    return ClockSegment(
        start_device_ns=int(device[first]),
        stop_device_ns=int(device[points[-1]]),
        start_host_ns=int(host[first] - (host[first] - host[max(first - 1, 0)]) // 2),
        num_tied=int(np.count_nonzero(host[:first] == host[first])),
        reference_offset_ns=reference_ns,
        knots_s=np.array([knot[0] for knot in knots]),
        knot_offsets_ns=np.array([knot[1] for knot in knots]),
    )


def _straight(x: list[float], line: Line) -> list[tuple[float, float]]:
    end_s = max(x[-1], 1e-3)
    return [(0.0, line.at(0.0)), (end_s, line.at(end_s))]


def _knots(x: list[float], y: list[float]) -> list[tuple[float, float]]:
    """Knots at the ends and at the centres of half-overlapping windows, on supporting lines."""
    span_s = x[-1]
    num_windows = max(1, int(np.ceil((span_s - WINDOW_S) / (WINDOW_S / 2))) + 1)
    if num_windows == 1:
        return _straight(x, _hull(x, y).supporting_line(span_s / 2))
    fits: list[tuple[float, LowerHull, bool]] = []
    for start_s in np.linspace(0, span_s - WINDOW_S, num_windows):
        a, b = np.searchsorted(x, [start_s, start_s + WINDOW_S])
        if b - a >= MIN_SAMPLES:
            # With missing samples, the centre of a window may lie beyond its last one.
            middle_s, hull = (x[a] + x[b - 1]) / 2, _hull(x[a:b], y[a:b])
            fits.append((middle_s, hull, bool(np.diff(x[a:b]).max() > SILENCE_S)))
    if not fits:
        return _straight(x, _hull(x, y).supporting_line(span_s / 2))
    lines = [hull.supporting_line(middle_s) for middle_s, hull, _ in fits]
    slopes = [line.slope_ns_per_s for line in lines]
    for index, (_, hull, has_silence) in enumerate(fits):
        around = slopes[max(0, index - NEIGHBOURS) : index + NEIGHBOURS + 1]
        usual = float(np.median(around))
        if has_silence and abs(slopes[index] - usual) > MAX_DRIFT_NS_PER_S:
            lines[index] = hull.line_of_slope(usual)
    knots = [(fit[0], line.at(fit[0])) for fit, line in zip(fits, lines, strict=True)]
    return [(0.0, lines[0].at(0.0)), *knots, (span_s, lines[-1].at(span_s))]


class Steps(NamedTuple):
    """Steps and delays found in a take.

    Attributes:
        cuts: first samples after a step or a stop, in order.
        waiting: mask [n] of samples in delays of a second or more.
        is_unsure: whether stops and delays cannot be distinguished.
    """

    cuts: list[int]
    waiting: Bool[np.ndarray, " n"]
    is_unsure: bool


class _Rise(NamedTuple):
    """A lasting rise of the offset: a delay that ended before `last`, or (None) a stop."""

    first: int
    last: int | None
    is_unsure: bool


def find_steps(device: np.ndarray, host: np.ndarray) -> Steps:
    """Find steps and stops of a device's clock.

    A step persists, a delay does not: the minimum apparent offset of the second before is compared
    with that of the second after, and a step also shows in the distance of a regular device's
    stamps.
    Other rises are delays if they end within two minutes, or come in the last five seconds and are
    below half a second; else the clock stopped. Device time that goes back, or ahead of the
    arrivals by half a minute, is always a step.
    """
    waiting = np.zeros(len(device), dtype=bool)
    is_unsure = False
    steps = np.diff(device)
    is_step = (steps < 0) | (steps - np.diff(host) > AHEAD_NS)
    cuts: list[int] = (np.flatnonzero(is_step) + 1).tolist()
    period_ns = float(np.median(np.diff(host)))
    count = int(np.clip(CONFIRM_S * 1e9 / max(period_ns, 1.0), 5, 500))
    if len(device) > 2 * count:
        levels = _Levels(device, host, count)
        stamps = _Stamps(device)
        for cut, change_ns in levels.changes():
            exact = stamps.place(cut, change_ns)
            if exact is not None and all(abs(exact - known) > count for known in cuts):
                cuts.append(exact)
                is_unsure |= change_ns > 0 and not stamps.is_regular
        for rise in levels.rises(sorted(cuts)):
            is_unsure |= rise.is_unsure
            if rise.last is None:
                cuts.append(rise.first)
            else:
                waiting[rise.first : rise.last] = True
    return Steps(sorted(set(cuts)), waiting, is_unsure)


def corrected_stamps(t_device_ns: np.ndarray, t_host_ns: np.ndarray) -> Int64[np.ndarray, " n"]:
    """Replace one or two wrong stamps in a row by whole periods from the right ones beside them.

    Unwrapped device stamps and arrivals are [n]. Stamps of a regular device are wrong if they are
    not whole periods from those beside them, which are so from each other. Others stay as they are.
    """
    device, host = np.array(t_device_ns, dtype=np.int64), np.asarray(t_host_ns)
    if len(device) < MIN_SAMPLES or not (stamps := _Stamps(device)).is_regular:
        return device
    period_ns = max(stamps.period_ns, 1.0)
    limit_ns = max(STEP_NS, WRONG_SCATTERS * stamps.scatter_ns)
    # The last of several equal stamps is no right one.
    rises = np.diff(device, prepend=device[0] - 1) > 0
    for run in (1, 2):
        span_ns = (device[run + 1 :] - device[: -run - 1]).astype(np.float64)
        num = np.rint(span_ns / period_ns)
        is_wrong = (num > run) & (np.abs(span_ns - num * period_ns) < limit_ns)
        is_wrong &= rises[: -run - 1]
        for k in range(1, run + 1):
            since_ns = device[k : k - run - 1] - device[: -run - 1]
            nearest = np.rint(since_ns / period_ns)
            # Two that are whole periods away may have overtaken each other.
            nearest = np.clip(nearest, 1, num - 1) if run == 1 else nearest
            is_wrong &= np.abs(since_ns - nearest * period_ns) > limit_ns
        before = np.flatnonzero(is_wrong)
        for k in range(1, run + 1):
            waited = np.rint((host[before + k] - host[before]) / period_ns)
            share = np.clip(waited, k, num[before] - run - 1 + k) / num[before]
            device[before + k] = device[before] + np.rint(span_ns[before] * share).astype(np.int64)
    return device


class _Levels:
    """Minimum apparent offsets of the second before and after each sample."""

    def __init__(self, device: np.ndarray, host: np.ndarray, count: int) -> None:
        self._device, self._host, self._count = device, host, count
        offset_ns = (host - device - (host[0] - device[0])).astype(np.float64)
        minima = sliding_window_view(offset_ns, count).min(axis=1)
        # At sample i (count … n - count): the least of the `count` samples before, and from it on.
        change_ns = minima[count:] - minima[: len(minima) - count]
        middle_ns = float(np.median(change_ns))
        spread_ns = float(np.median(np.abs(change_ns - middle_ns)))
        self._threshold_ns = STEP_NS + SPREAD_FACTOR * spread_ns
        # The median is a whole number of ticks where arrivals are; the mean is not.
        drift_ns = float(change_ns[np.abs(change_ns - middle_ns) <= self._threshold_ns].mean())
        self._change_ns = change_ns - drift_ns
        # The same from sample 1 on: before the first second is over, the least since the start.
        least_ns = np.minimum.accumulate(offset_ns[: count - 1])
        self._rise_ns = np.concatenate([minima[1:count] - least_ns, self._change_ns])
        # With the drift removed, levels that are minutes apart can be compared.
        elapsed = (host - host[0]) / float(np.median(host[count:] - host[:-count]))
        self._straight_ns = offset_ns - drift_ns * elapsed

    def changes(self) -> list[tuple[int, float]]:
        """Lasting changes of the one-second minimum, with their size."""
        change_ns, threshold_ns = self._change_ns, self._threshold_ns
        # A fall is visible up to the first fallen sample, a rise from the first risen one on.
        falls = [(b, change_ns[a : b + 1].min()) for a, b in _runs(-change_ns, threshold_ns)]
        rises = [(a, change_ns[a : b + 1].max()) for a, b in _runs(change_ns, threshold_ns)]
        return sorted((self._count + index, float(height)) for index, height in falls + rises)

    def rises(self, cuts: list[int]) -> list[_Rise]:
        """Lasting rises of the offset between known cuts, with their ends."""
        bounds = [0, *cuts, len(self._device)]
        found: list[_Rise] = []
        known = 0
        for index in (np.flatnonzero(self._rise_ns > self._threshold_ns) + 1).tolist():
            after = int(np.searchsorted(bounds, index, side="right"))
            first = max(bounds[after - 1], known, index - self._count)
            if first < index and (rise := self._rise(first, index, bounds[after])) is not None:
                found.append(rise)
                known = rise.first if rise.last is None else rise.last
        return found

    def _rise(self, first: int, index: int, last: int) -> _Rise | None:
        """The lasting rise at `index` above the samples from `first`, before the step at `last`."""
        y, host, device = self._straight_ns, self._host[index:last], self._device[index:last]
        before_ns = y[first:index].min()
        num_sudden = max(2, round(SUDDEN_S / CONFIRM_S * self._count))
        for least_ns, lasts_ns in (*SUDDEN_RISES, GRADUAL_RISE):
            ends = [int(np.searchsorted(t, t[0] + lasts_ns)) for t in (host, device)]
            num = max(*ends, self._count)
            if num >= last - index:
                return None
            risen = y[index : index + num]
            if risen.min() - before_ns <= max(least_ns, self._threshold_ns):
                continue
            level_ns = risen[num // 2 :].min()
            # Samples below the new level were delayed at the old one.
            early = np.flatnonzero(risen < level_ns - STEP_NS)
            start = index + int(early[-1]) + 1 if len(early) else index
            middle_ns = (before_ns + level_ns) / 2
            is_sudden = y[max(start - num_sudden, first) : start].min() < middle_ns
            rest_ns = risen[3 * num // 4 :].min() - risen[num // 4 : num // 2].min()
            is_level = (least_ns, lasts_ns) == GRADUAL_RISE and abs(rest_ns) < middle_ns - before_ns
            if is_sudden or is_level:
                return self._stop_or_delay(start, (first, index, last), (before_ns, level_ns))
        return None

    def _stop_or_delay(
        self, start: int, around: tuple[int, int, int], levels_ns: tuple[float, float]
    ) -> _Rise:
        """Classify a rise: after a delay, arrivals return below the middle of the two levels."""
        first, index, last = around
        host = self._host[index:last]
        within = int(np.searchsorted(host, host[0] + RETURN_NS))
        back = np.flatnonzero(self._straight_ns[start : index + within] < sum(levels_ns) / 2)
        if len(back) >= MIN_RETURNED:
            stop = start + int(back[0])
            # What comes back to another level may have been a stop and a slew.
            back_ns = self._straight_ns[stop : stop + self._count].min() - levels_ns[0]
            return _Rise(start, stop, bool(abs(back_ns) > self._threshold_ns))
        is_at_end = last == len(self._host) and host[-1] - host[0] < END_NS
        is_delay = is_at_end and levels_ns[1] - levels_ns[0] < MAX_END_DELAY_NS
        # Less than a second of samples is too short to judge the end of the take.
        is_delay = is_delay and index - first >= self._count
        # A clock that stood has no samples between the levels; one that is slewed has.
        newest_ns = self._straight_ns[max(first, start - NUM_BETWEEN) : start].min()
        is_gradual = bool(newest_ns - levels_ns[0] > self._threshold_ns)
        return _Rise(start, last if is_delay else None, is_gradual or within == len(host))


def _runs(change: np.ndarray, threshold: float) -> list[tuple[int, int]]:
    above = np.concatenate([[False], change > threshold, [False]])
    edges = np.flatnonzero(np.diff(above.astype(np.int8)))
    return [(int(a), int(b) - 1) for a, b in edges.reshape(-1, 2)]


class _Stamps:
    """Distances of a device's stamps, to locate changes of level."""

    def __init__(self, device: np.ndarray) -> None:
        steps: Float64[np.ndarray, " m"] = np.diff(device).astype(np.float64)
        self.period_ns = float(np.median(steps))
        self._departures_ns = steps - self.period_ns
        self._tolerance_ns = MATCH_SHARE * self.period_ns
        beside_ns = self._beside_period(self._departures_ns)
        self.scatter_ns = float(np.quantile(beside_ns, REGULAR_QUANTILE))
        self.is_regular = self.scatter_ns < self._tolerance_ns / 2

    def place(self, cut: int, change_ns: float) -> int | None:
        """The first sample after the step near `cut`; None if it was only a delay."""
        reach = REACH if self.is_regular else IRREGULAR_REACH
        first, last = max(cut - reach, 1), min(cut + reach, len(self._departures_ns))
        departures_ns = self._departures_ns[first - 1 : last]
        if not self.is_regular:
            exact = int(np.argmax(np.abs(departures_ns)))
            return cut if np.abs(departures_ns[exact]) < STEP_NS / 2 else first + exact
        rest_ns = departures_ns + change_ns
        # Lost samples add whole periods to a distance, a delay adds none; what is left over of a
        # change by whole periods without any such jump is a delay.
        num_lost = np.maximum(np.rint(rest_ns / max(self.period_ns, 1.0)), 0)
        jumped = (num_lost == 0) | (self._beside_period(departures_ns) > self._tolerance_ns)
        misses_ns = np.abs(rest_ns - num_lost * self.period_ns)
        nearest = int(np.argmin(np.where(jumped, misses_ns, np.inf)))
        if jumped[nearest] and misses_ns[nearest] <= min(
            self._tolerance_ns, abs(change_ns) * MATCH_CHANGE_SHARE
        ):
            return first + nearest
        odd_ns = self._beside_period(departures_ns)
        odd = int(np.argmax(odd_ns))
        return first + odd if odd_ns[odd] > self._tolerance_ns else None

    def _beside_period(self, departures_ns: np.ndarray) -> Float64[np.ndarray, " m"]:
        """Distance of each to the nearest whole number of sample periods."""
        period_ns = max(self.period_ns, 1.0)
        return np.abs(departures_ns - period_ns * np.rint(departures_ns / period_ns))
