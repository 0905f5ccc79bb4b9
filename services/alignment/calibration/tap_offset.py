"""Time offset between a glove and a tracker, estimated from taps on a table.

The fallback where no motion is common to two streams: the hand taps a hard table. The glove's
pressure starts between two samples; the tracker's height falls on a line and stops: a hinge, whose
bend is the touch. The second difference would show the bend too early, so the hinge is fitted.
"""

import numpy as np

from services.alignment.calibration.motion import DegenerateMotionError
from services.alignment.calibration.time_offset import TimeOffset, checked_signal

# The fall before and the rest after a touch that are fitted.
BEFORE_S, AFTER_S = 0.15, 0.15
SEARCH_STEP_S = 0.001
MIN_FALL_M_PER_S = 0.05
MIN_REST_S = 0.5
TOUCH_KPA = 2.0
MAX_OFFSET_S = 0.2


def estimate_tap_offset(
    t_pressure_ns: np.ndarray,
    pressure_kpa: np.ndarray,
    t_height_ns: np.ndarray,
    height_m: np.ndarray,
) -> TimeOffset:
    """Estimate the offset between pressure and height from taps at least 0.5 s apart.

    Args:
        t_pressure_ns: stamps [n], int64, strictly increasing.
        pressure_kpa: the tapping pad's pressure [n]; below 2 kPa in the air.
        t_height_ns: stamps [m] of the tracker.
        height_m: height [m] above the table, of a point of the hand.

    Returns:
        The offset to add to the tracker's timestamps to align them with the glove's.

    Raises:
        DegenerateMotionError: no tap, or none that falls briskly onto the table.
        InvalidInputError: stamps out of order.
        ShapeError, NonFiniteError: values that do not fit or hold NaN.
    """
    start_ns = int(t_pressure_ns[0])
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


def _onsets(t_s: np.ndarray, pressure_kpa: np.ndarray) -> tuple[list[float], float]:
    """Midpoints of the sample intervals in which touches begin, and the usual interval."""
    touching = pressure_kpa > TOUCH_KPA
    starts = np.flatnonzero(touching[1:] & ~touching[:-1]) + 1
    onsets: list[float] = []
    for start in starts.tolist():
        onset = float(t_s[start] + t_s[start - 1]) / 2
        if not onsets or onset - onsets[-1] >= MIN_REST_S:
            onsets.append(onset)
    return onsets, float(np.median(np.diff(t_s)))


def _bend_s(t_s: np.ndarray, height: np.ndarray, onset_s: float) -> float | None:
    """Time at which a fall near a touch stops; None without a fall."""
    bends = np.arange(onset_s - MAX_OFFSET_S, onset_s + MAX_OFFSET_S, SEARCH_STEP_S)
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
