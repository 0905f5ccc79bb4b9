"""Scripted demonstrators succeed without noise and fail with much of it."""

import sys

import pytest

from services.twin.episodes import TakeOptions, record
from services.twin.settings import TwinSettings
from services.twin.stage import Stage
from services.twin.tasks import TASK_NAMES

SEEDS = range(100, 104)
LADDER_M = (0.0, 0.05)


@pytest.mark.parametrize("task", TASK_NAMES)
@pytest.mark.parametrize("domain", ["robot", pytest.param("human", marks=pytest.mark.slow)])
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
