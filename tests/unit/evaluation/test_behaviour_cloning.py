"""A cloned policy: it beats the mean chunk, acts in closed loop, and keeps frames apart."""

import numpy as np
import pytest
import torch

from dextouch.clients.policy import Policy, PolicyStart
from dextouch.errors import InvalidInputError, UnknownNameError
from dextouch.geometry.rotations import rotation_from_vector
from dextouch.geometry.transforms import transform
from dextouch.hands.actions import pose_to_9d, reanchor
from services.evaluation.policies.behaviour_cloning import BehaviourCloningPolicy, chunk_from_start
from services.evaluation.policies.cloning_network import (
    ChunkCodec,
    CloningBatch,
    SpatialSoftmax,
)
from services.evaluation.policies.cloning_training import CloningSettings, train_cloned_policy
from tests.unit.evaluation import toy


def start(task: str, seed: int) -> PolicyStart:
    return PolicyStart(task, toy.INSTRUCTIONS[task], seed, toy.ANCHOR, toy.K_HEAD)


def roll(policy: Policy, task: str, seed: int, *, num_chunks: int = 5) -> np.ndarray:
    """Distance to the target at the end, in metres."""
    world = toy.ToyWorld("judge", judge=True)
    begun = world.reset(toy.RolloutStart(task, seed, toy.INSTRUCTIONS[task]))
    state, observation = begun.state, begun.observation
    policy.reset(start(task, seed))
    for _ in range(num_chunks):
        stepped = world.step(state, policy.act(observation), seed=0)
        state, observation = stepped.state, stepped.observation
    return np.linalg.norm(observation.action_reached[-1, :2] - state.target)


def test_held_out_error_is_well_below_the_mean_chunk(policy_checkpoint):
    metrics = policy_checkpoint.metadata.metrics
    assert metrics["wrist_error_mm"] < 0.7 * metrics["wrist_error_mm_of_mean_chunk"]


def test_it_reaches_unseen_targets(policy_checkpoint):
    policy = BehaviourCloningPolicy(policy_checkpoint)
    assert isinstance(policy, Policy)
    distances = [roll(policy, task, seed) for task in toy.TASKS for seed in range(1000, 1008)]
    away = [np.linalg.norm(toy.target_m(t, s)) for t in toy.TASKS for s in range(1000, 1008)]
    assert np.median(distances) < 0.4 * np.median(away)


def test_a_rollout_does_not_depend_on_the_one_before(policy_checkpoint):
    policy = BehaviourCloningPolicy(policy_checkpoint)
    alone = roll(policy, "reach", 1001)
    roll(policy, "reach far", 1002)
    assert roll(policy, "reach", 1001) == alone


def test_training_repeats_itself():
    few = toy.demonstrations(range(12))
    settings = CloningSettings(num_training_steps=3, batch_size=4, held_out_share=0.3)
    first, second = (train_cloned_policy(few, settings, command="x").tensors for _ in range(2))
    for name, tensor in first.items():
        assert torch.equal(tensor, second[name]), name


def test_training_needs_a_success():
    failed = [toy.replace(d, success=False) for d in toy.demonstrations(range(12))]
    with pytest.raises(InvalidInputError, match="no successful demonstration"):
        train_cloned_policy(failed, CloningSettings(), command="x")


def test_what_it_was_not_made_for_is_refused(policy_checkpoint):
    policy = BehaviourCloningPolicy(policy_checkpoint)
    seen = toy.ToyWorld("judge", judge=True).reset(toy.RolloutStart("reach", 0, "")).observation
    with pytest.raises(InvalidInputError, match="before reset"):
        policy.act(seen)
    unknown = toy.replace(start("reach", 0), task="juggle")
    with pytest.raises(UnknownNameError, match="reach far"):
        policy.reset(unknown)
    policy.reset(start("reach", 0))
    large = {"camera_head": np.zeros((1, 64, 64, 3), np.uint8)}
    with pytest.raises(InvalidInputError, match="32, 32"):
        policy.act(toy.replace(seen, images=large))
    with pytest.raises(UnknownNameError, match="camera"):
        policy.act(toy.replace(seen, images={}))


def test_chunks_are_moved_back_to_step_zero():
    rng = np.random.default_rng(8)
    poses = transform(rotation_from_vector(rng.normal(size=(3, 6, 3))), rng.normal(size=(3, 6, 3)))
    actions = rng.normal(size=(6, 67))
    for part, Ts in zip((slice(0, 9), slice(9, 18), slice(58, 67)), poses, strict=True):
        actions[:, part] = pose_to_9d(Ts)
    here = actions[2]
    relative = reanchor(actions, 0, anchor_action=here)
    np.testing.assert_allclose(chunk_from_start(relative, here), actions, atol=1e-12)


def moments(task: torch.Tensor, slot: torch.Tensor) -> CloningBatch:
    return CloningBatch(torch.zeros(len(task), 6, 8, 8), torch.zeros(len(task), 100), task, slot)


def test_codec_keeps_what_its_components_span():
    rng = np.random.default_rng(9)
    batch = moments(torch.arange(40) % 2, torch.arange(40) % 4 // 2)
    basis = rng.normal(size=(3, 16 * 67))
    offsets = 5.0 * rng.normal(size=(2, 2, 16 * 67))[batch.task, batch.slot]
    chunks = torch.tensor(rng.normal(size=(40, 3)) @ basis + offsets).reshape(40, 16, 67).float()
    codec = ChunkCodec(num_tasks=2, num_slots=3, num_components=3)
    codec.fit(chunks, batch)
    coefficients = codec.encode(chunks, batch)
    torch.testing.assert_close(codec.decode(coefficients, batch), chunks, atol=1e-2, rtol=1e-3)
    assert coefficients.mean(0).abs().max() < 1e-2
    torch.testing.assert_close(codec.mean[:, 2], codec.mean[:, 1])


def test_spatial_softmax_finds_the_peak():
    maps = torch.zeros(1, 2, 9, 9)
    maps[0, 0, 0, 8] = 50.0
    maps[0, 1, 4, 4] = 50.0
    places = SpatialSoftmax()(maps)
    torch.testing.assert_close(places, torch.tensor([[1.0, 0.0, -1.0, 0.0]]), atol=1e-4, rtol=0)
