"""Every member of an ensemble predicts alone what it predicts within the ensemble."""

import pytest

from benchmarks.evaluator.work import single_member, write_single_members
from dextouch.errors import CorruptDataError
from services.world_model.checkpoints import write_state_checkpoint
from services.world_model.shipped_checkpoints import PRETRAINED
from services.world_model.state_world import StateWorld
from services.world_model.world import open_world
from tests.contracts.test_world import from_observation, move, untrained_state_checkpoint


def _stepped(world):
    begun = world.reset(from_observation(world))
    return world.step(begun.state, move(begun.observation, 8), seed=0)


def test_members_alone_predict_as_within_the_ensemble(tmp_path):
    whole = untrained_state_checkpoint()
    path = tmp_path / "whole.safetensors"
    write_state_checkpoint(path, whole.dynamics, whole.renderer, whole.metadata)
    together = _stepped(StateWorld(whole)).state.memory
    alone = [_stepped(open_world(one)) for one in write_single_members(path, tmp_path / "each")]
    assert len({one.observation.uncertainty.success_probability for one in alone}) == 2
    for member, one in enumerate(alone):
        assert one.state.memory.success.flatten().tolist() == pytest.approx(
            together.success[member].tolist(), abs=1e-6
        )
        assert one.observation.uncertainty.success_spread == 0.0
    assert single_member(whole.dynamics, 1).core.members == 1


def test_the_papers_form_has_no_members(tmp_path):
    with pytest.raises(CorruptDataError):
        write_single_members(PRETRAINED / "tiny.safetensors", tmp_path)
