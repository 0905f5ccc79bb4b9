"""Twin episodes to train and test networks on: `dextouch train data`.

About a third of the demonstrations are exact, the others up to 25 mm wrong, and every fifth is a
miss: the same motion without its objects. Misses teach the model to look instead of guessing
contact from motion habits. With `--ladder` the seeds take errors of 0 … 40 mm in turn, so that
successes and near misses are about equally many: use it for the success probe.
"""

import argparse
import json
import multiprocessing
import os
from collections.abc import Sequence
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path

import numpy as np
from rich.progress import track

from dextouch.episodes import EpisodeStore
from dextouch.errors import InvalidInputError
from services.twin.episodes import TakeOptions, episode_id, record, write_episode
from services.twin.settings import TwinSettings
from services.twin.stage import Stage
from services.twin.tasks import TASK_NAMES

EXACT_FRACTION = 0.35
MAX_NOISE_M = 0.025
# Success is decided within about 5 mm, so the ladder is dense there.
LADDER_M = (0.0, 0.0025, 0.005, 0.0075, 0.010, 0.015, 0.020, 0.030, 0.040)
# Takes that stop do so within these steps; before the first nothing has been reached.
FIRST_FROZEN_STEP, LAST_FROZEN_STEP = 8, 69
CAMERAS = ("camera_head",)


@dataclass(frozen=True)
class Mix:
    """How the episodes of a data set differ from each other.

    `miss_fraction` have their objects elsewhere. `still_fraction` stop midway, or, half of them,
    never begin. With `ladder` the error is `LADDER_M` in turn of seeds; without it
    `exact_fraction` are exact and the others up to `MAX_NOISE_M` wrong.
    """

    miss_fraction: float = 0.2
    exact_fraction: float = EXACT_FRACTION
    still_fraction: float = 0.0
    ladder: bool = False

    def __post_init__(self) -> None:
        for name in ("miss_fraction", "exact_fraction", "still_fraction"):
            if not 0 <= getattr(self, name) <= 1:
                raise InvalidInputError(
                    f"training data: got {name} {getattr(self, name)}, expected 0 … 1"
                )


def options_of(task: str, seed: int, mix: Mix) -> TakeOptions:
    """How the episode of a task and seed is made; the same every time."""
    draw = np.random.default_rng([seed, len(task)])
    if mix.ladder:
        noise_m = LADDER_M[seed % len(LADDER_M)]
    else:
        exact = draw.random() < mix.exact_fraction
        noise_m = 0.0 if exact else float(np.round(draw.uniform(0, MAX_NOISE_M), 3))
    miss = bool(draw.random() < mix.miss_fraction)
    frozen_from_step = None
    if draw.random() < mix.still_fraction:
        midway = bool(draw.random() < 0.5)
        step = int(draw.integers(FIRST_FROZEN_STEP, LAST_FROZEN_STEP + 1))
        frozen_from_step = step if midway else 0
    return TakeOptions(noise_m, miss, CAMERAS, frozen_from_step)


@lru_cache(maxsize=4)
def _stage(task: str) -> Stage:
    return Stage(task, "robot", TwinSettings())


def _make(order: tuple[str, int, TakeOptions, str]) -> bool | None:
    task, seed, options, url = order
    store = EpisodeStore(url)
    if store.exists(episode_id(task, "robot", seed, options)):
        return None
    episode = record(_stage(task), seed, options)
    write_episode(store, episode)
    return bool(episode.attributes.success)


def make_training_data(
    store: str, seeds: range, mix: Mix, *, num_jobs: int | None = None
) -> dict[str, int]:
    """Record one episode a task and seed; what the store has already is kept.

    Returns:
        How many episodes were `made`, `kept`, and how many of those made `succeeded`.

    Raises:
        InvalidInputError: no seeds.
    """
    if len(seeds) == 0:
        raise InvalidInputError(f"training data: got seeds {seeds}, expected at least one")
    orders = [
        (task, seed, options_of(task, seed, mix), store) for seed in seeds for task in TASK_NAMES
    ]
    processes = num_jobs or os.cpu_count() or 1
    # Spawned, not forked: threads and locks of the caller must not be copied half-way.
    with ProcessPoolExecutor(processes, multiprocessing.get_context("spawn")) as pool:
        answers = list(
            track(pool.map(_make, orders), total=len(orders), description="twin episodes")
        )
    made = [answer for answer in answers if answer is not None]
    return {"made": len(made), "kept": len(answers) - len(made), "succeeded": sum(made)}


def main(argv: Sequence[str]) -> int:
    """`dextouch train data`."""
    parser = argparse.ArgumentParser(prog="dextouch train data", description=__doc__)
    parser.add_argument("--store", required=True, help="folder of the episode store")
    parser.add_argument("--first", type=int, default=0, help="first seed (%(default)s)")
    parser.add_argument("--count", type=int, default=130, help="seeds a task (%(default)s)")
    parser.add_argument("--miss-fraction", type=float, default=0.2, help="(%(default)s)")
    errors = parser.add_mutually_exclusive_group()
    errors.add_argument("--exact", action="store_true", help="no errors at all")
    errors.add_argument("--ladder", action="store_true", help="errors of 0 … 40 mm in turn")
    parser.add_argument(
        "--still-fraction", type=float, default=0.0, help="stop midway or never begin (%(default)s)"
    )
    parser.add_argument("--jobs", type=int, help="processes (one a core)")
    parser.add_argument("--json", type=Path, help="write the counts here")
    arguments = parser.parse_args(list(argv))
    seeds = range(arguments.first, arguments.first + max(0, arguments.count))
    mix = Mix(
        arguments.miss_fraction,
        1.0 if arguments.exact else EXACT_FRACTION,
        arguments.still_fraction,
        arguments.ladder,
    )
    counts = make_training_data(arguments.store, seeds, mix, num_jobs=arguments.jobs)
    print(", ".join(f"{count} {name}" for name, count in counts.items()))
    if arguments.json:
        arguments.json.write_text(json.dumps(counts, indent=2), encoding="utf-8")
    return 0
