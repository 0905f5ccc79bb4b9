"""Time offset between two streams, from common motion or from taps on a table."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float64
from scipy.interpolate import CubicSpline
from scipy.signal import butter, sosfiltfilt

from dextouch.errors import InvalidInputError, NonFiniteError, ShapeError
from services.alignment.calibration.motion import DegenerateMotionError

CUTOFF_HZ = 8.0
MAX_OFFSET_S = 1.0
MIN_OVERLAP_S = 2.0
MIN_CORRELATION = 0.5
# Another offset that correlates nearly as well makes a periodic motion useless.
AMBIGUOUS_RATIO = 0.97
MAX_SIGMA_S = 0.02
MAX_ITERATIONS = 20
# The fit's own sigma comes out too small by up to two (measured against truth).
SIGMA_FACTOR = 2.0
# The fall before and the rest after a touch that are fitted.
BEFORE_S, AFTER_S = 0.15, 0.15
SEARCH_STEP_S = 0.001
MIN_FALL_M_PER_S = 0.05
MIN_REST_S = 0.5
TOUCH_KPA = 2.0
MAX_TAP_OFFSET_S = 0.2


@dataclass(frozen=True)
class TimeOffset:
    """Add `offset_ns` to the timestamps of stream b to align it with stream a."""

    offset_ns: int
    sigma_ns: int


def estimate_time_offset(
    t_a_ns: np.ndarray, signal_a: np.ndarray, t_b_ns: np.ndarray, signal_b: np.ndarray
) -> TimeOffset:
    """Estimate the offset between two streams that measured the same motion.

    Stamps [n] and [m] are int64, strictly increasing; signals are [n] or [n, k]: angular speed, or
    k components in common axes (better). That of b may have another unit and zero.

    Raises:
        DegenerateMotionError: no motion, too slow, too periodic, or not the same one.
        InvalidInputError: stamps out of order, or less than two seconds in common.
        ShapeError, NonFiniteError: signals that do not fit or hold NaN.
    """
    t_a, a = checked_signal("time offset: stream a", t_a_ns, signal_a, t_a_ns[:1])
    t_b, b = checked_signal("time offset: stream b", t_b_ns, signal_b, t_a_ns[:1])
    for name, t_s in (("a", t_a), ("b", t_b)):
        if t_s[-1] - t_s[0] < MIN_OVERLAP_S:
            raise InvalidInputError(
                f"time offset: stream {name} lasts {t_s[-1] - t_s[0]:.2f} s, expected "
                f"{MIN_OVERLAP_S}"
            )
    if a.shape[1] != b.shape[1]:
        raise ShapeError(f"time offset: got {a.shape[1]} and {b.shape[1]} components")
    step_s = 0.5 * min(usual_period_s(t_a), usual_period_s(t_b))
    grid_a, smooth_a = low_passed(t_a, a, step_s)
    grid_b, smooth_b = low_passed(t_b, b, step_s)
    spline_b = CubicSpline(grid_b, smooth_b)
    coarse_s = _coarse(grid_a, smooth_a, grid_b, smooth_b, step_s)
    offset_s, sigma_s = _refined(grid_a, smooth_a, spline_b, coarse_s)
    if abs(offset_s - coarse_s) > 0.1 or sigma_s > MAX_SIGMA_S:
        raise DegenerateMotionError(
            f"time offset: known only to {sigma_s * 1e3:.1f} ms, expected at most "
            f"{MAX_SIGMA_S * 1e3:.0f}; shake more briskly, about all axes, for ten seconds"
        )
    return TimeOffset(round(offset_s * 1e9), max(1, round(sigma_s * 1e9)))


def estimate_tap_offset(
    t_pressure_ns: np.ndarray,
    pressure_kpa: np.ndarray,
    t_height_ns: np.ndarray,
    height_m: np.ndarray,
) -> TimeOffset:
    """Offset to be added to a tracker's stamps to align it with a glove, from taps on a table.

    Stamps [n] and [m] are int64, strictly increasing. The tapping pad's pressure [n] is below 2 kPa
    in the air, the height [m] (m) that of a point of the hand above the table; taps are at least
    0.5 s apart. Raises DegenerateMotionError: no tap, or none that falls briskly onto the table;
    InvalidInputError: stamps out of order; ShapeError, NonFiniteError: values that do not fit, or
    NaN.
    """
    start_ns = t_pressure_ns[:1]
    pressure, height = np.asarray(pressure_kpa)[..., None], np.asarray(height_m)[..., None]
    t_a, pressure = checked_signal("tap offset: pressure", t_pressure_ns, pressure, start_ns)
    t_b, height = checked_signal("tap offset: height", t_height_ns, height, start_ns)
    onsets_s, interval_s = _onsets(t_a, pressure[:, 0])
    pairs = [(onset, _bend_s(t_b, height[:, 0], onset)) for onset in onsets_s]
    offsets_s = np.array([onset - bend for onset, bend in pairs if bend is not None])
    if not len(offsets_s):
        raise DegenerateMotionError(
            f"tap offset: {len(onsets_s)} touches, none of which stops a fall of at least "
            f"{MIN_FALL_M_PER_S:g} m/s; tap a hard table briskly, half a second apart"
        )
    # A touch lies anywhere between two samples of the glove: of such the mean says most, once what
    # lies farther off (a slip, another object) is out.
    offsets_s = offsets_s[np.abs(offsets_s - np.median(offsets_s)) <= interval_s]
    least_s = interval_s / np.sqrt(12)
    spread_s = max(float(offsets_s.std()), least_s)
    # Taps at the glove's own rhythm share their place between samples: never below a half.
    sigma_s = max(spread_s / np.sqrt(len(offsets_s)), least_s / 2)
    return TimeOffset(round(float(offsets_s.mean()) * 1e9), max(1, round(sigma_s * 1e9)))


def checked_signal(
    what: str, t_ns: np.ndarray, signal: np.ndarray, reference_ns: np.ndarray
) -> tuple[Float64[np.ndarray, " n"], Float64[np.ndarray, "n k"]]:
    """Seconds after a reference, and values [n, k]; refuses NaN and stamps that go back."""
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
        raise InvalidInputError(
            f"{what}: got {len(t_ns)} stamps, expected at least two that increase; record it again"
        )
    return (t_ns - reference_ns) * 1e-9, values


def usual_period_s(t_s: Float64[np.ndarray, " n"]) -> float:
    """The median period; of samples that come in bursts, half of the mean one."""
    return max(float(np.median(np.diff(t_s))), float(t_s[-1] - t_s[0]) / 2 / (len(t_s) - 1))


def low_passed(
    t_s: np.ndarray, values: np.ndarray, step_s: float
) -> tuple[Float64[np.ndarray, " n"], Float64[np.ndarray, "n k"]]:
    """The signal on a uniform grid, low-pass filtered without phase."""
    num = int((t_s[-1] - t_s[0]) / step_s) + 1
    grid = t_s[0] + step_s * np.arange(num)
    uniform = np.stack([np.interp(grid, t_s, column) for column in values.T], axis=1)
    cutoff_hz = min(CUTOFF_HZ, 0.4 / usual_period_s(t_s))
    sections = butter(2, cutoff_hz, fs=1 / step_s, output="sos")
    return grid, np.asarray(sosfiltfilt(sections, uniform, axis=0))


def _coarse(
    grid_a: np.ndarray, a: np.ndarray, grid_b: np.ndarray, b: np.ndarray, step_s: float
) -> float:
    """The offset of highest correlation on the grid, if it is the only high one."""
    num = round(MAX_OFFSET_S / step_s)
    offsets = step_s * np.arange(-num, num + 1)
    scores = np.array([_correlation(grid_a, a, grid_b + offset, b) for offset in offsets])
    best = int(np.argmax(scores))
    if not scores[best] >= MIN_CORRELATION:
        raise DegenerateMotionError(
            f"time offset: the streams correlate by {scores[best]:.2f} at best, expected "
            f"{MIN_CORRELATION}; both must see the same brisk motion within {MAX_OFFSET_S:g} s"
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
    other = np.stack([np.interp(t_a[inside], t_b, column) for column in b.T], axis=1)
    mine, other = _centred(a[inside]), _centred(other)
    power = float((mine**2).sum() * (other**2).sum())
    return float((mine * other).sum() / np.sqrt(power)) if power > 0 else -1.0


def _refined(
    grid_a: np.ndarray, a: np.ndarray, spline_b: CubicSpline, start_s: float
) -> tuple[float, float]:
    """Gauss–Newton on the offset; gain and offset of every component are eliminated."""
    slope_b, spacing_s = spline_b.derivative(), float(grid_a[1] - grid_a[0])
    # Low-passed noise is correlated: only 2 · cutoff numbers a second are independent.
    per_number = max(1.0, 1 / (2 * CUTOFF_HZ * spacing_s))
    offset_s, sigma_s = start_s, np.inf
    for _ in range(MAX_ITERATIONS):
        t_b = grid_a - offset_s
        inside = (t_b >= spline_b.x[0]) & (t_b <= spline_b.x[-1])
        mine, other = _centred(a[inside]), _centred(spline_b(t_b[inside]))
        power = np.maximum((other**2).sum(axis=0), np.finfo(np.float64).tiny)
        gain = (mine * other).sum(axis=0) / power
        residual = mine - gain * other
        # Moving b later by d changes it by -slope · d; what gain and zero absorb is taken out.
        moved = _centred(-gain * slope_b(t_b[inside]))
        moved -= (moved * other).sum(axis=0) / power * other
        normal = float((moved**2).sum())
        if normal <= 0:
            return offset_s, np.inf
        step_s = float((moved * residual).sum()) / normal
        offset_s += step_s
        variance = float((residual**2).sum()) / max(1, inside.sum() * a.shape[1] - 3)
        sigma_s = SIGMA_FACTOR * float(np.sqrt(variance * per_number / normal))
        if abs(step_s) < 1e-7:
            break
    return offset_s, sigma_s


def _centred(values: np.ndarray) -> Float64[np.ndarray, "n k"]:
    return values - values.mean(axis=0)


def _onsets(t_s: np.ndarray, pressure_kpa: np.ndarray) -> tuple[list[float], float]:
    """Midpoints of the sample intervals in which touches begin, and the usual interval."""
    touching = pressure_kpa > TOUCH_KPA
    starts = np.flatnonzero(touching[1:] & ~touching[:-1]) + 1
    onsets: list[float] = []
    for onset in ((t_s[starts] + t_s[starts - 1]) / 2).tolist():
        if not onsets or onset - onsets[-1] >= MIN_REST_S:
            onsets.append(onset)
    return onsets, float(np.median(np.diff(t_s)))


def _bend_s(t_s: np.ndarray, height: np.ndarray, onset_s: float) -> float | None:
    """Time at which a fall near a touch stops; None without a fall."""
    bends = np.arange(onset_s - MAX_TAP_OFFSET_S, onset_s + MAX_TAP_OFFSET_S, SEARCH_STEP_S)
    best, found = np.inf, None
    for bend in bends.tolist():
        near = (t_s >= bend - BEFORE_S) & (t_s <= bend + AFTER_S)
        t_near = t_s[near]
        if t_near.size < 8 or t_near[0] > bend - BEFORE_S / 2 or t_near[-1] < bend + AFTER_S / 2:
            continue
        fall = np.minimum(t_near - bend, 0.0)
        design = np.stack([fall, np.ones(t_near.size)], axis=1)
        (speed, level), *_ = np.linalg.lstsq(design, height[near], rcond=None)
        rest = float(np.mean((height[near] - design @ np.array([speed, level])) ** 2))
        if speed <= -MIN_FALL_M_PER_S and rest / speed**2 < best:
            best, found = rest / speed**2, bend
    return found
