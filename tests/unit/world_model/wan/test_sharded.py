"""Sharded training of the full architecture, in one precision."""

import pytest
import torch

from services.world_model.checkpoints import read_checkpoint
from services.world_model.training.trainer import train_on
from tests.unit.world_model.test_distribution import sharded
from tests.unit.world_model.wan.test_end_to_end import settings

__all__ = ["settings", "sharded"]


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore:FSDP2-wrapped module")
def test_sharded_training_equals_plain_training(settings, large_episode, sharded):
    episodes = [large_episode(seed) for seed in range(3)]
    expected = train_on(episodes[:2], episodes[2:], settings)
    output = settings.output.with_name("sharded.safetensors")
    other = settings.model_copy(update={"output": output})
    report = train_on(episodes[:2], episodes[2:], other, processes=sharded)
    ours = read_checkpoint(report.checkpoint).model.state_dict()
    for name, weight in read_checkpoint(expected.checkpoint).model.state_dict().items():
        torch.testing.assert_close(ours[name], weight, rtol=1e-2, atol=1e-4, msg=name)
