"""The optimizer loop, against AdamW and averages by hand and limits of a known clock."""

import math

import numpy as np
import pytest
import torch
from torch import nn

from dextouch.errors import NonFiniteError
from services.networks import optimizer
from services.networks.optimizer import (
    Budget,
    OptimizerLoop,
    OptimizerOptions,
    floored_cosine,
    half_cosine,
    update_average,
)


@pytest.fixture
def clock(monkeypatch):
    """Seconds of CPU time, which tests move."""
    now = [100.0]
    monkeypatch.setattr(optimizer.time, "process_time", lambda: now[0])
    return now


def one_weight(value=1.0):
    network = nn.Linear(1, 1, bias=False)
    nn.init.constant_(network.weight, value)
    return network


def test_steps_are_those_of_adamw_by_hand():
    network = one_weight()
    options = OptimizerOptions(0.1, 0.01, max_gradient_norm=0.5, warmup_steps=4)
    loop = OptimizerLoop(network, options, Budget(max_steps=6))
    losses = list(loop.run(lambda: network.weight[0, 0] ** 3))
    # Loshchilov and Hutter 2019, algorithm 2, with betas 0.9 and 0.999.
    weight, mean, square = 1.0, 0.0, 0.0
    for step in range(6):
        assert losses[step] == pytest.approx(weight**3, rel=1e-5)
        gradient = 3 * weight**2
        gradient *= min(1.0, 0.5 / gradient)
        rate = 0.1 * min(1.0, (step + 1) / 4) * 0.5 * (1 + math.cos(math.pi * step / 6))
        mean, square = 0.9 * mean + 0.1 * gradient, 0.999 * square + 0.001 * gradient**2
        ahead = (mean / (1 - 0.9 ** (step + 1)), square / (1 - 0.999 ** (step + 1)))
        weight -= rate * (ahead[0] / (math.sqrt(ahead[1]) + 1e-8) + 0.01 * weight)
    assert network.weight.item() == pytest.approx(weight, rel=1e-5)


def test_a_run_ends_with_the_tighter_limit(clock):
    def run(budget):
        network = one_weight()
        loop = OptimizerLoop(network, OptimizerOptions(0.1, 0.0), budget)
        shares = []
        for _ in loop.run(lambda: network.weight.square().sum()):
            shares.append(budget.share())
            clock[0] += 2.0
        return shares

    # Time is noted at the end of a step: 0, 2, 4, … seconds.
    assert run(Budget(5.0)) == [0.0, 0.4, 0.8, 1.2]
    assert run(Budget(1e9, 4)) == [0.25, 0.5, 0.75, 1.0]
    assert run(Budget(max_steps=2)) == [0.5, 1.0]


def test_a_run_is_as_complete_as_the_tighter_limit_says(clock):
    budget = Budget(10.0, 4)
    # 1 of 10 s and 1 of 4 steps; then 8 of 10 s and 2 of 4 steps.
    for seconds, share in ((1.0, 0.25), (7.0, 0.8)):
        clock[0] += seconds
        budget.advance()
        assert budget.share() == share


def test_wall_time_ends_a_run_and_the_learning_rate_may_follow_the_steps(clock, monkeypatch):
    wall = [100.0]
    monkeypatch.setattr(optimizer.time, "monotonic", lambda: wall[0])
    budgets = [Budget(10.0, 4, 20.0, paced_by_steps=by_steps) for by_steps in (False, True)]
    timed = Budget(10.0, None, 20.0, paced_by_steps=True)
    clock[0] += 1.0
    wall[0] += 8.0
    for budget in (*budgets, timed):
        budget.advance()
    assert [one.share() for one in (*budgets, timed)] == [0.4, 0.4, 0.4]
    assert [one.schedule_share() for one in (*budgets, timed)] == [0.4, 0.25, 0.4]
    assert (timed.step, timed.cpu_s, timed.wall_s) == (1, 1.0, 8.0)
    with timed.paused():
        wall[0] += 50.0
    timed.advance()
    assert timed.wall_s == 8.0


def test_paused_time_does_not_count_and_a_resumed_run_goes_on(clock):
    budget = Budget(10.0)
    clock[0] += 1.0
    with budget.paused():
        clock[0] += 50.0
    budget.advance()
    assert (budget.step, budget.cpu_s) == (1, 1.0)
    clock[0] += 7.0
    budget.start()
    clock[0] += 2.0
    budget.advance()
    assert (budget.step, budget.cpu_s, budget.share()) == (2, 3.0, 0.3)


def test_gradients_that_are_no_numbers_move_no_weight():
    network = one_weight()
    loop = OptimizerLoop(network, OptimizerOptions(0.1, 0.1), Budget(max_steps=3))
    loss = (network.weight * math.inf).sum()
    torch.autograd.backward(loss)
    with pytest.raises(NonFiniteError, match=r"step 0 of Linear .*loss inf, touch 2"):
        loop.step(loss=loss, touch=torch.tensor(2.0))
    assert network.weight.item() == 1.0


def test_a_schedule_falls_from_one_to_its_least():
    assert [half_cosine(share) for share in (0.0, 0.5, 1.0, 2.0)] == pytest.approx([1, 0.5, 0, 0])
    assert [floored_cosine(share) for share in (0.5, 1.0)] == pytest.approx([0.5, 0.01])
    options = OptimizerOptions(0.2, 0.0, warmup_steps=10, schedule=lambda _: 0.5)
    assert [options.rate(step, 0.0) for step in (0, 4, 9, 50)] == pytest.approx(
        [0.01, 0.05, 0.1, 0.1]
    )


def test_an_average_begins_with_a_short_memory():
    network, averaged = one_weight(1.0), one_weight(0.0)
    expected = 0.0
    for count in range(5):
        update_average(averaged.parameters(), network.parameters(), decay=0.3, num_updates=count)
        expected += (1 - min(0.3, (1 + count) / (10 + count))) * (1.0 - expected)
        np.testing.assert_allclose(averaged.weight.item(), expected, rtol=1e-6)
