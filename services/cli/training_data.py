"""A range of seeds in; the mixed twin episodes that all networks are trained on, in a store, out.

About a third of the demonstrations are exact, the others up to 25 mm wrong, and every fifth is a
miss: the same motion without its objects. Misses teach the model to look instead of guessing
contact from motion habits.
"""

import argparse
import json
import multiprocessing
import os
from collections.abc import Sequence
from concurrent.futures import ProcessPoolExecutor
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
CAMERAS = ("camera_head",)


def options_of(
    task: str, seed: int, *, miss_fraction: float, exact_fraction: float = EXACT_FRACTION
) -> TakeOptions:
    """How the episode of a task and seed is made; the same every time."""
    draw = np.random.default_rng([seed, len(task)])
    exact = draw.random() < exact_fraction
    noise_m = 0.0 if exact else float(np.round(draw.uniform(0, MAX_NOISE_M), 3))
    return TakeOptions(noise_m, bool(draw.random() < miss_fraction), CAMERAS)


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
    store: str,
    seeds: range,
    *,
    miss_fraction: float,
    exact_fraction: float = EXACT_FRACTION,
    num_jobs: int | None = None,
) -> dict[str, int]:
    """Record one episode a task and seed; what the store has already is kept.

    Returns:
        How many episodes were `made`, `kept`, and how many of those made `succeeded`.

    Raises:
        InvalidInputError: no seeds, or a fraction outside 0 … 1.
    """
    if len(seeds) == 0 or not 0 <= miss_fraction <= 1:
        raise InvalidInputError(
            f"training data: got seeds {seeds} and miss fraction {miss_fraction}, expected at "
            "least one seed and 0 … 1"
        )
    mix = {"miss_fraction": miss_fraction, "exact_fraction": exact_fraction}
    orders = [
        (task, seed, options_of(task, seed, **mix), store) for seed in seeds for task in TASK_NAMES
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
    parser.add_argument("--exact", action="store_true", help="no noise at all")
    parser.add_argument("--jobs", type=int, help="processes (one a core)")
    parser.add_argument("--json", type=Path, help="write the counts here")
    arguments = parser.parse_args(list(argv))
    seeds = range(arguments.first, arguments.first + max(0, arguments.count))
    counts = make_training_data(
        arguments.store,
        seeds,
        miss_fraction=arguments.miss_fraction,
        exact_fraction=1.0 if arguments.exact else EXACT_FRACTION,
        num_jobs=arguments.jobs,
    )
    print(", ".join(f"{count} {name}" for name, count in counts.items()))
    if arguments.json:
        arguments.json.write_text(json.dumps(counts, indent=2), encoding="utf-8")
    return 0
