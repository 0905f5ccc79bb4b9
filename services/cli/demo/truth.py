"""True episodes of the demo, recorded in the twin: two takes, and demonstrations to predict."""

import multiprocessing
import os
from collections.abc import Callable
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass, field
from pathlib import Path

from dextouch.episodes import EpisodeStore
from services.cli.demo.settings import FIRST_HELD_OUT_SEED, TASKS, DemoPlan
from services.twin.cameras import CAMERAS
from services.twin.episodes import TakeOptions, record, write_episode
from services.twin.hands import Domain
from services.twin.settings import TwinSettings
from services.twin.stage import Stage

# The human stands a bottle, the robot stacks bowls, to cover one-handed and bimanual tasks.
RECORDED = {"human": "stand_bottle", "robot": "stack_bowls"}
MAX_PROCESSES = 4


@dataclass(frozen=True)
class Truth:
    """Ids of the true episodes: the two takes, and demonstrations to predict."""

    takes: dict[str, str] = field(default_factory=dict)
    demonstrations: tuple[str, ...] = ()


@dataclass(frozen=True)
class _Order:
    """Episodes of one twin stage, recorded by one process."""

    task: str
    domain: Domain
    seeds: tuple[int, ...]
    options: TakeOptions


def make_truth(plan: DemoPlan, store_folder: Path, progress: Callable[[int, int], None]) -> Truth:
    """Record the true episodes in the twin, on all cores.

    Args:
        plan: seeds, and errors of the demonstrations.
        store_folder: destination of the episodes.
        progress: called with the numbers of finished and of all episodes.
    """
    takes = [
        _Order(task, "human" if domain == "human" else "robot", (plan.take_seed,), TakeOptions())
        for domain, task in RECORDED.items()
    ]
    # At least two scenes, so that the actions of another one are available.
    scenes = range(FIRST_HELD_OUT_SEED, FIRST_HELD_OUT_SEED + plan.num_predicted)
    demonstrations = [
        _Order(task, "robot", tuple(scenes), TakeOptions(noise_m, images=CAMERAS[:1]))
        for noise_m in plan.predicted_noise_m
        for task in TASKS
    ]
    orders = takes + demonstrations
    made: list[list[str]] = []
    total = sum(len(order.seeds) for order in orders)
    processes = min(MAX_PROCESSES, os.cpu_count() or 1)
    # Spawned, not forked: torch and service threads must not be copied half-way.
    with ProcessPoolExecutor(processes, multiprocessing.get_context("spawn")) as pool:
        for ids in pool.map(_make, orders, [str(store_folder)] * len(orders)):
            made.append(ids)
            progress(sum(map(len, made)), total)
    predicted = tuple(episode_id for ids in made[len(takes) :] for episode_id in ids)
    return Truth(dict(zip(RECORDED, [ids[0] for ids in made], strict=False)), predicted)


def _make(order: _Order, store_folder: str) -> list[str]:
    store = EpisodeStore(store_folder)
    stage = Stage(order.task, order.domain, TwinSettings())
    return [write_episode(store, record(stage, seed, order.options)) for seed in order.seeds]
