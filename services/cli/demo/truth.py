"""True episodes of the demo, recorded in the twin: two takes, and demonstrations to predict."""

import os
from dataclasses import dataclass
from pathlib import Path

from dextouch.errors import InvalidInputError
from services.cli.demo.settings import FIRST_HELD_OUT_SEED, TASKS, DemoPlan
from services.cli.training_data import Order, record_all
from services.evaluation.progress import Progress
from services.twin.cameras import CAMERAS
from services.twin.hands import Domain
from services.twin.take_options import TakeOptions

# The human stands a bottle, the robot stacks bowls, to cover one-handed and bimanual tasks.
RECORDED: dict[Domain, str] = {"human": "stand_bottle", "robot": "stack_bowls"}
MAX_PROCESSES = 4


@dataclass(frozen=True)
class Truth:
    """Ids of the true episodes: the two takes, and demonstrations to predict."""

    takes: dict[Domain, str]
    demonstrations: tuple[str, ...]


def make_truth(plan: DemoPlan, store_folder: Path) -> Truth:
    """Record the true episodes in the twin, on all cores.

    Args:
        plan: seeds, and errors of the demonstrations.
        store_folder: destination of the episodes.

    Raises:
        InvalidInputError: the physics diverged.
    """
    store = str(store_folder)
    takes = {
        domain: Order(task, domain, plan.take_seed, TakeOptions(), store)
        for domain, task in RECORDED.items()
    }
    # At least two scenes, so that the actions of another one are available.
    scenes = range(FIRST_HELD_OUT_SEED, FIRST_HELD_OUT_SEED + plan.num_predicted)
    demonstrations = [
        Order(task, "robot", seed, TakeOptions(noise_m, images=CAMERAS[:1]), store)
        for noise_m in plan.predicted_noise_m
        for task in TASKS
        for seed in scenes
    ]
    orders = [*takes.values(), *demonstrations]
    with Progress("episodes", len(orders)) as progress:
        for answer in record_all(orders, min(MAX_PROCESSES, os.cpu_count() or 1)):
            if answer.refusal is not None:
                raise InvalidInputError(f"{answer.episode_id}: {answer.refusal}")
            progress.advance()
    return Truth(
        {domain: order.episode_id for domain, order in takes.items()},
        tuple(order.episode_id for order in demonstrations),
    )
