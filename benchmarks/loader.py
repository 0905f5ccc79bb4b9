"""Benchmark stage `loader`: whether reading training windows keeps up with training."""

import argparse
import time
from collections.abc import Callable, Generator, Iterable, Mapping
from contextlib import closing
from functools import partial
from itertools import islice
from pathlib import Path

import torch

from benchmarks.figures import Figure, Requirement, at_least, every_round, interleaved
from benchmarks.report import ResultTable, StageReport
from benchmarks.stages import Amounts, Bar
from dextouch.errors import InvalidInputError
from services.pipelines.training_data import Scope, make_training_data
from services.twin.take_options import MIXES
from services.twin.tasks import TASK_NAMES
from services.world_model.paper_settings import TrainSettings
from services.world_model.training.joint_dataset import WindowBatch, index_episodes, read_batches
from services.world_model.training.joint_trainer import TrainingRun

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
    """Time the loader and the training step alternately."""
    plan, workers = AMOUNTS.of(options), _workers(options.workers)
    url = options.store or _make_episodes(folder / "episodes", plan["episodes"])
    with bar("reading the store once", 1):
        pace = TrainingPace(url, fit_windows=plan["fit_windows"])
    batches = plan["batches"]
    subjects = {LEARNING: every_round(partial(pace.learning, batches))}
    for name_of, measured in ((loading, pace.loading), (training, pace.both)):
        for count in workers:
            subjects[name_of(count)] = every_round(partial(measured, batches, num_workers=count))
    with bar("measuring", plan["rounds"] * len(subjects)) as step:
        found = interleaved(subjects, plan["rounds"], on_step=step)
    rates = {name: Figure.of(values) for name, values in found.items()}
    return StageReport(
        stage="loader",
        packages=("numpy", "torch", "zstandard"),
        options={**plan, "episodes": pace.num_episodes, "batch": pace.batch, "workers": workers},
        tables=[rate_table(rates, pace.num_episodes)],
        requirements=[requirement(rates)],
        data={"windows_per_s": rates},
        notes=["the episodes are in the page cache, so disk latency is not included"],
    )


def loading(num_workers: int) -> str:
    """The name of a loader in tables."""
    return f"loader, {num_workers} worker processes"


def training(num_workers: int) -> str:
    """The name of training from a loader in tables."""
    return f"training from the disk, {num_workers} worker processes"


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


class TrainingPace:
    """Windows per second of the loader and the training step, separately and together.

    All measurements use the same network, the same sampling of windows and one thread, and exclude
    one-time work: codecs are fitted on `fit_windows` and worker processes started beforehand.
    """

    def __init__(self, url: str, *, fit_windows: int = 256) -> None:
        torch.set_num_threads(1)
        plain = TrainSettings(episodes=url, streaming=True, loader_workers=0)
        windows = plain.windows.model_copy(update={"fit_windows": fit_windows})
        settings = plain.model_copy(update={"windows": windows})
        self._episodes = index_episodes(url)
        self.num_episodes, self.batch = len(self._episodes), settings.optimizer.batch
        self._run = TrainingRun(self._episodes, settings)
        self._run.fit_codecs()
        self._run.model.train()

    def loading(self, num_batches: int, *, num_workers: int) -> float:
        """Windows per second of the loader alone."""
        with closing(self._batches(num_workers)) as batches:
            return self._rate(batches, num_batches, lambda _: None)

    def learning(self, num_batches: int) -> float:
        """Windows per second of training on windows in memory."""
        ready = list(islice(self._batches(0), num_batches))
        return self._rate(ready, num_batches, self._run.learn)

    def both(self, num_batches: int, *, num_workers: int) -> float:
        """Windows per second of training on windows read from disk."""
        with closing(self._batches(num_workers)) as batches:
            return self._rate(batches, num_batches, self._run.learn)

    def _batches(self, num_workers: int) -> Generator[WindowBatch, None, None]:
        batches = read_batches(self._episodes, self._run.places(), num_workers=num_workers)
        # Skip what was read ahead while the processes started: two batches each.
        for _ in islice(batches, 2 * num_workers + 1):
            pass
        return batches

    def _rate(
        self,
        batches: Iterable[WindowBatch],
        num_batches: int,
        use: Callable[[WindowBatch], object],
    ) -> float:
        start_s = time.perf_counter()
        for batch in islice(batches, num_batches):
            use(batch)
        return num_batches * self.batch / (time.perf_counter() - start_s)


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
