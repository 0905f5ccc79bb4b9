"""State models learn nothing at steps that were interpolated, or of objects unknown at a step."""

import dataclasses

import numpy as np
import pytest
import torch

from dextouch.errors import InvalidInputError
from services.world_model.dynamics.features import TouchCodec
from services.world_model.settings import CoreSettings, ReaderSettings
from services.world_model.training.member_training import (
    CoreData,
    _draw,
    touch_latents,
    train_reader,
)
from services.world_model.training.scene_table import scene_table
from tests.unit.world_model.test_state_training import config, episode  # noqa: F401 (fixture)
from tests.unit.world_model.toy_grid import changed


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


def test_readers_learn_nothing_of_an_object_that_is_unknown_beside_a_known_one(config):  # noqa: F811
    one, two = episode(0), config.model_copy(update={"num_objects": (2,)})
    known = np.ones((len(one), 2), dtype=bool)
    known[:, 1] = False
    readers = []
    for unknown_m in (0.1, 0.3):
        poses = one.objects.poses.repeat(2, axis=1)
        poses[:, 1, :3] = unknown_m
        track = {
            "poses": poses,
            "known": known,
            "sources": ("twin",) * 2,
            "sd_m": np.zeros(2, np.float32),
        }
        boxes_m = one.boxes_m.repeat(2, axis=0)
        take = changed(one, **track, boxes_m=boxes_m, object_names=("block", "mat"))
        settings = ReaderSettings(num_steps=4, batch=8, bfloat16=False)
        reader = train_reader(scene_table([take], two), two, settings, seed=0)
        readers.append(reader.state_dict())
    assert all(torch.equal(readers[0][name], readers[1][name]) for name in readers[0])
