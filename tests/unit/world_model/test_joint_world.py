"""The served model: functional states, chunks re-anchored, bad input refused, long runs finite."""

from dataclasses import replace

import numpy as np
import pytest
import torch

from dextouch.errors import (
    DexTouchError,
    InvalidInputError,
    LimitExceededError,
    NonFiniteError,
    ShapeError,
    UnavailableError,
    UnknownNameError,
)
from dextouch.schemas import Observation, ReturnSelector, RolloutStart
from dextouch.streams import HEAD_CAMERA
from dextouch.worlds import BatchWorld, World
from services.world_model import joint_world
from services.world_model.joint_world import JointWorld
from services.world_model.network.inputs import build_inputs
from services.world_model.training.joint_dataset import WindowPosition


@pytest.fixture
def world(checkpoint):
    # Untrained outputs are zero; shaken ones show every dependence.
    torch.manual_seed(0)
    for parameter in checkpoint.model.parameters():
        parameter.add_(0.03 * torch.randn(parameter.shape))
    return JointWorld(checkpoint)


def make_start(episode, start=0, kind="commanded"):
    window = episode.cut(WindowPosition(0, start, 5))
    request = window.request
    return RolloutStart(
        task=episode.task,
        seed=0,
        instruction=episode.instruction,
        action_kind=kind,
        observation=Observation(
            first_step=0,
            images={HEAD_CAMERA: window.images[:1]},
            tactile_kpa=window.tactile_kpa[:1],
            action_reached=request.actions[:1],
            reached_is_measured=True,
        ),
        anchor=request.anchor,
        K_head=request.K_head,
    )


def _equal(a, b):
    return np.array_equal(a.images[HEAD_CAMERA], b.images[HEAD_CAMERA]) and np.array_equal(
        a.tactile_kpa, b.tactile_kpa
    )


def test_it_is_a_world(world):
    assert isinstance(world, World)
    assert isinstance(world, BatchWorld)
    description = world.description
    assert description.kind == "model"
    assert description.starts_from == ("observation",)
    assert description.max_chunk_steps == 16


def test_loader_and_server_give_identical_tensors(world, toy_episode, monkeypatch):
    episode = toy_episode(4)
    seen = []

    def spy(requests, config):
        seen.append(build_inputs(requests, config))
        return seen[-1]

    monkeypatch.setattr(joint_world, "build_inputs", spy)
    for kind in ("measured", "commanded"):
        loader = build_inputs(
            [episode.cut(WindowPosition(0, 0, 17, action_kind=kind)).request], world._model.config
        )
        state = world.reset(make_start(episode, kind=kind)).state
        world.step(state, episode.actions[kind][1:17], seed=0)
        for name, tensor in vars(loader).items():
            served = getattr(seen[-1], name)
            if name == "instructions":
                assert served == tensor == (episode.instruction,)
            elif name in {"hands", "raster"} and kind == "commanded":
                # Row 0's joints: the loader knows the command, a start the measured reading;
                # neither is conditioned on (c_0 = 0).
                assert torch.equal(tensor[:, 1:], served[:, 1:]), (kind, name)
            else:
                assert torch.equal(tensor, served), (kind, name)


def test_later_chunks_are_re_anchored_to_where_the_rollout_stands(world, toy_episode, monkeypatch):
    episode = toy_episode(4)
    seen = []

    def spy(requests, config):
        seen.append(build_inputs(requests, config))
        return seen[-1]

    actions = episode.actions["commanded"]
    state = world.reset(make_start(episode)).state
    state = world.step(state, actions[1:9], seed=0).state
    monkeypatch.setattr(joint_world, "build_inputs", spy)
    world.step(state, actions[9:17], seed=0)
    expected = build_inputs(
        [episode.cut(WindowPosition(0, 8, 9, action_kind="commanded", from_command=True)).request],
        world._model.config,
    )
    for name in ("hands", "camera", "raster", "layout"):
        torch.testing.assert_close(
            getattr(seen[-1], name), getattr(expected, name), rtol=0, atol=1e-5
        )


def test_steps_are_numbered_and_touch_is_never_negative(world, toy_episode):
    episode = toy_episode(0)
    started = world.reset(make_start(episode))
    assert started.observation.first_step == 0
    assert len(started.observation) == 1
    stepped = world.step(started.state, episode.actions["commanded"][1:13], seed=3)
    observation = stepped.observation
    assert observation.first_step == 1
    assert len(observation) == 12
    assert observation.images[HEAD_CAMERA].shape == (12, 32, 32, 3)
    assert observation.tactile_kpa.min() >= 0
    assert not observation.reached_is_measured
    following = world.step(stepped.state, episode.actions["commanded"][13:17], seed=3)
    assert following.observation.first_step == 13


def test_the_seed_decides_and_the_state_is_not_changed(world, toy_episode):
    episode = toy_episode(0)
    state = world.reset(make_start(episode)).state
    chunk = episode.actions["commanded"][1:17]
    before = world.snapshot(state)
    a, b, c = (world.step(state, chunk, seed=seed).observation for seed in (7, 7, 8))
    assert _equal(a, b)
    assert not np.array_equal(a.tactile_kpa, c.tactile_kpa)
    assert world.snapshot(state) == before


def test_global_random_numbers_play_no_part(world, toy_episode):
    episode = toy_episode(0)
    state = world.reset(make_start(episode)).state
    chunk = episode.actions["commanded"][1:17]
    torch.manual_seed(1)
    a = world.step(state, chunk, seed=7).observation
    torch.manual_seed(2)
    assert _equal(a, world.step(state, chunk, seed=7).observation)


def test_company_in_a_batch_changes_nothing_but_rounding(world, toy_episodes):
    states, chunks = [], []
    for episode in toy_episodes:
        states.append(world.reset(make_start(episode)).state)
        chunks.append(episode.actions["commanded"][1:9])
    together = world.step_batch(states, np.stack(chunks), seeds=range(6))
    for index, (state, chunk) in enumerate(zip(states, chunks, strict=True)):
        alone = world.step(state, chunk, seed=index).observation
        many = together[index].observation
        np.testing.assert_allclose(alone.tactile_kpa, many.tactile_kpa, rtol=1e-5, atol=1e-5)
        difference = alone.images[HEAD_CAMERA].astype(int) - many.images[HEAD_CAMERA].astype(int)
        assert np.abs(difference).max() <= 1


def test_only_asked_images_are_decoded(world, toy_episode, monkeypatch):
    episode, decoded = toy_episode(2), []
    state = world.reset(make_start(episode)).state
    codec = world._model.codec
    decode = codec.decode

    def noting(latents):
        decoded.append(latents.shape[1])
        return decode(latents)

    monkeypatch.setattr(codec, "decode", noting)
    chunk = episode.actions["commanded"][1:17]
    for asked in ({"steps": "last"}, {"cameras": ()}):
        stepped = world.step(state, chunk, seed=3, selector=ReturnSelector(**asked))
        # The first latent and the last, whose last image the next chunk starts from.
        assert decoded == [2]
        decoded.clear()
    assert stepped.state.image.shape == state.image.shape
    world.step(state, chunk, seed=3)
    assert sum(decoded) > 2


def test_snapshots_resume_exactly(world, toy_episode):
    episode = toy_episode(2)
    actions = episode.actions["commanded"]
    state = world.step(world.reset(make_start(episode)).state, actions[1:9], seed=0).state
    restored = world.restore(world.snapshot(state))
    a = world.step(state, actions[9:17], seed=5).observation
    b = world.step(restored, actions[9:17], seed=5).observation
    assert _equal(a, b)
    assert a.first_step == b.first_step == 9


def test_foreign_and_damaged_snapshots_are_refused(world, toy_episode, monkeypatch):
    data = world.snapshot(world.reset(make_start(toy_episode(0))).state)
    for broken in (b"", b"junk", data[:-9], data.replace(b"commanded", b"commandxd")):
        with pytest.raises(DexTouchError):
            world.restore(broken)
    monkeypatch.setattr(world, "_digest", "f" * 64)
    with pytest.raises(InvalidInputError, match="made by world"):
        world.restore(data)


def test_starts_it_cannot_begin_from_are_refused(world, toy_episode):
    start = make_start(toy_episode(0))
    with pytest.raises(UnknownNameError, match="push_box"):
        world.reset(replace(start, task="juggle"))
    for missing in ("observation", "anchor", "K_head"):
        with pytest.raises(InvalidInputError, match="begins from an observation"):
            world.reset(replace(start, **{missing: None}))
    blind = replace(start.observation, images={})
    with pytest.raises(UnknownNameError, match=HEAD_CAMERA):
        world.reset(replace(start, observation=blind))
    small = replace(start.observation, images={HEAD_CAMERA: np.zeros((1, 16, 16, 3), np.uint8)})
    with pytest.raises(ShapeError):
        world.reset(replace(start, observation=small))
    numb = replace(start.observation, tactile_kpa=np.full((1, 2, 320), np.nan, np.float32))
    with pytest.raises(NonFiniteError):
        world.reset(replace(start, observation=numb))


def test_chunks_it_cannot_follow_are_refused(world, toy_episode):
    episode = toy_episode(0)
    state = world.reset(make_start(episode)).state
    rows = episode.actions["commanded"]
    for length in (1, 3, 18):
        with pytest.raises(ShapeError):
            world.step(state, rows[1 : 1 + length], seed=0)
    with pytest.raises(LimitExceededError, match="got 20 steps, expected at most 16"):
        world.step(state, rows[1:21], seed=0)
    broken = rows[1:5].copy()
    broken[2, 30] = np.nan
    with pytest.raises(NonFiniteError):
        world.step(state, broken, seed=0)
    far = rows[1:5].copy()
    far[2, 9] = 1e6
    with pytest.raises(InvalidInputError, match="m from the anchor"):
        world.step(state, far, seed=0)
    with pytest.raises(ShapeError, match="one of each"):
        world.step_batch([state], rows[None, 1:5], seeds=[1, 2])


def test_output_that_is_no_number_is_refused(world, toy_episode):
    episode = toy_episode(0)
    state = world.reset(make_start(episode)).state
    world._model.tokenizer.palm_scale.fill_(float("nan"))
    with pytest.raises(UnavailableError, match="contains NaN"):
        world.step(state, episode.actions["commanded"][1:5], seed=0)


@pytest.mark.long
def test_sixty_chunks_stay_finite_and_bounded(world, toy_episode):
    episode = toy_episode(5)
    started = world.reset(make_start(episode))
    state, observation = started.state, started.observation
    actions = episode.actions["commanded"]
    order = np.concatenate([np.arange(1, 41), np.arange(40, 0, -1)])
    for index in range(60):
        rows = order[(np.arange(16) + 16 * index) % len(order)]
        stepped = world.step(state, actions[rows], seed=index)
        # Without the bound on the time that hands move.
        state, observation = replace(stepped.state, num_moving=0), stepped.observation
        assert np.isfinite(observation.tactile_kpa).all()
    assert observation.first_step == 1 + 59 * 16
    assert observation.tactile_kpa.max() < 1e5
