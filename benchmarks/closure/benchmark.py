"""The benchmark stage `closure`: human takes of the twin, replayed by its robot hand."""

import argparse
from collections.abc import Mapping, Sequence
from dataclasses import astuple
from pathlib import Path
from statistics import mean

from benchmarks.closure.contact_times import timing_errors
from benchmarks.closure.methods import METHODS, OURS, Method
from benchmarks.closure.replay import TASKS, ClosureTake, close_take
from benchmarks.figures import at_least
from benchmarks.report import ResultTable, StageReport
from benchmarks.stages import Amounts, Bar

FIRST_SEED = 100
AMOUNTS = Amounts(usual={"takes": 20}, quick={"takes": 1})
MIN_SUCCESS = 0.8
QUICK_METHODS = (METHODS[0], OURS)

Played = Mapping[tuple[str, Method], Sequence[ClosureTake]]


def add_options(parser: argparse.ArgumentParser) -> None:
    """The options of this stage."""
    AMOUNTS.add_options(parser, takes="human takes per task")
    parser.add_argument(
        "--tasks", default=",".join(TASKS), metavar="A,B", help="tasks of the twin (%(default)s)"
    )


def measure(options: argparse.Namespace, folder: Path, bar: Bar) -> StageReport:
    """Record human takes and replay each of them by every method."""
    num_takes = AMOUNTS.of(options)["takes"]
    tasks = options.tasks.split(",")
    methods = QUICK_METHODS if options.quick else METHODS
    played: dict[tuple[str, Method], list[ClosureTake]] = {
        (task, method): [] for task in tasks for method in methods
    }
    with bar("replaying", len(played) * num_takes) as step:
        for task in tasks:
            for seed in range(FIRST_SEED, FIRST_SEED + num_takes):
                for take in close_take(task, seed, methods, step):
                    played[task, take.method].append(take)
    return StageReport(
        stage="closure",
        packages=("numpy", "mujoco", "numba"),
        options={"takes": num_takes, "tasks": tasks},
        tables=[_table(played, num_takes)],
        requirements=[
            at_least(f"{task}: success of {OURS.name}", _rate(played[task, OURS]), MIN_SUCCESS)
            for task in tasks
        ],
        data={
            "succeeded": {
                f"{task}: {method.name}": [take.succeeded for take in takes]
                for (task, method), takes in played.items()
            }
        },
    )


def _table(played: Played, num_takes: int) -> ResultTable:
    rows = []
    for (task, method), takes in played.items():
        errors = timing_errors([(take.human_contact, take.contact) for take in takes])
        *late_ms, missing, extra = astuple(errors)
        means = map(_mean_ms, late_ms)
        name, rate = f"{task}: {method.name}", f"{_rate(takes):.2f}"
        rows.append((name, rate, *means, str(missing), str(extra)))
    return ResultTable(
        f"Replays of {num_takes} human takes a task; contact times against the human's in ms",
        ("", "success", "hand first", "hand last", "pad first", "pad last", "missing", "extra"),
        rows,
    )


def _rate(takes: Sequence[ClosureTake]) -> float:
    return mean(float(take.succeeded) for take in takes)


def _mean_ms(values: Sequence[float]) -> str:
    return f"{mean(abs(value) for value in values):.0f}" if values else "-"
