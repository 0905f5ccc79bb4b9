"""Tables, charts and requirements of the alignment benchmark."""

from collections.abc import Mapping, Sequence

from benchmarks.alignment.compare import METHODS, OURS, STEPS, MethodResult
from benchmarks.chart import Panel, Point
from benchmarks.figures import Requirement, at_least, at_most
from benchmarks.report import ResultTable

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
