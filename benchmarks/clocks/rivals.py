"""Methods that estimate sample times: ours, and others such as regression and block minima."""

import numpy as np
from jaxtyping import Float64, Int64

from benchmarks.clocks.scenes import Scene, Take
from dextouch.clocks import OnlineClock, corrected_stamps, fit_clock
from dextouch.streams import ClockCapabilities, StreamDescriptor

# Half-life of the forgetting regression.
HALF_TIME_S = 90.0
BLOCK_S = 1.0
LINE_BLOCKS = 60
# Blocks whose minimum is this many spreads above the line are congested.
OUTLIER_SPREADS = 3.0


def descriptor(scene: Scene, *, has_time: bool = True) -> StreamDescriptor:
    """Stream descriptor of a glove in this scene: 16-bit sequence, 32-bit ticks."""
    return StreamDescriptor(
        name="glove",
        kind="tactile",
        shape=(360,),
        dtype="uint16",
        unit="counts",
        nominal_rate_hz=scene.rate_hz,
        capabilities=ClockCapabilities(
            sequence=True,
            sequence_bits=16,
            device_time=has_time,
            device_time_bits=32 if scene.tick_ns > 1 else 64,
            tick_ns=scene.tick_ns,
        ),
    )


def ours_online(take: Take) -> Int64[np.ndarray, " n"]:
    """`OnlineClock`, sample by sample."""
    clock = OnlineClock(descriptor(take.scene))
    pairs = zip(take.t_host_ns.tolist(), take.t_device_ns.tolist(), strict=True)
    return np.array([clock.update(t_host_ns=host, t_device_ns=device) for host, device in pairs])


def ours_offline(take: Take) -> Int64[np.ndarray, " n"]:
    """`corrected_stamps` and `fit_clock` on the whole take."""
    stamps_ns = corrected_stamps(take.t_device_ns, take.t_host_ns)
    times_ns = fit_clock(stamps_ns, take.t_host_ns).to_host_ns(stamps_ns, take.t_host_ns)
    return times_ns + half_tick_ns(take.scene)


def arrivals(take: Take) -> Int64[np.ndarray, " n"]:
    """Unmodified arrival times."""
    return take.t_host_ns.copy()


def least_squares(take: Take) -> Int64[np.ndarray, " n"]:
    """Linear regression over the whole take."""
    x_s, y_ns = _points(take)
    slope, level = np.polyfit(x_s, y_ns, 1)
    return _times(take, slope * x_s + level)


def smoothed_offset(take: Take) -> Int64[np.ndarray, " n"]:
    """Recursive least squares with forgetting, sample by sample, as streaming layers smooth."""
    x_s, y_ns = _points(take)
    keep = 0.5 ** (1.0 / (HALF_TIME_S * take.scene.rate_hz))
    level = slope = 0.0
    # Covariance of (level, slope), symmetric; wide open at first.
    p00, p01, p11 = 1e10, 0.0, 1e10
    offsets = []
    for x, y in zip(x_s.tolist(), y_ns.tolist(), strict=True):
        gain0, gain1 = p00 + p01 * x, p01 + p11 * x
        scale = 1.0 / (keep + gain0 + gain1 * x)
        surprise = y - level - slope * x
        level += gain0 * scale * surprise
        slope += gain1 * scale * surprise
        p00 = (p00 - gain0 * gain0 * scale) / keep
        p01 = (p01 - gain0 * gain1 * scale) / keep
        p11 = (p11 - gain1 * gain1 * scale) / keep
        offsets.append(level + slope * x)
    return _times(take, np.array(offsets))


def block_minima(take: Take) -> Int64[np.ndarray, " n"]:
    """Robust line through the per-second minima of the last minute, sample by sample."""
    x_s, y_ns = _points(take)
    minima: list[tuple[float, float]] = []
    slope, level = 0.0, float(y_ns[0])
    stop_s, least = x_s[0] + BLOCK_S, (x_s[0], y_ns[0])
    offsets = []
    for x, y in zip(x_s.tolist(), y_ns.tolist(), strict=True):
        # A clock that decreases also ends a block.
        if not stop_s - BLOCK_S <= x < stop_s:
            minima = [*minima[1 - LINE_BLOCKS :], least]
            slope, level = _robust_line(np.array(minima))
            stop_s, least = x + BLOCK_S, (x, y)
        if y < least[1]:
            least = (x, y)
        offsets.append(slope * x + level)
    return _times(take, np.array(offsets), below=True)


ONLINE = {
    "ours, online": ours_online,
    "arrival stamps": arrivals,
    "smoothed offset": smoothed_offset,
    "1 s minima + line": block_minima,
}
OFFLINE = {"ours, offline": ours_offline, "least squares": least_squares}


def _points(take: Take) -> tuple[Float64[np.ndarray, " n"], Float64[np.ndarray, " n"]]:
    """Device times in s and apparent offsets in ns, both from zero."""
    device_ns, host_ns = take.t_device_ns, take.t_host_ns
    x_s = (device_ns - device_ns[0]) * 1e-9
    return x_s, (host_ns - device_ns - (host_ns[0] - device_ns[0])).astype(np.float64)


def half_tick_ns(scene: Scene) -> int:
    """Half a tick, the mean truncation of timestamps, which fits to minimum delays must add."""
    return scene.tick_ns // 2


def _times(take: Take, offset_ns: np.ndarray, *, below: bool = False) -> Int64[np.ndarray, " n"]:
    reference_ns = take.t_host_ns[0] - take.t_device_ns[0]
    # Regressions through all arrivals include the half tick already.
    reference_ns += half_tick_ns(take.scene) if below else 0
    return take.t_device_ns + reference_ns + np.rint(offset_ns).astype(np.int64)


def _robust_line(points: Float64[np.ndarray, "n 2"]) -> tuple[float, float]:
    """Slope and offset, excluding outliers of a first fit."""
    x, y = points.T
    if len(x) < 3:
        return 0.0, float(y.min())
    for _ in range(2):
        slope, level = np.polyfit(x, y, 1)
        rest = y - slope * x - level
        near = np.abs(rest - np.median(rest)) <= OUTLIER_SPREADS * max(rest.std(), 1.0)
        x, y = x[near], y[near]
    return float(slope), float(level)
