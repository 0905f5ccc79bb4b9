"""What a state world refuses, flags and ends; the rest is in the contract of all worlds."""

import dataclasses

import numpy as np
import pytest
import torch

from dextouch.errors import EndedError, InvalidInputError, NonFiniteError
from dextouch.hands.actions import AnchorPoses
from dextouch.schemas import EVERYTHING, ReturnSelector
from dextouch.streams import pack, unpack
from services.world_model.state_world import ABSENT_POSE, StateWorld
from tests.contracts.test_world import from_observation, hold, move, untrained_state_checkpoint


@pytest.fixture
def checkpoint():
    return untrained_state_checkpoint()


@pytest.fixture
def world(checkpoint):
    return StateWorld(checkpoint)


def with_presence(checkpoint, *odds):
    """A world whose readers see the object with these log odds."""
    dynamics = checkpoint.dynamics
    for reader, value in zip(dynamics.readers(), odds, strict=True):
        with torch.no_grad():
            bias = reader.head[-1].bias.clone()
            reader.head[-1].weight.zero_()
            bias.zero_()
            bias[9::13] = value
            reader.head[-1].bias.copy_(bias)
    return StateWorld(checkpoint)


@pytest.mark.parametrize("odds", [(-20.0, -20.0), (20.0, -20.0)])
def test_objects_that_are_not_found_are_doubted(odds):
    untrained_state_checkpoint.cache_clear()
    world = with_presence(untrained_state_checkpoint(), *odds)
    untrained_state_checkpoint.cache_clear()
    started = world.reset(from_observation(world))
    stepped = world.step(started.state, move(started.observation, 4), seed=0)
    assert stepped.observation.uncertainty.outside
    assert "not found" in stepped.observation.uncertainty.reason
    if odds[0] < 0:
        assert (stepped.observation.object_poses[:, 0] == ABSENT_POSE).all()


@pytest.mark.long
def test_a_rollout_ends_when_hands_moved_longer_than_was_ever_trained(world, checkpoint):
    horizon = checkpoint.metadata.bounds.horizon_latents
    started = world.reset(from_observation(world))
    state, lift = started.state, move(started.observation, 16)
    for _ in range(horizon):
        step = world.step(state, lift, seed=0)
        state = step.state
    assert state.num_moving == 4 * horizon
    assert step.observation.uncertainty.outside
    with pytest.raises(EndedError, match="four times"):
        world.step(state, lift, seed=0)


@pytest.mark.long
def test_hands_that_stand_still_never_end_a_rollout(world):
    started = world.reset(from_observation(world))
    state = started.state
    for _ in range(63):
        step = world.step(state, hold(started.observation, 16), seed=0)
        state = step.state
    assert state.num_moving == 0
    assert state.step == 63 * 16


@pytest.mark.parametrize(
    "fault", [{"K": (0, 0, 1e-50)}, {"K": (0, 2, 1e300)}, {"anchor_m": 1e20}, {"anchor_m": np.nan}]
)
def test_starts_out_of_all_proportion_are_refused(world, fault):
    start = from_observation(world)
    if "K" in fault:
        row, column, value = fault["K"]
        K_head = start.K_head.copy()
        K_head[row, column] = value
        start = dataclasses.replace(start, K_head=K_head)
    else:
        Ts = np.stack(start.anchor.as_tuple())
        Ts[1, 0, 3] = fault["anchor_m"]
        start = dataclasses.replace(start, anchor=AnchorPoses(*Ts))
    with pytest.raises((InvalidInputError, NonFiniteError)):
        world.reset(start)


def test_what_a_caller_does_to_its_arrays_changes_no_rollout(world):
    start = from_observation(world)
    start = dataclasses.replace(start, K_head=start.K_head.copy())
    started = world.reset(start)
    before = world.snapshot(started.state)
    start.K_head[:] = 0
    start.observation.images["camera_head"][:] = 7
    started.observation.tactile_kpa[:] = 99
    started.observation.action_reached[:] = 99
    assert world.snapshot(started.state) == before
    again = world.step(started.state, hold(world.reset(from_observation(world)).observation, 4),
        seed=0)  # fmt: skip
    kept = world.snapshot(again.state)
    again.observation.tactile_kpa[:] = 99
    assert world.snapshot(again.state) == kept


@pytest.mark.parametrize(
    "damage",
    ["K_head", "anchor", "image", "num_moving", "start.objects.axes", "start.objects.position_m"],
)
def test_snapshots_with_impossible_numbers_are_refused(world, damage):
    fields, arrays = unpack(
        world.snapshot(world.reset(from_observation(world)).state), max_bytes=2**20
    )
    arrays = {name: np.array(array) for name, array in arrays.items()}
    if damage == "num_moving":
        fields["num_moving"] = -5
    elif damage == "image":
        arrays["image"] = arrays["image"].astype(np.float64)
    elif damage in {"K_head", "anchor"}:
        arrays[damage] = arrays[damage] * np.nan
    else:
        arrays[damage][...] = 3e38
    with pytest.raises((InvalidInputError, NonFiniteError)):
        world.restore(pack(fields, arrays))


def test_images_of_a_batch_are_drawn_together_as_requested(world, monkeypatch):
    """Every rollout has its own start image, and images of its own steps."""
    start = from_observation(world)
    rng = np.random.default_rng(0)
    states = []
    for _ in range(4):
        image = rng.integers(0, 256, start.observation.images["camera_head"].shape, dtype=np.uint8)
        seen = dataclasses.replace(start.observation, images={"camera_head": image})
        states.append(world.reset(dataclasses.replace(start, observation=seen)).state)
    chunk = move(start.observation, 8)
    actions = np.stack([hold(start.observation, 8), chunk, chunk, chunk])
    selectors = [
        EVERYTHING, ReturnSelector(steps="last"), ReturnSelector(cameras=()), EVERYTHING
    ]  # fmt: skip
    calls, draw = [], world._renderer.draw_all
    monkeypatch.setattr(
        world._renderer, "draw_all", lambda drawings: calls.append(len(drawings)) or draw(drawings)
    )
    together = world.step_batch(states, actions, seeds=[0] * 4, selectors=selectors)
    assert calls == [3]
    assert [sorted(one.observation.images) for one in together] == [
        ["camera_head"], ["camera_head"], [], ["camera_head"]
    ]  # fmt: skip
    for one, state, rows, selector in zip(together, states, actions, selectors, strict=True):
        alone = world.step(world.restore(world.snapshot(state)), rows, seed=0, selector=selector)
        for camera, images in alone.observation.images.items():
            drawn = one.observation.images[camera]
            assert drawn.shape == images.shape
            assert np.abs(drawn.astype(int) - images.astype(int)).max() <= 1


@pytest.mark.long
def test_the_size_of_objects_is_reported_beside_the_usual_one(world):
    started = world.reset(from_observation(world))
    for factors, expected in (((1.0, 0.75), 0.25), ((1.3, 0.9), 0.3)):
        memory = started.state.memory
        size = torch.tensor(factors).expand_as(memory.start.size).clone()
        # Slots without an object do not count.
        size[..., 1:, :] = 2.0
        start = dataclasses.replace(memory.start, size=size)
        state = dataclasses.replace(started.state, memory=dataclasses.replace(memory, start=start))
        for movable in (1.0, 0.0):
            world._dynamics.core.movable[:, 0] = movable
            uncertainty = world.step(
                state, move(started.observation, 4), seed=0
            ).observation.uncertainty
            assert uncertainty.size_deviation == pytest.approx(movable * expected, abs=1e-6)


def test_success_is_estimated_by_all_members():
    untrained_state_checkpoint.cache_clear()
    checkpoint = untrained_state_checkpoint()
    untrained_state_checkpoint.cache_clear()
    last = checkpoint.dynamics.core.success[-1]
    with torch.no_grad():
        last.weight.zero_()
        last.bias.copy_(torch.tensor([[2.0], [-1.0]]))
    world = StateWorld(checkpoint)
    started = world.reset(from_observation(world))
    stepped = world.step(started.state, move(started.observation, 8), seed=0)
    uncertainty = stepped.observation.uncertainty
    assert uncertainty.success_probability == pytest.approx(1 / (1 + np.exp(-0.5)), abs=1e-6)
    spread = 1 / (1 + np.exp(-2.0)) - 1 / (1 + np.exp(1.0))
    assert uncertainty.success_spread == pytest.approx(spread, abs=1e-6)
    # Hands that stand for two seconds change nothing, nor does a snapshot.
    held = stepped.state
    for _ in range(3):
        step = world.step(held, hold(stepped.observation, 16), seed=0)
        held = world.restore(world.snapshot(step.state))
    assert step.observation.uncertainty.success_probability == pytest.approx(
        uncertainty.success_probability
    )
