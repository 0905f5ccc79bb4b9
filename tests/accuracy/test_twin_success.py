"""Scripted demonstrators succeed without noise and fail with much of it."""

import sys
from functools import cache
from itertools import product

import pytest

from services.twin.demonstrators import NUM_GRID_STEPS
from services.twin.episodes import TakeOptions, record
from services.twin.settings import TwinSettings
from services.twin.stage import Stage, command_row
from services.twin.tasks import TASK_NAMES

# Of every task; shares of many scenes are measured by the slow ladder below.
SEEDS = range(100, 102)
DEFAULT_TASKS = ("stand_bottle", "stack_bowls", "insert_peg")
LADDER_M = (0.0, 0.05)
# Scenes and errors of the figures in docs/twin_tasks.md.
FIRST_SEED = 40_000
NUM_SCENES_EXACT, NUM_SCENES = 40, {"robot": 16, "human": 8}
FINE_LADDER_MM = (0, 2.5, 5, 7.5, 10, 15, 20, 30, 40)
LEAST_EXACT = 0.9

cached_stage = cache(Stage)


def cells():
    """Tasks that the unit tests demonstrate, well and badly, are recorded by the slow run only."""
    for task, domain in product(TASK_NAMES, ("robot", "human")):
        marks = [] if domain == "robot" and task in DEFAULT_TASKS else [pytest.mark.slow]
        yield pytest.param(task, domain, marks=marks, id=f"{domain}-{task}")


@pytest.mark.long
@pytest.mark.parametrize(("task", "domain"), list(cells()))
def test_success_falls_with_noise(task, domain, capsys):
    stage = Stage(task, domain, TwinSettings())
    rates = []
    for noise_m in LADDER_M:
        takes = [record(stage, seed, TakeOptions(noise_m, images=())) for seed in SEEDS]
        rates.append(sum(bool(take.attributes.success) for take in takes) / len(takes))
    with capsys.disabled():
        steps = ", ".join(
            f"{n * 1000:.0f} mm {r:.2f}" for n, r in zip(LADDER_M, rates, strict=True)
        )
        sys.stdout.write(f"\n{task} {domain}: success at noise {steps}\n")
    assert rates[0] >= 0.75
    assert rates[-1] <= 0.5


def demonstration_succeeds(stage, seed, noise_m):
    plan = stage.plan(seed, noise_m=noise_m)
    stage.start(plan)
    for row in range(1, NUM_GRID_STEPS):
        for _ in stage.simulation.advance(command_row(plan.commands, row)):
            pass
    return stage.task.succeeded(stage.simulation)


@pytest.mark.slow
@pytest.mark.parametrize("noise_mm", FINE_LADDER_MM)
@pytest.mark.parametrize("domain", ["robot", "human"])
@pytest.mark.parametrize("task", TASK_NAMES)
def test_the_fine_ladder(task, domain, noise_mm, capsys):
    stage = cached_stage(task, domain, TwinSettings())
    num_scenes = NUM_SCENES[domain] if noise_mm else NUM_SCENES_EXACT
    seeds = range(FIRST_SEED, FIRST_SEED + num_scenes)
    won = sum(demonstration_succeeds(stage, seed, 0.001 * noise_mm) for seed in seeds)
    with capsys.disabled():
        sys.stdout.write(f"\n{task} {domain}: error {noise_mm} mm, success {won} of {num_scenes}")
        sys.stdout.flush()
    if noise_mm == 0:
        assert won >= LEAST_EXACT * num_scenes
    if noise_mm == FINE_LADDER_MM[-1]:
        assert won <= 0.5 * num_scenes
