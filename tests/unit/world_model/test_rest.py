"""When a scene comes to rest does not depend on how a client cuts its commands into chunks."""

import copy
import dataclasses

import numpy as np
import pytest
import torch

from dextouch.schemas import ReturnSelector
from services.world_model.dynamics.model import REST_LATENTS, stillness
from services.world_model.state_world import StateWorld
from tests.contracts.test_world import from_observation, untrained_state_checkpoint

TOUCH_ONLY = ReturnSelector(cameras=())
NUM_STEPS = 80
# Of 80 commands: the hands move, stand for 3.5 s, move again, and stand.
MOVING = (slice(0, 10), slice(62, 66))


def seeing_checkpoint():
    """A model of random weights that is sure of its objects, and moves them."""
    checkpoint = untrained_state_checkpoint()
    dynamics = copy.deepcopy(checkpoint.dynamics)
    for reader in dynamics.readers():
        with torch.no_grad():
            reader.head[-1].bias[9::13] = 20.0
    dynamics.core.movable.fill_(1.0)
    torch.nn.init.normal_(dynamics.core.motion.weight, std=0.05)
    return dataclasses.replace(checkpoint, dynamics=dynamics)


@pytest.fixture(scope="module")
def world():
    return StateWorld(seeing_checkpoint())


@pytest.fixture(scope="module")
def started(world):
    return world.reset(from_observation(world))


@pytest.fixture(scope="module")
def commands(started):
    speed_m = np.zeros(NUM_STEPS)
    for steps in MOVING:
        speed_m[steps] = 0.004
    rows = np.repeat(started.observation.action_reached, NUM_STEPS, axis=0)
    rows[:, 11] += np.cumsum(speed_m)
    return rows


def played(world, state, commands, lengths):
    """Touch, object poses, and the state after the last of some chunks."""
    touch, poses, uncertainties, first = [], [], [], 0
    for length in lengths:
        step = world.step(state, commands[first : first + length], seed=0, selector=TOUCH_ONLY)
        state, first = step.state, first + length
        touch.append(step.observation.tactile_kpa)
        poses.append(step.observation.object_poses)
        uncertainties.append(
            (step.observation.uncertainty.disagreement, step.observation.uncertainty.distance)
        )
    assert first == len(commands)
    return np.concatenate(touch), np.concatenate(poses), np.max(uncertainties, axis=0), state


def random_cut(rng):
    left, lengths = NUM_STEPS, []
    while left:
        lengths.append(min(left, 4 * int(rng.integers(1, 17))))
        left -= lengths[-1]
    return lengths


CUTS = [[16] * 5, [4] * 20, [4, 12, 64], [64, 16], [48, 32]]
CUTS += [random_cut(np.random.default_rng(seed)) for seed in range(6)]


@pytest.mark.long
@pytest.mark.parametrize("lengths", CUTS, ids=str)
def test_every_cutting_gives_the_same(world, started, commands, lengths):
    touch, poses, uncertainty, end = played(world, started.state, commands, [8] * 10)
    other = played(world, started.state, commands, lengths)
    np.testing.assert_allclose(other[0], touch, atol=1e-3, rtol=0)
    np.testing.assert_allclose(other[1], poses, atol=1e-5, rtol=0)
    np.testing.assert_allclose(other[2], uncertainty, atol=1e-6, rtol=1e-5)
    assert other[3].num_moving == end.num_moving
    assert other[3].memory.num_still == end.memory.num_still
    hidden = [end.memory.state.hidden for end in (other[3], end)]
    torch.testing.assert_close(*hidden, atol=1e-5, rtol=0)


def test_a_scene_rests_from_two_seconds_of_standing_on(world, started, commands):
    touch, poses, _, _ = played(world, started.state, commands, [16] * 5)
    # Latent 3 (steps 9 … 12) is the last that moves, the next eight stand, and then all rests
    # until step 60; latent 16 (steps 61 … 64) moves again.
    resting = slice(12 + 4 * REST_LATENTS, 60)
    for steps in (touch, poses):
        assert (steps[resting] == steps[resting.start - 1]).all()
        assert (steps[resting.start - 1] != steps[resting.start - 9]).any()
        assert (steps[68] != steps[59]).any()


def test_hands_that_were_still_before_a_chunk_and_move_within_it_rest_until_then():
    stood = torch.zeros(2, 2, 6, 3)
    looks = torch.zeros(2, 4, 2, 2, 6, 3)
    looks[1, 2:, ..., 0] = 0.01
    followed = stillness(stood, torch.tensor([REST_LATENTS, REST_LATENTS - 1]), looks)
    assert followed.at_rest.tolist() == [[True] * 4, [False, True, False, False]]
    assert followed.moves.tolist() == [[False] * 4, [False, False, True, False]]
    assert followed.num_still.tolist() == [REST_LATENTS + 4, 1]
    assert [(run.start, run.stop, who.tolist()) for run, who in followed.runs()] == [
        (0, 1, [True, False]), (1, 2, [True, True]), (2, 4, [True, False]),
    ]  # fmt: skip


def test_hands_that_come_back_within_a_latent_step_have_moved():
    looks = torch.zeros(1, 1, 2, 2, 6, 3)
    looks[0, 0, 0, 1, 0, 2] = 0.02
    followed = stillness(torch.zeros(1, 2, 6, 3), torch.tensor([20]), looks)
    assert followed.moves.all()
    assert not followed.at_rest.any()


@pytest.mark.long
def test_resting_rollouts_of_a_batch_leave_moving_ones_alone(world, started, commands):
    still = np.repeat(commands[:1], 64, axis=0)
    resting = world.step(started.state, still, seed=0, selector=TOUCH_ONLY).state
    moving = started.state
    chunks = np.stack([still[:16], commands[:16]])
    together = world.step_batch([resting, moving], chunks, seeds=[0, 0])
    for both, state, chunk in zip(together, (resting, moving), chunks, strict=True):
        alone = world.step(state, chunk, seed=0).observation
        np.testing.assert_allclose(both.observation.tactile_kpa, alone.tactile_kpa, atol=1e-3)
        np.testing.assert_allclose(both.observation.object_poses, alone.object_poses, atol=1e-5)
    rested = together[0].observation.tactile_kpa
    assert (rested == resting.memory.tactile_kpa.numpy()).all()


def test_hands_that_touch_nothing_leave_everything_where_it_was(world):
    start = from_observation(world)
    seen = start.observation
    free = dataclasses.replace(seen, tactile_kpa=np.minimum(seen.tactile_kpa, 1.9))
    begun = world.reset(dataclasses.replace(start, observation=free))
    still = np.repeat(seen.action_reached, 64, axis=0)
    state = begun.state
    for _ in range(2):
        step = world.step(state, still, seed=0, selector=ReturnSelector(steps="last"))
        state = step.state
    assert (step.observation.object_poses == begun.observation.object_poses).all()
    assert (step.observation.tactile_kpa == free.tactile_kpa).all()
    assert (step.observation.images["camera_head"] == seen.images["camera_head"]).all()
    # Hands that begin to move then do as if they had moved at once.
    lift = still[:16] + np.linspace(0, 0.01, 16)[:, None] * (np.arange(67) == 11)
    late = world.step(state, lift, seed=0, selector=TOUCH_ONLY).observation
    early = world.step(begun.state, lift, seed=0, selector=TOUCH_ONLY).observation
    assert (late.tactile_kpa == early.tactile_kpa).all()
    assert (late.object_poses == early.object_poses).all()
    assert (late.object_poses != begun.observation.object_poses).any()
    touching = dataclasses.replace(seen, tactile_kpa=np.full_like(seen.tactile_kpa, 3.0))
    held = world.reset(dataclasses.replace(start, observation=touching))
    pressed = world.step(held.state, still, seed=0, selector=TOUCH_ONLY).observation
    assert (pressed.object_poses != held.observation.object_poses).any()


@pytest.mark.long
@pytest.mark.parametrize("num_steps", [20, 48, 72])
def test_a_snapshot_amid_a_rollout_goes_on_bit_for_bit(world, started, commands, num_steps):
    """Before the hands stand, at rest, and after they moved again."""
    lengths = [4] * (num_steps // 4)
    state = played(world, started.state, commands[:num_steps], lengths)[3]
    at_rest = int(state.memory.num_still) >= REST_LATENTS
    assert at_rest == (num_steps == 48)
    data = world.snapshot(state)
    restored = StateWorld(seeing_checkpoint()).restore(data)
    assert world.snapshot(restored) == data
    rest = commands[num_steps:]
    for chunk in (rest, np.repeat(rest[-1:], 64, axis=0)):
        expected, got = world.step(state, chunk, seed=0), world.step(restored, chunk, seed=0)
        state, restored = expected.state, got.state
        for name in ("tactile_kpa", "object_poses", "action_reached"):
            one, other = getattr(expected.observation, name), getattr(got.observation, name)
            assert (one == other).all()
        assert (expected.observation.images["camera_head"]
            == got.observation.images["camera_head"]).all()  # fmt: skip
        assert expected.observation.uncertainty == got.observation.uncertainty
        assert world.snapshot(state) == world.snapshot(restored)
