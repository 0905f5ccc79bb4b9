"""Steps that cores start from where alignment interpolated the first ones."""

import dataclasses

import numpy as np
import pytest
import torch

from dextouch.errors import InvalidInputError
from services.world_model.dynamics.features import TouchCodec
from services.world_model.settings import CoreSettings
from services.world_model.training.member_training import CoreData, _draw, touch_latents
from services.world_model.training.scene_table import scene_table
from tests.unit.world_model.test_state_training import config, episode  # noqa: F401 (fixture)


def test_cores_begin_later_where_no_take_has_a_measured_first_step(config):  # noqa: F811 (fixture)
    table = scene_table([episode(seed) for seed in range(2)], config)
    data = CoreData(table, touch_latents(TouchCodec(8), table), {})
    settings = CoreSettings(batch=2, first_fraction=1.0)

    def start(interpolated):
        given = dataclasses.replace(table, interpolated=interpolated)
        some = dataclasses.replace(data, table=given)
        return _draw(some, settings, torch.Generator(), np.random.default_rng(0)).start_step

    given = torch.zeros_like(table.interpolated)
    assert start(given) == 0
    given[:, 0] = True
    assert start(given) > 0
    with pytest.raises(InvalidInputError, match="no take has a step with an image"):
        start(torch.ones_like(given))
