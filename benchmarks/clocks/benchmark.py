"""The benchmark stage `clocks`: methods that estimate sample times, their errors and cost."""

import argparse
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path

import numpy as np
from jaxtyping import Float64, Int64

from benchmarks.clocks.scenes import (
    BASE_DELAY_NS,
    MORE_SCENES,
    SCENES,
    SLEW_SCENES,
    STAMPLESS_SCENES,
    STOP_SCENES,
    Scene,
    Take,
    simulate,
)
from benchmarks.figures import Figure, Requirement, at_least, at_most, interleaved
from benchmarks.report import ResultTable, StageReport
from benchmarks.stages import Amounts, Bar, named
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

OURS_ONLINE, OURS_OFFLINE, ARRIVALS = "ours, online", "ours, offline", "arrival stamps"
COARSE = "stamps of 1 ms"


def tables(results: Sequence[Result], stampless: Sequence[Result]) -> list[ResultTable]:
    """Errors of all methods in all scenes, streams without timestamps, steps, and costs."""
    found = [
        _error_table("RMS error in ms, constant path delay removed", results, "rms_ms"),
        _error_table("99th percentile of the error in ms", results, "p99_ms"),
        _error_table("Streams without time stamps: RMS error in ms", stampless, "rms_ms"),
        _recovery_table(results),
        _cost_table([*results, *stampless]),
    ]
    return [table for table in found if table.rows]


def requirements(results: Sequence[Result], stampless: Sequence[Result]) -> list[Requirement]:
    """Requirements on clocks, for the worst round of the worst scene."""
    seven = [result for result in results if result.scene in SCENES]
    online = [result for result in seven if result.way == OURS_ONLINE]
    offline = [result for result in seven if result.way == OURS_OFFLINE]
    stopped = [r for r in results if r.way == OURS_OFFLINE and r.scene in STOP_SCENES]
    coarse = [r for r in results if r.scene == COARSE and r.way == OURS_ONLINE]
    felt = [r.recovery_s for r in online if r.scene == "step -30 ms" and r.recovery_s]
    dated = [r for r in stampless if r.way in {COUNTED, NUMBERED}]
    lossless = [r for r in dated if r.scene != "2 % lost"]
    lossy = [r.rms_ms.median for r in dated if r.scene == "2 % lost"]
    cost = max((r.us_per_sample.median for r in online), default=None)
    return [
        at_most("online RMS, seven scenes", _worst(online, "rms_ms"), 0.3, "ms"),
        at_most("online p99, seven scenes", _worst(online, "p99_ms"), 1.0, "ms"),
        at_most("offline RMS, seven scenes", _worst(offline, "rms_ms"), 0.3, "ms"),
        at_most("offline RMS, stops", _worst(stopped, "rms_ms"), 0.3, "ms"),
        at_most("online RMS, stamps of 1 ms", _worst(coarse, "rms_ms"), 0.6, "ms"),
        at_most(
            f"after a step of -30 ms above {BOUND_MS:g} ms for",
            max((figure.high for figure in felt), default=None),
            RECOVERY_S,
            "s",
        ),
        at_least("times better than arrivals", _gain(seven), 10.0),
        at_most("online, a sample", cost, 15.0, "µs"),
        at_most("RMS without stamps, up to 0.2 % lost", _worst(lossless, "rms_ms"), 0.3, "ms"),
        at_most("RMS without stamps, 2 % lost, median", max(lossy, default=None), 0.65, "ms"),
    ]


def _gain(results: Sequence[Result]) -> float | None:
    """Minimum ratio of the arrivals' error to ours; online without scenes that have a step."""
    arrivals = {r.scene: r.rms_ms for r in results if r.way == ARRIVALS}
    quiet = {name for name, scene in SCENES.items() if not scene.step_ms}
    counted = [
        r for r in results if r.way == OURS_OFFLINE or (r.way == OURS_ONLINE and r.scene in quiet)
    ]
    return min((arrivals[r.scene].over(r.rms_ms).low for r in counted), default=None)


def _worst(results: Sequence[Result], what: str) -> float | None:
    figures: list[Figure] = [getattr(result, what) for result in results]
    return max((figure.high for figure in figures), default=None)


def _ways(results: Sequence[Result]) -> list[str]:
    """Methods in the order of measurement."""
    return list(dict.fromkeys(result.way for result in results))


def _error_table(title: str, results: Sequence[Result], what: str) -> ResultTable:
    scenes, ways = dict.fromkeys(r.scene for r in results), _ways(results)
    cells = {(r.scene, r.way): getattr(r, what).text() for r in results}
    rows = [(scene, *(cells[scene, way] for way in ways)) for scene in scenes]
    return ResultTable(title, ("scene", *ways), rows)


def _recovery_table(results: Sequence[Result]) -> ResultTable:
    rows = [
        (r.scene, f"{r.recovery_s.median:.2f}", f"{r.recovery_s.high:.2f}")
        for r in results
        if r.way == OURS_ONLINE and r.recovery_s is not None
    ]
    title = f"After a step, seconds with more than {BOUND_MS:g} ms of error (ours, online)"
    return ResultTable(title, ("scene", "median", "worst"), rows)


def _cost_table(results: Sequence[Result]) -> ResultTable:
    rows = []
    for way in _ways(results):
        medians = [r.us_per_sample.median for r in results if r.way == way]
        kind = "online" if way in ONLINE else "offline" if way in OFFLINE else "no stamps"
        rows.append((way, kind, f"{np.median(medians):.2f}", f"{max(medians):.2f}"))
    return ResultTable("Processor time, µs a sample", ("way", "", "median", "most"), rows)


AMOUNTS = Amounts(usual={"seconds": 600.0, "rounds": 5}, quick={"seconds": 60.0, "rounds": 1})
# Online errors count after the warm-up, and a step comes in the middle.
MIN_SECONDS = 2 * WARM_UP_S + 2


def add_options(parser: argparse.ArgumentParser) -> None:
    """Add the options of this stage."""
    AMOUNTS.add_options(parser, seconds="length of a take", rounds="takes per scene")
    parser.add_argument("--seed", type=int, default=0, help="seed of the first round (%(default)s)")
    names = ", ".join([*SCENES, *MORE_SCENES, *STOP_SCENES, *SLEW_SCENES]).replace("%", "%%")
    parser.add_argument("--scenes", metavar="A,B", help=f"comma-separated scenes (all: {names})")


def measure(options: argparse.Namespace, folder: Path, bar: Bar) -> StageReport:
    """Run every method on every scene."""
    plan = AMOUNTS.of(options, seconds=MIN_SECONDS)
    scenes = SCENES | MORE_SCENES | STOP_SCENES | SLEW_SCENES
    if options.scenes is not None:
        scenes = named("scene", scenes | STAMPLESS_SCENES, options.scenes)
    seconds, seeds = plan["seconds"], range(options.seed, options.seed + plan["rounds"])
    results = compare(scenes, ONLINE | OFFLINE, seconds, seeds, bar)
    stampless = compare(STAMPLESS_SCENES, STAMPLESS, seconds, seeds, bar)
    return StageReport(
        stage="clocks",
        packages=("numpy",),
        options={**plan, "seed": options.seed, "scenes": list(scenes)},
        tables=tables(results, stampless),
        requirements=requirements(results, stampless),
        data={"results": [*results, *stampless]},
        notes=[
            f"online errors exclude the first {WARM_UP_S:g} s and, in scenes with a step, 1.2 s "
            "after it; each round is a take with a different seed"
        ],
    )
