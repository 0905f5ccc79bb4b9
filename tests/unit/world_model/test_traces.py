"""Chunks that are computed by a trace are, bit for bit, those of the model."""

import pytest
import torch

from dextouch.schemas import MAX_OBJECTS
from services.world_model.dynamics import tensor_trees
from services.world_model.dynamics.core import NUM_PADS, CoreState, SceneStart
from services.world_model.dynamics.features import (
    SAMPLE_OFFSETS,
    Commands,
    DynamicsConfig,
    ObjectPoses,
)
from services.world_model.dynamics.model import DynamicsModel
from services.world_model.dynamics.tensor_trees import Traced
from services.world_model.state_world import StateWorld
from tests.contracts.test_world import untrained_state_checkpoint


@pytest.fixture(scope="module")
def model():
    """Three members, tasks with one to three objects, and motion, which untrained cores lack."""
    torch.manual_seed(3)
    config = DynamicsConfig(
        tasks=("a", "b", "c"), num_objects=(1, 2, 3), image_px=32, width=24, touch_channels=8
    )
    dynamics = DynamicsModel(config, num_members=3)
    dynamics.codec.fit(10 * torch.rand(272, 320))
    with torch.no_grad():
        dynamics.core.motion.weight.normal_(std=0.3)
        dynamics.core.movable.fill_(1.0)
    return dynamics.eval()


def inputs(model, seed, *, batch=1, latents=4, task=0):
    """Commands, start, state and poses of all members, drawn from a seed."""
    draw = torch.Generator().manual_seed(seed)
    members, config = model.core.members, model.config

    def normal(*shape):
        return torch.randn(shape, generator=draw)

    def objects(*lead):
        axes = torch.nn.functional.normalize(normal(*lead, MAX_OBJECTS, 2, 3), dim=-1)
        present = (torch.rand((*lead, MAX_OBJECTS), generator=draw) < 0.8).float()
        return ObjectPoses(0.2 * normal(*lead, MAX_OBJECTS, 3), axes, present)

    commands = Commands(
        0.3 * normal(batch, latents, len(SAMPLE_OFFSETS), 2, 12, 3), normal(batch, latents, 2, 6),
        normal(batch, latents, 2, 20),
    )  # fmt: skip
    each = objects(members, batch)
    start = SceneStart(
        each, 0.01 * torch.rand((members, batch, MAX_OBJECTS), generator=draw),
        torch.ones(members, batch, MAX_OBJECTS, 2),
        normal(members, batch, 2, config.touch_channels), normal(members, batch, NUM_PADS),
        torch.full((members, batch), task), torch.ones(members, batch),
        torch.zeros(members, batch, 0),
    )  # fmt: skip
    state = CoreState(
        normal(members, batch, config.width), each.position_m, each.axes,
        0.3 * normal(members, batch, 2, 3), normal(members, batch, 2, 6),
    )  # fmt: skip
    return commands, start, state, objects(batch)


def tensors(outputs):
    return list(tensor_trees._tensors(outputs))


@pytest.mark.long
@torch.no_grad()
@pytest.mark.parametrize(("batch", "latents"), [(1, 4), (3, 2)])
def test_traces_give_the_same_bits(model, batch, latents):
    traced = Traced(model, model._predicted, model._kind_of)
    num_tasks = len(model.config.tasks)
    for seed in range(5 * num_tasks):
        given = inputs(model, seed, batch=batch, latents=latents, task=seed % num_tasks)
        expected = tensors(model._predicted(*given))
        got = tensors(traced(*given))
        assert len(got) == len(expected) > 8
        for ours, theirs in zip(got, expected, strict=True):
            assert torch.equal(ours, theirs)
            assert torch.isfinite(ours).all()
    assert traced._traces


@pytest.mark.long
@torch.no_grad()
def test_rare_shapes_and_too_many_of_them_are_not_traced(model, monkeypatch):
    traced = Traced(model, model._predicted, model._kind_of)
    for _ in range(3):
        traced(*inputs(model, 0))
    assert not traced._traces
    traced(*inputs(model, 0))
    assert len(traced._traces) == 1
    monkeypatch.setattr(tensor_trees, "_MOST_TRACES", 1)
    for _ in range(6):
        traced(*inputs(model, 0, batch=2))
    assert len(traced._traces) == 1


def test_the_world_of_a_checkpoint_traces():
    world = StateWorld(untrained_state_checkpoint())
    assert isinstance(world._dynamics._predict, Traced)
