"""A cloned policy: it beats the mean chunk, acts in closed loop, and keeps frames apart."""

import numpy as np
import pytest
import torch

from dextouch.clients import Policy, PolicyStart
from dextouch.errors import InvalidInputError, UnknownNameError
from dextouch.geometry.rotations import rotation_from_vector
from dextouch.geometry.transforms import transform
from dextouch.hands.actions import AnchorPoses, pose_to_9d
from services.evaluation.policies.behaviour_cloning import (
    BehaviourCloningPolicy,
    ChunkCodec,
    CloningShape,
    from_world,
    half_size,
    in_world,
    spatial_softmax,
)
from services.evaluation.policies.cloning_training import (
    CloningEpisode,
    CloningSettings,
    decisions_of,
    train_cloned_policy,
)
from tests.unit.evaluation import toy

pytestmark = pytest.mark.long


def start(task: str, seed: int) -> PolicyStart:
    return PolicyStart(task, toy.INSTRUCTIONS[task], seed, toy.ANCHOR, toy.K_HEAD)


def episodes(seeds: range, **changed: object) -> list[CloningEpisode]:
    items = [toy.cloning_episode(item) for item in toy.demonstrations(seeds)]
    return [toy.replace(item, **changed) for item in items]


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


@pytest.fixture(scope="module")
def policy_checkpoint(trained_policies):
    return trained_policies[0]


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
    few = episodes(range(12))
    settings = CloningSettings(num_training_steps=3, batch_size=4, held_out_share=0.3)
    first, second, other = (
        train_cloned_policy(few, settings.model_copy(update={"seed": seed}), command="x")[0]
        for seed in (0, 0, 1)
    )
    for name, tensor in first.tensors.items():
        assert torch.equal(tensor, second.tensors[name]), name
    assert any(not torch.equal(t, other.tensors[name]) for name, t in first.tensors.items())


def test_an_early_policy_comes_from_the_same_training(trained_policies):
    finished, early = (one.metadata for one in trained_policies)
    assert early.training_starts == finished.training_starts
    assert early.tasks == finished.tasks
    assert early.settings["share_of_training"] == 0.02
    assert finished.settings["share_of_training"] == 1.0
    assert finished.metrics["wrist_error_mm"] < early.metrics["wrist_error_mm"]
    policies = [BehaviourCloningPolicy(c) for c in trained_policies]
    assert roll(policies[0], "reach", 1003) != roll(policies[1], "reach", 1003)


def test_without_being_asked_there_is_no_early_policy():
    settings = CloningSettings(num_training_steps=2, batch_size=4, held_out_share=0.3)
    assert train_cloned_policy(episodes(range(12)), settings, command="x")[1] is None


def test_training_needs_a_success():
    with pytest.raises(InvalidInputError, match="no successful demonstration"):
        train_cloned_policy(episodes(range(12), success=False), CloningSettings(), command="x")


def test_a_task_of_which_nothing_could_be_learned_is_refused():
    some = [
        toy.replace(one, measured=one.measured[:16]) if one.task == "reach far" else one
        for one in episodes(range(12))
    ]
    settings = CloningSettings(num_training_steps=2, batch_size=4, held_out_share=0.3)
    with pytest.raises(InvalidInputError, match="of reach far no demonstration that is longer"):
        train_cloned_policy(some, settings, command="x")


def test_decisions_are_whole_moments_of_one_episode():
    few = episodes(range(3))
    shape = CloningShape(tasks=toy.TASKS, image_size_px=toy.SIZE)
    found = decisions_of(few, shape)
    # 81 steps: 0, 8 … 64; all but the first as measured and as imagined.
    assert len(found) == 6 * 17
    index = found.drawn(30, torch.Generator().manual_seed(0))
    batch = found.batch(index)
    assert len(batch.first) <= 10
    for place, moment in enumerate(index.tolist()):
        item = few[moment // 17]
        first = torch.from_numpy(item.moments[0].image).movedim(-1, 0) / 255 - 0.5
        torch.testing.assert_close(batch.first[batch.rollout[place]], first)
        step = 8 * ((moment % 17 + 1) // 2)
        sent = torch.tensor(item.commanded[step + 1 : step + 17], dtype=torch.float32)
        torch.testing.assert_close(found.chunks[moment], sent)
        newest = torch.from_numpy(half_size(item.moments[step].image)).movedim(-1, 0) / 255 - 0.5
        torch.testing.assert_close(batch.newest[place], newest)


def test_half_an_image_holds_the_means_of_its_pixels():
    image = np.zeros((5, 4, 3), np.uint8)
    image[0, 0], image[0, 1], image[3, 3] = 40, 80, 100
    half = half_size(image)
    assert half.shape == (2, 2, 3)
    np.testing.assert_array_equal(half[..., 0], [[30, 0], [0, 25]])


def test_an_answer_does_not_depend_on_the_others_of_a_batch(policy_checkpoint):
    policy = BehaviourCloningPolicy(policy_checkpoint)
    decisions = decisions_of(episodes(range(3)), policy.shape)
    index = torch.arange(0, len(decisions), 8)
    with torch.no_grad():
        together = policy._network(decisions.batch(index))
        alone = [policy._network(decisions.batch(one[None])) for one in index]
    torch.testing.assert_close(together, torch.cat(alone), rtol=1e-4, atol=1e-4)


def test_only_the_last_step_of_an_observation_counts(policy_checkpoint):
    policy = BehaviourCloningPolicy(policy_checkpoint)
    world = toy.ToyWorld("judge", judge=True)
    begun = world.reset(toy.RolloutStart("reach", 1004, ""))
    sent = []
    for last_only in (False, True):
        policy.reset(start("reach", 1004))
        seen = world.step(begun.state, policy.act(begun.observation), seed=0).observation
        sent.append(policy.act(seen.last() if last_only else seen))
    np.testing.assert_array_equal(sent[0], sent[1])


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


def test_actions_in_the_world_have_absolute_poses():
    rng = np.random.default_rng(8)
    anchors = transform(rotation_from_vector(rng.normal(size=(3, 3))), rng.normal(size=(3, 3)))
    Ts = transform(rotation_from_vector(rng.normal(size=(3, 6, 3))), rng.normal(size=(3, 6, 3)))
    actions, expected = rng.normal(size=(2, 6, 67))
    expected[:, 18:58] = actions[:, 18:58]
    parts = (slice(0, 9), slice(9, 18), slice(58, 67))
    for part, T_world_anchor, Ts_anchor_part in zip(parts, anchors, Ts, strict=True):
        actions[:, part] = pose_to_9d(Ts_anchor_part)
        expected[:, part] = pose_to_9d(np.stack([T_world_anchor @ T for T in Ts_anchor_part]))
    anchor = AnchorPoses(*anchors)
    np.testing.assert_allclose(in_world(actions, anchor), expected, atol=1e-12)
    np.testing.assert_allclose(from_world(expected, anchor), actions, atol=1e-12)


def test_codec_keeps_what_its_components_span():
    rng = np.random.default_rng(9)
    tasks, slots = torch.arange(40) % 2, torch.arange(40) % 4 // 2
    basis = rng.normal(size=(3, 16 * 67))
    offsets = 5.0 * rng.normal(size=(2, 2, 16 * 67))[tasks, slots]
    chunks = torch.tensor(rng.normal(size=(40, 3)) @ basis + offsets).reshape(40, 16, 67).float()
    codec = ChunkCodec(CloningShape(tasks=("a", "b"), num_components=3, horizon_steps=16))
    codec.fit(chunks, tasks, slots)
    coefficients = codec.encode(chunks, tasks, slots)
    back = codec.decode(coefficients, tasks, slots)
    torch.testing.assert_close(back, chunks, atol=1e-2, rtol=1e-3)
    assert coefficients.mean(0).abs().max() < 1e-2
    torch.testing.assert_close(codec.mean[:, 2], codec.mean[:, 1])


def test_spatial_softmax_finds_the_peak():
    maps = torch.zeros(1, 2, 9, 9)
    maps[0, 0, 0, 8] = 50.0
    maps[0, 1, 4, 4] = 50.0
    places = spatial_softmax(maps)
    torch.testing.assert_close(places, torch.tensor([[1.0, 0.0, -1.0, 0.0]]), atol=1e-4, rtol=0)


def test_demonstrations_that_are_all_alike_teach_nothing():
    one = episodes(range(1))[0]
    alike = [toy.replace(one, scene=f"reach/{seed}", episode_id=f"e{seed}") for seed in range(40)]
    settings = CloningSettings(num_training_steps=2)
    with pytest.raises(InvalidInputError, match="do not differ, expected several of each task"):
        train_cloned_policy(alike, settings, command="")
