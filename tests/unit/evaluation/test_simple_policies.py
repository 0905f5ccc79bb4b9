"""Hold and replay: what they send, and what they refuse."""

import numpy as np
import pytest

from dextouch.clients import Policy, PolicyStart
from dextouch.errors import InvalidInputError, NonFiniteError, NotFoundError
from services.evaluation.policies.open_loop import HoldPolicy, ReplayPolicy
from tests.unit.evaluation import toy


def observation(step: int, hand: float = 0.0):
    world = toy.ToyWorld("judge", judge=True)
    return world._observe(np.zeros(2), np.full((1, 2), hand), step)


def start(seed: int = 0) -> PolicyStart:
    return PolicyStart("reach", "", seed, toy.ANCHOR, toy.K_HEAD)


def test_hold_keeps_the_first_pose():
    policy = HoldPolicy()
    assert isinstance(policy, Policy)
    policy.reset(start())
    first = policy.act(observation(0, hand=0.01))
    second = policy.act(observation(16, hand=0.07))
    assert first.shape == (16, 67)
    np.testing.assert_array_equal(first, second)
    np.testing.assert_array_equal(first[0], toy.action(np.array([0.01, 0.01])))
    policy.reset(start())
    assert policy.act(observation(0, hand=0.07))[0, 0] == 0.07


def test_replay_plays_the_episode_and_then_stays():
    item = toy.demonstration("reach", 4)
    policy = toy.replay([item])
    assert isinstance(policy, Policy)
    policy.reset(start(4))
    sent = np.concatenate([policy.act(observation(step)) for step in range(0, 80, 16)])
    np.testing.assert_array_equal(sent, item.commanded[1:])
    np.testing.assert_array_equal(policy.act(observation(80)), np.tile(item.commanded[-1], (16, 1)))


def test_replay_needs_its_episode():
    policy = toy.replay([toy.demonstration("reach", 4)])
    with pytest.raises(NotFoundError, match="seed 5"):
        policy.reset(start(5))
    with pytest.raises(InvalidInputError, match="before reset"):
        policy.act(observation(0))


def test_replay_refuses_broken_actions():
    with pytest.raises(NonFiniteError, match="seed 3"):
        ReplayPolicy({("reach", 3): np.full((16, 67), np.nan)})
