"""The gymnasium environment: gymnasium's own checker, matched seeds, ends and truncation."""

import numpy as np
import pytest
from gymnasium.utils.env_checker import check_env

from dextouch.clients import RolloutClient
from dextouch.clients.gym_env import WorldEnv
from dextouch.errors import InvalidInputError, UnknownNameError
from dextouch.worlds import CopyFirstWorld, WorldServiceSettings, create_world_app
from tests.unit.worlds.fakes import K_HEAD, SumWorld, actions, anchor, observation
from tests.unit.worlds.running import served

ASKED = {"task": "stand_bottle", "instruction": "stand the bottle"}


@pytest.fixture(scope="module")
def client():
    world = SumWorld()
    worlds = {"sum": world, "copy-first": CopyFirstWorld.beside(world.description)}
    with (
        served(create_world_app(worlds, WorldServiceSettings())) as url,
        RolloutClient(url) as opened,
    ):
        yield opened


@pytest.fixture
def env(client):
    made = WorldEnv(client, world="sum", chunk_steps=4, max_chunks=3, **ASKED)
    yield made
    made.close()


def test_gymnasium_accepts_it(env):
    check_env(env, skip_render_check=True)


def test_success_ends_and_length_truncates(env):
    env.reset(seed=0)
    outcomes = [env.step(actions(4))[1:4] for _ in range(3)]
    assert outcomes == [(0.0, False, False), (0.0, False, False), (0.0, False, True)]
    _, info = env.reset(seed=99)
    assert info["success"] is False
    seen, reward, terminated, truncated, info = env.step(actions(4, 10.0))
    assert (reward, terminated, truncated) == (1.0, True, False)
    assert info["last_step"] == 4
    assert seen["tactile_kpa"].min() > 100


def test_a_rollout_that_its_world_ends_is_truncated(env):
    env.reset(seed=0)
    before, *_, info = env.step(actions(4))
    assert (info["ended"], info["doubt"]) == (None, None)
    seen, reward, terminated, truncated, info = env.step(actions(4, 4e6))
    assert (reward, terminated, truncated) == (0.0, False, True)
    assert info["ended"] == "too many to count"
    np.testing.assert_array_equal(seen["tactile_kpa"], before["tactile_kpa"])


def test_without_a_seed_starts_differ(env):
    first, _ = env.reset()
    second, _ = env.reset()
    assert first["tactile_kpa"][0, 0] != second["tactile_kpa"][0, 0]


def test_it_can_begin_from_an_observation(client):
    env = WorldEnv(client, world="copy-first", chunk_steps=4, **ASKED)
    first = observation(seed=9)
    seen, _ = env.reset(seed=1, options={"init": (first, anchor(), K_HEAD)})
    np.testing.assert_array_equal(seen["tactile_kpa"], first.tactile_kpa[0])
    env.close()


def test_wrong_use_is_named(client, env):
    with pytest.raises(UnknownNameError, match="valid: copy-first, sum"):
        WorldEnv(client, world="moon", **ASKED)
    with pytest.raises(InvalidInputError, match="multiple of 4"):
        WorldEnv(client, world="sum", chunk_steps=6, **ASKED)
    with pytest.raises(InvalidInputError, match="call reset first"):
        env.step(actions(4))
    with pytest.raises(UnknownNameError, match="valid: init"):
        env.reset(options={"start": None})


def test_abandoned_episodes_are_ended_at_the_service(client):
    env = WorldEnv(client, world="sum", chunk_steps=4, **ASKED)
    for seed in range(100):  # More than the service keeps alive.
        env.reset(seed=seed)
    env.close()
