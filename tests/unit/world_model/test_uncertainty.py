"""What bounds of uncertainty were measured of is what rollouts are asked, whatever their chunks."""

import dataclasses

import numpy as np
import pytest
import torch

from dextouch.schemas import ReturnSelector
from services.world_model.checkpoints import StateBounds
from services.world_model.dynamics.features import DynamicsConfig
from services.world_model.dynamics.model import DynamicsModel
from services.world_model.state_world import StateWorld
from services.world_model.training.evaluation import evaluate_dynamics
from services.world_model.training.scene_table import scene_table
from tests.contracts.test_world import from_observation
from tests.unit.world_model.test_rest import seeing_checkpoint
from tests.unit.world_model.test_state_training import PX, episode

TOUCH_ONLY = ReturnSelector(cameras=())
NUM_STEPS = 49


@pytest.fixture(scope="module")
def table():
    config = DynamicsConfig(tasks=("press",), num_objects=(1,), image_px=PX, width=16)
    return scene_table([episode(seed, NUM_STEPS) for seed in range(12)], config), config


@pytest.fixture(scope="module")
def dynamics(table):
    torch.manual_seed(0)
    model = DynamicsModel(table[1], num_members=2).eval()
    # So narrow that every hand is far from what was trained.
    model.core.highest.zero_()
    return model


def asked(dynamics, table, start):
    """Worst disagreement and distance of every chunk of 16 steps, asked one chunk after another."""
    rows = torch.arange(len(table))
    commands = table.commands(rows, start, torch.zeros(len(rows), dtype=torch.bool))
    memory = dynamics.begin(
        table.first_steps(rows, torch.full_like(rows, start)),
        table.tactile_kpa[rows, start].float(),
        commands[:1],
        table.commanded[rows].float(),
        table.instruction,
    )
    found = []
    for first in range(1, len(commands), 4):
        memory, imagined = dynamics.advance(memory, commands[first : first + 4])
        found.append(torch.stack([imagined.disagreement_m, imagined.distance]).amax(2))
    return torch.cat(found, dim=1)


@pytest.mark.long
def test_bounds_are_of_the_chunks_that_rollouts_are_asked(dynamics, table):
    _, measured = evaluate_dynamics(dynamics, table[0])
    chunks = torch.cat([asked(dynamics, table[0], start) for start in (0, 16, 32)], dim=1)
    disagreement_m, distance = np.quantile(chunks.numpy(), 0.999, axis=1)
    assert distance > 0.01
    np.testing.assert_allclose(measured.disagreement_m, disagreement_m, rtol=1e-3)
    np.testing.assert_allclose(measured.distance, distance, rtol=1e-3)


@pytest.mark.parametrize("figure", ["disagreement_m", "distance"])
def test_a_rollout_is_outside_once_a_figure_is_more_than_all_of_its_bound(figure):
    checkpoint = seeing_checkpoint()
    checkpoint.dynamics.core.highest.zero_()

    def stepped(**bounds):
        changed = {"bounds": StateBounds(**{"disagreement_m": 1e3, "distance": 1e6} | bounds)}
        metadata = checkpoint.metadata.model_copy(update=changed)
        world = StateWorld(dataclasses.replace(checkpoint, metadata=metadata))
        started = world.reset(from_observation(world))
        rows = np.repeat(started.observation.action_reached, 4, axis=0)
        rows[:, 9] += 0.4
        step = world.step(started.state, rows, seed=0, selector=TOUCH_ONLY)
        return step.observation.uncertainty, step.info["uncertainty/bound_share"]

    measured, _ = stepped(of_chunks=True)
    value = getattr(measured, figure.removesuffix("_m"))
    for factor, is_outside in ((0.8, True), (1.25, False)):
        found, share = stepped(**{figure: factor * value, "of_chunks": True})
        assert found.outside == is_outside
        np.testing.assert_allclose(share, 1 / factor, rtol=1e-5)


@pytest.mark.long
def test_a_long_chunk_is_as_doubtful_as_the_worst_of_its_parts():
    checkpoint = seeing_checkpoint()
    checkpoint.dynamics.core.highest.zero_()
    world = StateWorld(checkpoint)
    started = world.reset(from_observation(world))
    rows = np.repeat(started.observation.action_reached, 64, axis=0)
    # Far away in the middle, and back.
    rows[:, 9] += 0.4 * np.sin(np.linspace(0, np.pi, 64))
    whole = world.step(started.state, rows, seed=0, selector=TOUCH_ONLY).observation.uncertainty
    state, parts = started.state, []
    for first in range(0, 64, 4):
        step = world.step(state, rows[first : first + 4], seed=0, selector=TOUCH_ONLY)
        state = step.state
        parts.append(step.observation.uncertainty)
    np.testing.assert_allclose(whole.distance, max(p.distance for p in parts), rtol=1e-5)
    np.testing.assert_allclose(whole.disagreement, max(p.disagreement for p in parts), rtol=1e-4)
    assert whole.disagreement > 0
    assert whole.distance > 1.01 * np.mean([part.distance for part in parts])


def test_older_bounds_of_whole_episodes_keep_their_meaning():
    # An episode of 20 latent steps with a mean of 0.01: a single step may carry all of it.
    old = StateBounds.model_validate({"distance": 0.01, "horizon_latents": 20})
    np.testing.assert_allclose(old.latent_distance, 0.2)
    assert StateBounds(distance=0.01, of_chunks=True).latent_distance == 0.01
