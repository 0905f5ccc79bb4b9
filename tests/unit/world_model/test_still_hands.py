"""In the paper's form, too, a scene rests after still hands, and too long a rollout ends."""

from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest

from dextouch.errors import EndedError
from dextouch.hands.actions import CAMERA_HEAD
from dextouch.schemas import ReturnSelector
from dextouch.streams import HEAD_CAMERA
from dextouch.worlds.world import first_chunk_s
from tests.unit.world_model.test_joint_world import make_start, world

__all__ = ["world"]


def started(world, episode, kpa):
    start = make_start(episode)
    touch = np.full_like(start.observation.tactile_kpa, kpa)
    start = replace(start, observation=replace(start.observation, tactile_kpa=touch))
    state = world.reset(start).state
    return state, np.repeat(state.reached[None], 16, axis=0)


def test_hands_that_touch_nothing_and_stand_still_leave_a_scene_as_it_is(world, toy_episode):
    state, hold = started(world, toy_episode(0), 1.0)
    image, touch = state.image, state.tactile_kpa
    for seed in range(63):
        stepped = world.step(state, hold, seed=seed)
        state = stepped.state
    assert state.step == 1008
    observation = stepped.observation
    assert np.array_equal(observation.images[HEAD_CAMERA], np.stack([image] * 16))
    assert np.array_equal(observation.tactile_kpa, np.stack([touch] * 16))


def test_touched_objects_come_to_rest_after_two_seconds(world, toy_episode):
    state, hold = started(world, toy_episode(0), 5.0)
    # 8 latent steps of 4 are 2.1 s; then a chunk without motion changes nothing.
    states = [state]
    for seed in range(4):
        states.append(world.step(states[-1], hold, seed=seed).state)
    changes = [not np.array_equal(a.tactile_kpa, b.tactile_kpa) for a, b in pairwise(states)]
    assert changes == [True, True, False, False]
    assert states[-1].num_moving == 0
    restored = world.restore(world.snapshot(states[2]))
    assert np.array_equal(world.step(restored, hold, seed=9).state.image, states[2].image)


@pytest.mark.parametrize("moved", [0, CAMERA_HEAD.start, CAMERA_HEAD.start + 4])
def test_a_hand_or_the_camera_that_moves_or_turns_ends_the_rest(world, toy_episode, moved):
    state, hold = started(world, toy_episode(0), 0.0)
    moving = hold.copy()
    moving[9:, moved] += 5e-3
    together = world.step_batch([state, state], np.stack([hold, moving]), seeds=[1, 1])
    still, other = (one.state for one in together)
    assert np.array_equal(still.image, state.image)
    assert not np.array_equal(other.tactile_kpa, state.tactile_kpa)
    assert (still.num_moving, other.num_moving, other.num_still) == (0, 1, 1)
    # A rollout at rest in the batch changes nothing for the one that moves.
    alone = world.step(state, moving, seed=1)
    assert np.array_equal(alone.state.tactile_kpa, other.tactile_kpa)
    last = world.step(state, hold, seed=1, selector=ReturnSelector(steps="last")).observation
    assert np.array_equal(last.images[HEAD_CAMERA], state.image[None])


def test_hands_that_move_too_long_end_the_rollout(world, toy_episode):
    episode = toy_episode(0)
    state = world.reset(make_start(episode)).state
    chunk = episode.actions["commanded"][1:17]
    last = replace(state, num_moving=4 * 20 - 1)
    ended = world.step(last, chunk, seed=0).state
    assert ended.num_moving >= 80
    with pytest.raises(EndedError, match="hands moved for 21 s"):
        world.step(ended, chunk, seed=0)
    assert world.restore(world.snapshot(ended)).num_moving == ended.num_moving


def test_warming_up_computes_a_chunk_although_hands_rest(world, monkeypatch):
    calls = []
    predict = world._model.predict
    monkeypatch.setattr(
        world._model, "predict", lambda *a, **k: calls.append(a) or predict(*a, **k)
    )
    first_chunk_s(world)
    assert [one[0].num_steps for one in calls] == [5]
