"""Methods that estimate sample times, ours and others: errors and processor time by scene."""

import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import partial

import numpy as np
from jaxtyping import Float64, Int64

from benchmarks.clocks.scenes import BASE_DELAY_NS, Scene, Take, simulate
from benchmarks.figures import Figure, interleaved
from benchmarks.stages import Bar
from dextouch.clocks import OnlineClock, corrected_stamps, date_by_counting, fit_clock
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


# Warm-up time of causal fits.
WARM_UP_S = 10.0
# Time after a clock step that is excluded for online fits.
RECOVERY_S = 1.2
BOUND_MS = 0.3


@dataclass(frozen=True)
class Score:
    """Errors of one take, after subtraction of the constant path delay.

    `recovery_s` is the time after the clock's step until the error falls below 0.3 ms (RMS over
    half a second); None in scenes without a step.
    """

    rms_ms: float
    p99_ms: float
    recovery_s: float | None = None


def score(estimate_ns: np.ndarray, take: Take, *, is_online: bool) -> Score:
    """Compare with the true times; online fits are not scored in the warm-up and after a step."""
    error_ms = (estimate_ns - take.true_ns - BASE_DELAY_NS) * 1e-6
    age_s = (take.true_ns - take.true_ns[0]) * 1e-9
    counts = np.ones(len(take), dtype=bool)
    recovery_s = None
    if is_online:
        counts &= age_s > WARM_UP_S
    if is_online and take.step_true_ns is not None:
        since_s = (take.true_ns - take.step_true_ns) * 1e-9
        counts &= (since_s < 0) | (since_s > RECOVERY_S)
        recovery_s = _recovery_s(error_ms, since_s)
    kept = np.abs(error_ms[counts])
    return Score(float(np.sqrt(np.mean(kept**2))), float(np.percentile(kept, 99)), recovery_s)


def _recovery_s(
    error_ms: Float64[np.ndarray, " n"], since_s: Float64[np.ndarray, " n"], *, run_s: float = 0.5
) -> float:
    """Start of the last half second above the bound, relative to the step."""
    after = since_s >= 0
    since_s, squares = since_s[after], error_ms[after] ** 2
    sums = np.concatenate([[0.0], np.cumsum(squares)])
    stops = np.searchsorted(since_s, since_s + run_s)
    means = (sums[stops] - sums[:-1]) / (stops - np.arange(len(squares)))
    # Limited to a minute after the step, to isolate its effect.
    bad = np.flatnonzero((means > BOUND_MS**2) & (since_s < 10.0))
    return float(since_s[min(bad[-1] + 1, len(since_s) - 1)]) if len(bad) else 0.0


Way = Callable[[Take], np.ndarray]
COUNTED, NUMBERED = "counted", "numbered"


@dataclass(frozen=True)
class Result:
    """One method in one scene: score and cost of every round (each with its own seed)."""

    scene: str
    way: str
    scores: tuple[Score, ...]
    us_per_sample: Figure

    @property
    def rms_ms(self) -> Figure:
        """Root mean square errors of the rounds."""
        return Figure.of([found.rms_ms for found in self.scores])

    @property
    def p99_ms(self) -> Figure:
        """99th percentiles of the rounds."""
        return Figure.of([found.p99_ms for found in self.scores])

    @property
    def recovery_s(self) -> Figure | None:
        """Recovery time after a step; None in scenes without one."""
        times = [found.recovery_s for found in self.scores if found.recovery_s is not None]
        return Figure.of(times) if times else None


def compare(
    scenes: Mapping[str, Scene], ways: Mapping[str, Way], seconds: float, seeds: range, bar: Bar
) -> list[Result]:
    """Run all methods alternately in every scene, on a take for each seed."""
    results = []
    with bar("dating", len(scenes) * len(ways) * len(seeds)) as step:
        for scene_name, scene in scenes.items():
            takes = [simulate(scene, seconds=seconds, seed=seed) for seed in seeds]
            subjects = {name: partial(_measure, name, way, takes) for name, way in ways.items()}
            for name, found in interleaved(subjects, len(seeds), on_step=step).items():
                scores = tuple(scored for scored, _ in found)
                results.append(Result(scene_name, name, scores, Figure.of([us for _, us in found])))
    return results


def _measure(name: str, way: Way, takes: list[Take], index: int) -> tuple[Score, float]:
    take = takes[index]
    began_ns = time.thread_time_ns()
    estimate_ns = way(take)
    spent_ns = time.thread_time_ns() - began_ns
    scored = score(estimate_ns, take, is_online=name not in OFFLINE)
    # Copying arrivals takes less time than the clock can resolve.
    return scored, max(spent_ns, 1) / 1e3 / len(take)


def _counted(take: Take) -> np.ndarray:
    period_ns = descriptor(take.scene).period_ns()
    return np.asarray(date_by_counting(take.t_host_ns, period_ns=period_ns).t_host_ns)


def _numbered(take: Take) -> np.ndarray:
    clock = OnlineClock(descriptor(take.scene, has_time=False))
    pairs = zip(take.t_host_ns.tolist(), (take.sequence % 2**16).tolist(), strict=True)
    return np.array([clock.update(t_host_ns=host, sequence=number) for host, number in pairs])


# For streams with sequence numbers only or without any counter.
STAMPLESS: dict[str, Way] = {
    COUNTED: _counted,
    NUMBERED: _numbered,
    "arrival stamps": ONLINE["arrival stamps"],
}
