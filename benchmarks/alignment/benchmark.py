"""The benchmark stage `alignment`: its measurements, tables and requirements."""

import argparse
from collections.abc import Mapping, Sequence
from pathlib import Path

from benchmarks.alignment.compare import METHODS, OURS, STEPS, MethodResult, compare, record
from benchmarks.chart import Panel, Point
from benchmarks.figures import Requirement, at_least, at_most
from benchmarks.report import ResultTable, StageReport
from benchmarks.stages import Amounts, Bar
from dextouch.errors import InvalidInputError
from services.alignment.retargeting.hand_retargeter import warm_up

Results = Mapping[str, MethodResult]
MIN_SPEED = 5.0
# Bounds of `tests/accuracy/test_alignment.py`.
BOUNDS = {
    "scatter of times, worst stream (ms)": 1.0,
    "time of samples, worst stream (ms)": 1.0,
    "wrists (mm)": 1.0,
    "wrists (deg)": 0.1,
    "fingertips (mm)": 2.5,
    "pressure, mean (kPa)": 0.05,
    "contact, 1 - IoU": 0.02,
}
CHARTS = {
    "Wrists": "wrists (mm)",
    "Fingertips": "fingertips (mm)",
    "Time of samples": "time of samples, worst stream (ms)",
}


def tables(takes: Sequence[Results]) -> list[ResultTable]:
    """Times and errors of each take."""
    return [table for results in takes for table in (_times(results), _errors(results))]


def _times(results: Results) -> ResultTable:
    found = [results[name] for name in METHODS]
    rows = [(step, *(one.steps_s[step].text() for one in found)) for step in STEPS]
    rows += [
        ("alignment (all but the storing)", *(one.alignment_s.text() for one in found)),
        ("alignment, wall time", *(one.wall_s.text() for one in found)),
        ("all, times real time", *(one.speed.text() for one in found)),
    ]
    title = f"Take of {found[0].take_s:g} s: processor seconds by step"
    return ResultTable(title, ("", *METHODS), rows)


def _errors(results: Results) -> ResultTable:
    found = [results[name].errors for name in METHODS]
    rows = [(what, *(f"{errors[what]:.3g}" for errors in found)) for what in found[0]]
    take_s = results[OURS].take_s
    return ResultTable(f"Take of {take_s:g} s: errors against ground truth", ("", *METHODS), rows)


def panels(results: Results) -> list[Panel]:
    """Time against error of one take, by kind of error."""
    return [
        Panel(
            f"{title}, take of {results[OURS].take_s:g} s",
            "processor seconds of the alignment",
            what,
            [
                Point.of(name, one.alignment_s, one.errors[what], is_ours=name == OURS)
                for name, one in results.items()
            ],
        )
        for title, what in CHARTS.items()
    ]


def requirements(results: Results) -> list[Requirement]:
    """Requirements on speed and errors of the alignment service, on one take."""
    ours = results[OURS]
    speed = at_least(
        "stored and aligned, times real time of one core", ours.speed.median, MIN_SPEED
    )
    errors = [at_most(what, ours.errors[what], BOUNDS[what]) for what in BOUNDS]
    return [speed, *errors]


QUICK_SECONDS, USUAL_SECONDS = "3", "10,60"
AMOUNTS = Amounts(usual={"rounds": 5}, quick={"rounds": 1})
# Shorter takes have no stretch of 17 steps.
MIN_SECONDS = 2.0


def add_options(parser: argparse.ArgumentParser) -> None:
    """Add the options of this stage."""
    parser.add_argument(
        "--seconds",
        metavar="A,B",
        help=f"lengths of the takes ({USUAL_SECONDS}; quick {QUICK_SECONDS})",
    )
    AMOUNTS.add_options(parser, rounds="rounds a take")
    parser.add_argument("--seed", type=int, default=0, help="random seed (%(default)s)")


def measure(options: argparse.Namespace, folder: Path, bar: Bar) -> StageReport:
    """Record takes, then align each alternately with every method."""
    lengths_s = _lengths_s(options)
    num_rounds = AMOUNTS.of(options)["rounds"]
    takes = []
    with bar("recording", len(lengths_s)) as step:
        for seconds in lengths_s:
            step(f"{seconds:g} s")
            takes.append(record(seconds, options.seed, folder / f"take_{seconds:g}s"))
    warm_up()
    results = [compare(take, num_rounds, folder, bar=bar) for take in takes]
    longest = results[-1]
    return StageReport(
        stage="alignment",
        packages=("numpy", "numba", "scipy", "zstandard"),
        options={"seconds": lengths_s, "rounds": num_rounds, "seed": options.seed},
        tables=tables(results),
        panels=panels(longest),
        requirements=requirements(longest),
        data={"takes": results},
        notes=[
            "processor time of all threads, so multiples of real time refer to one core; clock "
            "fits are timed separately after the alignment and subtracted from the calibration",
            "gloves are calibrated with a take under known pressures and by time requests, other "
            "path delays have errors of 0.2 ms (sigma); the transfer over HTTP is not included",
        ],
    )


def _lengths_s(options: argparse.Namespace) -> list[float]:
    text = options.seconds or (QUICK_SECONDS if options.quick else USUAL_SECONDS)
    words = [word.strip() for word in text.split(",")]
    try:
        lengths_s = sorted({float(word) for word in words})
    except ValueError:
        lengths_s = []
    if not lengths_s or not MIN_SECONDS <= lengths_s[0] <= lengths_s[-1] < float("inf"):
        raise InvalidInputError(
            f"--seconds: got {text!r}, expected lengths of at least {MIN_SECONDS:g} s, like 10,60"
        )
    return lengths_s
