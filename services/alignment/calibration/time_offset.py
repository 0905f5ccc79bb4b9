"""Time offset between two streams that measure the same motion.

Both signals are low-passed without phase, correlated coarsely over all allowed offsets, and then
fitted: b's cubic spline, moved by the offset, scaled and shifted, is brought onto a by
Gauss–Newton. The offset's sigma comes from the fit; brisk motion makes it small, a high
correlation alone does not.
"""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float64
from scipy.interpolate import CubicSpline
from scipy.signal import butter, sosfiltfilt

from dextouch.errors import InvalidInputError, NonFiniteError, ShapeError
from services.alignment.calibration.motion import DegenerateMotionError

CUTOFF_HZ = 8.0
MIN_OVERLAP_S = 2.0
MIN_CORRELATION = 0.5
# Another offset that correlates nearly as well makes a periodic motion useless.
AMBIGUOUS_RATIO = 0.97
MAX_SIGMA_S = 0.02
MAX_ITERATIONS = 20
# The fit's own sigma comes out too small by up to two (measured against truth).
SIGMA_FACTOR = 2.0


@dataclass(frozen=True)
class TimeOffset:
    """Add `offset_ns` to the timestamps of stream b to align it with stream a."""

    offset_ns: int
    sigma_ns: int


def estimate_time_offset(
    t_a_ns: np.ndarray,
    signal_a: np.ndarray,
    t_b_ns: np.ndarray,
    signal_b: np.ndarray,
    *,
    max_offset_s: float = 1.0,
) -> TimeOffset:
    """Estimate the offset between two streams that measured the same motion.

    Args:
        t_a_ns: stamps [n] of stream a, int64, strictly increasing.
        signal_a: [n] or [n, k]: angular speed, or k components in common axes (better).
        t_b_ns: stamps [m] of stream b.
        signal_b: [m] or [m, k]; may have another unit and zero than a.
        max_offset_s: largest offset to search.

    Raises:
        DegenerateMotionError: no motion, too slow, too periodic, or not the same one.
        InvalidInputError: stamps out of order, or less than two seconds in common.
        ShapeError, NonFiniteError: signals that do not fit or hold NaN.
    """
    t_a, a = checked_signal("time offset: stream a", t_a_ns, signal_a, int(t_a_ns[0]))
    t_b, b = checked_signal("time offset: stream b", t_b_ns, signal_b, int(t_a_ns[0]))
    for name, t_s in (("a", t_a), ("b", t_b)):
        if t_s[-1] - t_s[0] < MIN_OVERLAP_S:
            raise InvalidInputError(
                f"time offset: stream {name} lasts {t_s[-1] - t_s[0]:.2f} s, expected "
                f"{MIN_OVERLAP_S}"
            )
    if a.shape[1] != b.shape[1]:
        raise ShapeError(f"time offset: got {a.shape[1]} and {b.shape[1]} components")
    step_s = 0.5 * min(float(np.median(np.diff(t_a))), float(np.median(np.diff(t_b))))
    grid_a, smooth_a = _low_passed(t_a, a, step_s)
    grid_b, smooth_b = _low_passed(t_b, b, step_s)
    spline_b = CubicSpline(grid_b, smooth_b)
    coarse_s = _coarse(grid_a, smooth_a, (grid_b, smooth_b), step_s, max_offset_s)
    offset_s, sigma_s = _refined(grid_a, smooth_a, spline_b, coarse_s)
    if abs(offset_s - coarse_s) > 0.1 or sigma_s > MAX_SIGMA_S:
        raise DegenerateMotionError(
            f"time offset: known only to {sigma_s * 1e3:.1f} ms, expected at most "
            f"{MAX_SIGMA_S * 1e3:.0f}; shake more briskly, about all axes, for ten seconds"
        )
    return TimeOffset(round(offset_s * 1e9), max(1, round(sigma_s * 1e9)))


def checked_signal(
    what: str, t_ns: np.ndarray, signal: np.ndarray, reference_ns: int
) -> tuple[Float64[np.ndarray, " n"], Float64[np.ndarray, "n k"]]:
    """Times of a signal in seconds after a reference, and its values [n] or [n, k] as [n, k].

    Raises:
        InvalidInputError: fewer than two stamps, or stamps out of order.
        ShapeError, NonFiniteError: values that do not fit or hold NaN.
    """
    t_ns, values = np.asarray(t_ns, dtype=np.int64), np.asarray(signal, dtype=np.float64)
    values = values[:, None] if values.ndim == 1 else values
    if values.ndim != 2 or t_ns.shape != values.shape[:1]:
        raise ShapeError(
            f"{what} has {t_ns.shape} stamps and {values.shape} values, expected [n] and [n] or "
            "[n, k]"
        )
    if not np.isfinite(values).all():
        raise NonFiniteError(f"{what} holds NaN or infinity")
    if len(t_ns) < 2 or (np.diff(t_ns) <= 0).any():
        raise InvalidInputError(f"{what}: stamps do not increase")
    return (t_ns - reference_ns) * 1e-9, values


def _low_passed(
    t_s: np.ndarray, values: np.ndarray, step_s: float
) -> tuple[Float64[np.ndarray, " n"], Float64[np.ndarray, "n k"]]:
    """The signal on a uniform grid, low-pass filtered without phase."""
    num = int((t_s[-1] - t_s[0]) / step_s) + 1
    grid = t_s[0] + step_s * np.arange(num)
    uniform = np.stack([np.interp(grid, t_s, column) for column in values.T], axis=1)
    rate_hz = float(1 / np.median(np.diff(t_s)))
    cutoff_hz = min(CUTOFF_HZ, 0.4 * rate_hz)
    sections = butter(2, cutoff_hz, fs=1 / step_s, output="sos")
    return grid, np.asarray(sosfiltfilt(sections, uniform, axis=0))


def _coarse(
    grid_a: np.ndarray,
    a: np.ndarray,
    stream_b: tuple[np.ndarray, np.ndarray],
    step_s: float,
    max_offset_s: float,
) -> float:
    """The offset of highest correlation on the grid, if it is the only high one."""
    grid_b, b = stream_b
    num = round(max_offset_s / step_s)
    offsets = step_s * np.arange(-num, num + 1)
    scores = np.array([_correlation(grid_a, a, grid_b + offset, b) for offset in offsets])
    best = int(np.argmax(scores))
    if not scores[best] >= MIN_CORRELATION:
        raise DegenerateMotionError(
            f"time offset: the streams correlate by {scores[best]:.2f} at best, expected "
            f"{MIN_CORRELATION}; both must see the same brisk motion within {max_offset_s:g} s"
        )
    inner = scores[1:-1]
    peaks = 1 + np.flatnonzero((inner > scores[:-2]) & (inner >= scores[2:]))
    rivals = [p for p in peaks if p != best and scores[p] > AMBIGUOUS_RATIO * scores[best]]
    if rivals:
        raise DegenerateMotionError(
            f"time offset: {offsets[best] * 1e3:.0f} and {offsets[rivals[0]] * 1e3:.0f} ms fit "
            "alike since the motion repeats itself; move irregularly"
        )
    return float(offsets[best])


def _correlation(t_a: np.ndarray, a: np.ndarray, t_b: np.ndarray, b: np.ndarray) -> float:
    """Correlation over the common time, all components together; -1 without enough of it."""
    first, last = max(t_a[0], t_b[0]), min(t_a[-1], t_b[-1])
    if last - first < MIN_OVERLAP_S:
        return -1.0
    inside = (t_a >= first) & (t_a <= last)
    mine = a[inside] - a[inside].mean(axis=0)
    other = np.stack([np.interp(t_a[inside], t_b, column) for column in b.T], axis=1)
    other = other - other.mean(axis=0)
    power = float((mine**2).sum() * (other**2).sum())
    return float((mine * other).sum() / np.sqrt(power)) if power > 0 else -1.0


def _refined(
    grid_a: np.ndarray, a: np.ndarray, spline_b: CubicSpline, start_s: float
) -> tuple[float, float]:
    """Gauss–Newton on the offset; gain and offset of every component are eliminated."""
    slope_b = spline_b.derivative()
    offset_s, sigma_s = start_s, np.inf
    for _ in range(MAX_ITERATIONS):
        t_b = grid_a - offset_s
        inside = (t_b >= spline_b.x[0]) & (t_b <= spline_b.x[-1])
        gradient = normal = squares = 0.0
        for column in range(a.shape[1]):
            mine = a[inside, column]
            design = np.stack([spline_b(t_b[inside])[:, column], np.ones(len(mine))], axis=1)
            gain, *_ = np.linalg.lstsq(design, mine, rcond=None)
            residual = mine - design @ gain
            # Moving b later by d changes it by -slope · d; what gain and zero absorb is taken out.
            moved = -gain[0] * slope_b(t_b[inside])[:, column]
            moved -= design @ np.linalg.lstsq(design, moved, rcond=None)[0]
            gradient += float(moved @ residual)
            normal += float(moved @ moved)
            squares += float(residual @ residual)
        if normal <= 0:
            return offset_s, np.inf
        step_s = gradient / normal
        offset_s += step_s
        # Low-passed noise is correlated: only 2 · cutoff numbers a second are independent.
        spacing_s = float(grid_a[1] - grid_a[0])
        per_number = max(1.0, 1 / (2 * CUTOFF_HZ * spacing_s))
        variance = squares / max(1, inside.sum() * a.shape[1] - 3)
        sigma_s = SIGMA_FACTOR * float(np.sqrt(variance * per_number / normal))
        if abs(step_s) < 1e-7:
            break
    return offset_s, sigma_s
