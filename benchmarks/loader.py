"""Benchmark stage `loader`: whether reading training windows keeps up with training."""

import argparse
from collections.abc import Callable, Mapping
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING

from benchmarks.figures import Figure, Requirement, at_least
from benchmarks.machine import describe_machine
from benchmarks.report import ResultTable, StageReport
from benchmarks.rounds import interleaved
from benchmarks.stages import Amounts, Bar
from dextouch.errors import InvalidInputError
from services.pipelines.training_data import Scope, make_training_data
from services.twin.take_options import MIXES
from services.twin.tasks import TASK_NAMES

if TYPE_CHECKING:
    from benchmarks.training_pace import TrainingPace

PACKAGES = ("numpy", "torch", "zstandard")
MIN_RATIO = 3.0
# Default of `dextouch train world-model --streaming`.
USUAL_WORKERS = 0
AMOUNTS = Amounts(
    usual={"episodes": 200, "rounds": 5, "batches": 40, "fit_windows": 256},
    quick={"episodes": 4, "rounds": 1, "batches": 2, "fit_windows": 8},
)
LEARNING = "training, windows in memory"


def add_options(parser: argparse.ArgumentParser) -> None:
    """Add the options of this stage."""
    parser.add_argument("--store", help="read this store instead of recording twin episodes")
    AMOUNTS.add_options(
        parser, episodes="twin episodes to record", rounds="rounds", batches="batches per round"
    )
    parser.add_argument(
        "--workers", default="0,1,2", metavar="A,B", help="worker processes (%(default)s)"
    )


def measure(options: argparse.Namespace, folder: Path, bar: Bar) -> StageReport:
    """Time the loader and the training step alternately.

    Raises:
        InvalidInputError: no episode, round or batch, or invalid numbers of workers.
    """
    from benchmarks.training_pace import TrainingPace

    plan, workers = AMOUNTS.of(options), _workers(options.workers)
    url = options.store or _make_episodes(folder / "episodes", plan["episodes"])
    with bar("reading the store once", 1):
        pace = TrainingPace(url, fit_windows=plan["fit_windows"])
    subjects = _subjects(pace, workers, plan["batches"])
    with bar("measuring", plan["rounds"] * len(subjects)) as step:
        found = interleaved(subjects, plan["rounds"], on_step=step)
    rates = {name: Figure.of(values) for name, values in found.items()}
    return StageReport(
        stage="loader",
        machine=describe_machine(PACKAGES),
        options={**plan, "episodes": pace.num_episodes, "batch": pace.batch, "workers": workers},
        tables=[rate_table(rates, pace.num_episodes)],
        panels=[],
        requirements=[requirement(rates)],
        data={"windows_per_s": {name: list(figure.values) for name, figure in rates.items()}},
        notes=["the episodes are in the page cache, so disk latency is not included"],
    )


def loading(num_workers: int) -> str:
    """The name of a loader in tables."""
    return f"loader, {num_workers} worker processes"


def rate_table(rates: Mapping[str, Figure], num_episodes: int) -> ResultTable:
    """Windows per second, and the ratio to the consumption of training."""
    learning = rates[LEARNING]
    rows = [(name, figure.text(), figure.over(learning).text()) for name, figure in rates.items()]
    return ResultTable(
        f"Windows a second from {num_episodes} episodes, one thread a process",
        ("", "windows/s", f"times {LEARNING}"),
        rows,
    )


def requirement(rates: Mapping[str, Figure]) -> Requirement:
    """Requirement on the loader; unmeasured if the default number of workers was not run."""
    loader = rates.get(loading(USUAL_WORKERS))
    figure = None if loader is None else loader.over(rates[LEARNING]).median
    what = f"{loading(USUAL_WORKERS)}, times what training consumes"
    return at_least(what, figure, MIN_RATIO)


def _subjects(
    pace: "TrainingPace", workers: list[int], num_batches: int
) -> dict[str, Callable[[int], float]]:
    subjects: dict[str, Callable[[int], float]] = {LEARNING: lambda _: pace.learning(num_batches)}
    for count in workers:
        subjects[loading(count)] = _ignoring_round(
            partial(pace.loading, num_batches, num_workers=count)
        )
    for count in workers:
        subjects[f"training from the disk, {count} worker processes"] = _ignoring_round(
            partial(pace.both, num_batches, num_workers=count)
        )
    return subjects


def _ignoring_round(work: Callable[[], float]) -> Callable[[int], float]:
    return lambda _: work()


def _make_episodes(folder: Path, num_episodes: int) -> str:
    tasks = TASK_NAMES[:num_episodes]
    seeds = range(-(-num_episodes // len(tasks)))
    make_training_data(str(folder), seeds, MIXES["demonstrations"], scope=Scope(tasks))
    return str(folder)


def _workers(text: str) -> list[int]:
    words = [word.strip() for word in text.split(",")]
    if not all(word.isdecimal() for word in words):
        raise InvalidInputError(f"--workers: got {text!r}, expected numbers like 0,1,2")
    return sorted({int(word) for word in words})
