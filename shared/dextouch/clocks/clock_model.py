"""Clock model that maps device time to host time, fitted offline, with clock steps."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float64, Int64

from dextouch.clocks.lower_hull import Line, LowerHull
from dextouch.clocks.steps import find_steps, find_wrong_stamps
from dextouch.errors import ClockFitError, InvalidInputError

MIN_SAMPLES = 10
# Minimum number of samples of a second (or longer) for the lateness.
MIN_PROMPT_SAMPLES = 10
PROMPT_S = 1.0
LATE_QUANTILE = 0.9
# A straight line fits a minute of crystal drift; longer takes get a piecewise linear model.
WINDOW_S = 60.0
# Below this many samples or seconds a segment's own slope is mostly noise.
MIN_SLOPE_SAMPLES = 50
MIN_SLOPE_SPAN_S = 1.0
# Next to a gap a line may rest on two late samples; it then deviates from its neighbours by more.
MAX_DRIFT_NS_PER_S = 1e6
SILENCE_S = 1.0
NEIGHBOURS = 2


@dataclass(frozen=True)
class ClockSegment:
    """Part of a take in which the device's clock ran without a step.

    host = device + reference_offset_ns + (piecewise linear through knots of the offset), where
    knots are in seconds of device time after `start_device_ns`, extrapolated linearly. It covers
    arrivals from `start_host_ns` on, except the first `num_tied` with that exact stamp.
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
        residual_rms_ns: RMS of arrival minus fitted time: queueing on the path, not the error of
            the fit (which is far smaller).
        lateness_ns: minimum of arrival minus fitted time within a second (90 % quantile over all
            seconds), excluding detected delays. Near zero for a good fit, even on paths with
            queueing, bursts and stalls.
        has_unsure_stops: whether a stop of the device's clock may have been a delay, or a delay at
            the end of the take a stop.
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
        """Host times of device times [n], on the host's clock at the smallest path delay.

        Args:
            t_device_ns: unwrapped device stamps, int64.
            t_host_ns: arrival of each, needed only if the device's clock went back, to select the
                segment. No sample is dated after its arrival.

        Raises:
            InvalidInputError: the device's clock went back and no arrivals are given.
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

    Args:
        t_device_ns: unwrapped device stamps [n], in order of arrival. Steps and restarts of the
            device's clock are detected, and segments fitted separately.
        t_host_ns: arrivals [n] on the host's monotonic clock.

    Raises:
        ClockFitError: `details["cause"]` is "too_few" (below 10 samples), "not_finite" (no
            integers), "not_increasing" (arrivals go back, or device stamps go back more often than
            clock steps explain) or "length" (unequal lengths).
    """
    device, host = _checked(t_device_ns, t_host_ns)
    right = np.delete(np.arange(len(device)), find_wrong_stamps(device))
    device, host = device[right], host[right]
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
    """Minimum of arrival minus fitted time within a second, 90 % quantile over all seconds.

    Queueing, bursts and stalls let some samples through promptly; only with a wrong fit or a
    lasting delay are all of them late.

    Args:
        residual_ns: arrival minus fitted time of every sample.
        host: their arrivals, in order; a slow stream's seconds are ten periods long.
    """
    if len(host) < MIN_PROMPT_SAMPLES:
        return 0.0
    second_ns = max(PROMPT_S * 1e9, MIN_PROMPT_SAMPLES * float(np.median(np.diff(host))))
    starts = np.unique((host - host[0]) // round(second_ns), return_index=True)[1]
    promptest_ns = np.minimum.reduceat(residual_ns, starts)
    is_full = np.diff(starts, append=len(host)) >= MIN_PROMPT_SAMPLES // 2
    return float(np.quantile(promptest_ns[is_full], LATE_QUANTILE)) if is_full.any() else 0.0


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
    """Fit one segment to a subset of its samples that includes its first and last one."""
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
