"""The benchmark stage `clocks`: its measurements, tables and requirements."""

import argparse
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from benchmarks.chart import Panel, Point
from benchmarks.clocks.compare import (
    BOUND_MS,
    COUNTED,
    NUMBERED,
    OFFLINE,
    ONLINE,
    RECOVERY_S,
    STAMPLESS,
    WARM_UP_S,
    Result,
    compare,
)
from benchmarks.clocks.scenes import MORE_SCENES, SCENES, SLEW_SCENES, STAMPLESS_SCENES, STOP_SCENES
from benchmarks.figures import Figure, Requirement, at_least, at_most
from benchmarks.report import ResultTable, StageReport
from benchmarks.stages import Amounts, Bar, named

OURS_ONLINE, OURS_OFFLINE, ARRIVALS = "ours, online", "ours, offline", "arrival stamps"
COARSE = "stamps of 1 ms"
_TINY_US = 1e-3


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


def panels(results: Sequence[Result]) -> list[Panel]:
    """Cost against error: without steps, and with them."""
    quiet = {name for name, scene in SCENES.items() if not scene.step_ms}
    return [
        Panel(
            title,
            "µs a sample (median of the scenes)",
            "RMS error (ms, worst scene)",
            _points([result for result in results if result.scene in scenes]),
        )
        for title, scenes in (
            ("No step of the device's clock", quiet),
            ("With a step", set(SCENES) - quiet),
        )
    ]


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


def _points(results: Sequence[Result]) -> list[Point]:
    points = []
    for way in _ways(results):
        mine = [result for result in results if result.way == way]
        times = Figure.of([max(result.us_per_sample.median, _TINY_US) for result in mine])
        error = max(result.rms_ms.median for result in mine)
        is_ours = way in {OURS_ONLINE, OURS_OFFLINE}
        points.append(Point.of(f"{way}: {error:.2g} ms", times, error, is_ours=is_ours))
    return points


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
        panels=panels(results),
        requirements=requirements(results, stampless),
        data={"results": [*results, *stampless]},
        notes=[
            f"online errors exclude the first {WARM_UP_S:g} s and, in scenes with a step, 1.2 s "
            "after it; each round is a take with a different seed"
        ],
    )
