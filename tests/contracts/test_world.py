"""One suite for every World: pure steps, refusals, snapshots that go on identically."""

import dataclasses
import functools
import tempfile
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

from dextouch.errors import InvalidInputError, ShapeError, UnknownNameError
from dextouch.hands.actions import AnchorPoses
from dextouch.schemas import Observation, ReturnSelector, RolloutStart
from dextouch.worlds import CopyFirstWorld, World
from dextouch.worlds.world import check_answer
from services.twin.settings import TwinSettings
from services.twin.world import TwinWorld
from services.world_model.checkpoints import (
    Checkpoint,
    CheckpointMetadata,
    StateCheckpoint,
    StateMetadata,
    read_checkpoint,
    read_state_checkpoint,
    write_checkpoint,
    write_state_checkpoint,
)
from services.world_model.dynamics.features import DynamicsConfig
from services.world_model.dynamics.model import DynamicsModel
from services.world_model.joint_world import JointWorld
from services.world_model.network.configuration import NetworkConfig, RendererConfig
from services.world_model.network.model import JointWorldModel
from services.world_model.rendering.renderer import RendererNetwork
from services.world_model.state_world import StateWorld
from tests.unit.worlds.fakes import K_HEAD, BatchSumWorld, anchor, observation

INSTRUCTION = "stand the bottle upright"


@dataclass(frozen=True)
class Candidate:
    """A world and a start it can begin from; `same` tells whether equal means bit for bit."""

    make: Callable[[], World[Any]]
    start: Callable[[World[Any]], RolloutStart]
    batch_tolerance: float = 0.0


def from_seed(world: World[Any]) -> RolloutStart:
    return RolloutStart(world.description.tasks[0], 3, INSTRUCTION)


def from_observation(world: World[Any]) -> RolloutStart:
    description = world.description
    size = (1, description.image_height_px, description.image_width_px, 3)
    rng = np.random.default_rng(1)
    first = dataclasses.replace(
        observation(),
        images={camera: rng.integers(0, 255, size, np.uint8) for camera in description.cameras},
    )
    return RolloutStart(
        description.tasks[0],
        3,
        INSTRUCTION,
        observation=first,
        anchor=anchor(),
        K_head=K_HEAD,
    )


def twin() -> World[Any]:
    return TwinWorld(TwinSettings(image_height_px=16, image_width_px=16))


@functools.cache
def untrained_checkpoint() -> Checkpoint:
    """A small model of random weights: what the contract asks does not need a trained one."""
    torch.manual_seed(0)
    torch.set_num_threads(1)
    shape = {"num_layers": 2, "num_heads": 2, "head_width": 16, "codec_channels": 12}
    config = NetworkConfig(image_px=32, video_width=32, tactile_width=32, palm_channels=8, **shape)
    model = JointWorldModel(config).eval()
    model.codec.fit(torch.randint(0, 255, (16, 17, 32, 32, 3), dtype=torch.uint8))
    model.tokenizer.fit(10 * torch.rand(272, 2, 320))
    metadata = CheckpointMetadata(
        name="untrained",
        network=config,
        tasks=("stand_bottle",),
        command="test",
        seed=0,
        training_steps=0,
        training_cpu_s=0.0,
        train_episode_ids=(),
        train_fingerprints=(),
        data_hash="0",
    )
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "untrained.safetensors"
        write_checkpoint(path, model, metadata)
        return read_checkpoint(path)


@functools.cache
def untrained_state_checkpoint(instructions: tuple[str, ...] = ()) -> StateCheckpoint:
    """A small state model of random weights, which may read instructions."""
    torch.manual_seed(0)
    torch.set_num_threads(1)
    config = DynamicsConfig(
        tasks=("stand_bottle",),
        num_objects=(1,),
        image_px=32,
        width=16,
        instructions=instructions,
    )
    dynamics = DynamicsModel(config, num_members=2)
    dynamics.codec.fit(10 * torch.rand(272, 320))
    shape = RendererConfig(widths=(8, 8), depths=(1, 1))
    metadata = StateMetadata(
        name="untrained",
        dynamics=config,
        num_members=2,
        renderer=shape,
        object_names={"stand_bottle": ("bottle",)},
        object_boxes_m={"stand_bottle": ((0.0, 0.0, 0.0, 0.03, 0.03, 0.1),)},
        command="test",
        seed=0,
        training_cpu_s=0.0,
        num_training_episodes=0,
        training_seeds={},
        data_hash="0",
    )
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "untrained.safetensors"
        write_state_checkpoint(path, dynamics, RendererNetwork(shape), metadata)
        return read_state_checkpoint(path)


CANDIDATES = {
    "twin": Candidate(twin, from_seed),
    "world-model": Candidate(
        lambda: JointWorld(untrained_checkpoint()), from_observation, batch_tolerance=1e-2
    ),
    "state-model": Candidate(
        lambda: StateWorld(untrained_state_checkpoint()), from_observation, batch_tolerance=1e-2
    ),
    "sum": Candidate(BatchSumWorld, from_seed),
    "copy-first": Candidate(lambda: CopyFirstWorld(tasks=("stand_bottle",)), from_observation),
}


@pytest.fixture(scope="module", params=list(CANDIDATES))
def candidate(request):
    return CANDIDATES[request.param]


@pytest.fixture(scope="module")
def world(candidate):
    return candidate.make()


@pytest.fixture
def started(world, candidate):
    return world.reset(candidate.start(world))


def hold(seen: Observation, num_steps: int) -> np.ndarray:
    """Actions that stay where the rollout is."""
    return np.repeat(seen.action_reached[-1:], num_steps, axis=0)


def move(seen: Observation, num_steps: int) -> np.ndarray:
    """Actions that lift both wrists by 2 cm and close the fingers a little."""
    rows = hold(seen, num_steps)
    ramp = np.linspace(0.0, 1.0, num_steps + 1)[1:, None]
    rows[:, [2, 11]] += 0.02 * ramp
    rows[:, 18:58] += 0.05 * ramp
    return rows


def assert_same(one: Observation, other: Observation, *, tolerance: float = 0.0) -> None:
    assert one.uncertainty == other.uncertainty
    assert (one.object_poses is None) == (other.object_poses is None)
    if one.object_poses is not None:
        np.testing.assert_allclose(one.object_poses, other.object_poses, rtol=0, atol=tolerance)
    assert one.first_step == other.first_step
    assert one.success == other.success
    assert set(one.images) == set(other.images)
    for camera, images in one.images.items():
        difference = np.abs(images.astype(int) - other.images[camera].astype(int))
        assert difference.max() <= (1 if tolerance else 0)
    np.testing.assert_allclose(one.tactile_kpa, other.tactile_kpa, rtol=0, atol=tolerance)
    np.testing.assert_allclose(one.action_reached, other.action_reached, rtol=0, atol=tolerance)


def test_it_describes_itself(world):
    description = world.description
    assert isinstance(world, World)
    assert description == world.description
    assert description.tasks
    assert description.cameras
    assert len(description.digest) >= 2
    assert description.chunk_multiple % 4 == 0
    assert description.max_chunk_steps >= description.chunk_multiple
    assert description.model_rate_hz > 0


def test_reset_gives_one_step_with_its_poses(world, started):
    check_answer(started.observation, world.description, first_step=0, num_steps=1)
    assert isinstance(started.anchor, AnchorPoses)
    for T in started.anchor.as_tuple():
        np.testing.assert_allclose(T[:3, :3].T @ T[:3, :3], np.eye(3), atol=1e-9)
        np.testing.assert_array_equal(T[3], [0, 0, 0, 1])
    assert started.K_head.shape == (3, 3)


def test_reset_is_deterministic(candidate, world, started):
    again = candidate.make().reset(candidate.start(world))
    assert_same(started.observation, again.observation)
    for one, other in zip(started.anchor.as_tuple(), again.anchor.as_tuple(), strict=True):
        np.testing.assert_array_equal(one, other)
    assert world.snapshot(started.state) == candidate.make().snapshot(again.state)


def test_unknown_tasks_are_refused(candidate, world):
    start = dataclasses.replace(candidate.start(world), task="juggle")
    if isinstance(world, BatchSumWorld | CopyFirstWorld):
        pytest.skip("takes any task; the service refuses unknown ones")
    with pytest.raises(UnknownNameError):
        world.reset(start)


@pytest.mark.parametrize("multiples", [1, 2])
def test_a_step_gives_as_many_steps_as_actions(world, started, multiples):
    num_steps = multiples * world.description.chunk_multiple
    if num_steps > world.description.max_chunk_steps:
        pytest.skip("longer than this world takes")
    stepped = world.step(started.state, move(started.observation, num_steps), seed=1)
    check_answer(stepped.observation, world.description, first_step=1, num_steps=num_steps)
    assert all(np.isfinite(value) for value in stepped.info.values())
    further = world.step(stepped.state, hold(stepped.observation, num_steps), seed=2)
    check_answer(
        further.observation, world.description, first_step=1 + num_steps, num_steps=num_steps
    )


@pytest.mark.long
def test_a_step_is_pure(world, started):
    chunk = move(started.observation, world.description.chunk_multiple)
    before = world.snapshot(started.state)
    kept = chunk.copy()
    one = world.step(started.state, chunk, seed=5)
    other = world.step(started.state, chunk, seed=5)
    assert_same(one.observation, other.observation)
    assert world.snapshot(one.state) == world.snapshot(other.state)
    assert world.snapshot(started.state) == before
    np.testing.assert_array_equal(chunk, kept)


@pytest.mark.long
@pytest.mark.parametrize("steps", ["all", "last"])
@pytest.mark.parametrize("num_cameras", [None, 0, 1])
def test_a_selector_changes_what_is_shown_and_nothing_else(world, started, steps, num_cameras):
    cameras = None if num_cameras is None else world.description.cameras[-num_cameras:]
    selector = ReturnSelector(cameras=() if num_cameras == 0 else cameras, steps=steps)
    chunk = move(started.observation, 2 * world.description.chunk_multiple)
    full = world.step(started.state, chunk, seed=5)
    asked = world.step(started.state, chunk, seed=5, selector=selector)
    assert_same(asked.observation, full.observation.selected(selector))
    check_answer(
        asked.observation, world.description, first_step=1, num_steps=len(chunk), selector=selector
    )
    assert asked.info == full.info
    assert world.snapshot(asked.state) == world.snapshot(full.state)
    following = world.step(asked.state, hold(full.observation, 4), seed=6)
    assert_same(
        following.observation,
        world.step(full.state, hold(full.observation, 4), seed=6).observation,
    )


def test_a_step_does_not_depend_on_what_the_world_did_before(candidate, world, started):
    chunk = move(started.observation, world.description.chunk_multiple)
    expected = world.step(started.state, chunk, seed=5).observation
    fresh = candidate.make()
    begun = fresh.reset(candidate.start(fresh))
    fresh.step(begun.state, hold(begun.observation, len(chunk)), seed=77)
    assert_same(fresh.step(begun.state, chunk, seed=5).observation, expected)


def test_wrong_chunks_are_refused_and_change_nothing(world, started):
    before = world.snapshot(started.state)
    length = world.description.chunk_multiple
    with pytest.raises(InvalidInputError):
        world.step(started.state, np.full((length, 67), np.nan), seed=0)
    with pytest.raises(InvalidInputError):
        world.step(started.state, np.zeros((0, 67)), seed=0)
    assert world.snapshot(started.state) == before


def test_a_snapshot_goes_on_identically_in_another_process(candidate, world, started):
    length = world.description.chunk_multiple
    first = world.step(started.state, move(started.observation, length), seed=1)
    data = world.snapshot(first.state)
    assert isinstance(data, bytes)
    other = candidate.make()
    restored = other.restore(data)
    assert other.snapshot(restored) == data
    chunk = move(first.observation, length)
    assert_same(
        other.step(restored, chunk, seed=2).observation,
        world.step(first.state, chunk, seed=2).observation,
    )


@pytest.mark.parametrize("damage", ["empty", "noise", "cut", "foreign"])
def test_bytes_that_are_no_snapshot_are_refused(world, started, damage):
    data = world.snapshot(started.state)
    damaged = {"empty": b"", "noise": b"\xc1" * 100, "cut": data[: len(data) // 2]}
    damaged["foreign"] = b"\x82\xa6fields\x80\xa6arrays\x80"
    with pytest.raises(InvalidInputError):
        world.restore(damaged[damage])


def test_a_batch_answers_as_single_steps_do(candidate, world, started):
    if not hasattr(world, "step_batch"):
        pytest.skip("this world takes one rollout at a time")
    length = world.description.chunk_multiple
    chunks = [hold(started.observation, length), move(started.observation, length)]
    together = world.step_batch([started.state] * 2, np.stack(chunks), seeds=[5, 6])
    for stepped, chunk, seed in zip(together, chunks, [5, 6], strict=True):
        alone = world.step(started.state, chunk, seed=seed).observation
        assert_same(stepped.observation, alone, tolerance=candidate.batch_tolerance)
    selectors = [ReturnSelector(steps="last"), ReturnSelector(cameras=())]
    mixed = world.step_batch(
        [started.state] * 2, np.stack(chunks), seeds=[5, 6], selectors=selectors
    )
    for one, full, selector in zip(mixed, together, selectors, strict=True):
        assert_same(one.observation, full.observation.selected(selector))
        assert world.snapshot(one.state) == world.snapshot(full.state)


def test_a_start_from_an_observation_begins_with_it(candidate, world):
    if "observation" not in world.description.starts_from:
        pytest.skip("expected only a task and seed")
    start = from_observation(world)
    if candidate.start is not from_observation:
        with_seed = world.reset(candidate.start(world))
        start = dataclasses.replace(
            start,
            observation=with_seed.observation,
            anchor=with_seed.anchor,
            K_head=with_seed.K_head,
        )
    started = world.reset(start)
    assert started.observation.first_step == 0
    np.testing.assert_array_equal(started.K_head, start.K_head)
    for one, other in zip(started.anchor.as_tuple(), start.anchor.as_tuple(), strict=True):
        np.testing.assert_array_equal(one, other)


def test_starts_it_does_not_know_are_refused(world):
    if "task_seed" in world.description.starts_from:
        pytest.skip("begins from task and seed")
    with pytest.raises((InvalidInputError, ShapeError)):
        world.reset(from_seed(world))
