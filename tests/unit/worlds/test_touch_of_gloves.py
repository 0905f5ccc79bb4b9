"""Worlds take and give touch of the gloves that their description names, of no others."""

from dataclasses import replace

import numpy as np
import pytest

from dextouch.errors import DexTouchError, ShapeError
from dextouch.schemas import RolloutStart
from dextouch.worlds import CopyFirstWorld
from dextouch.worlds.world import check_answer, check_start
from tests.unit.other_gloves import small_layout
from tests.unit.worlds.fakes import K_HEAD, actions, anchor, observation

OURS = CopyFirstWorld(tasks=("rest",), cameras=(), image_height_px=8, image_width_px=8)


def start(num_taxels):
    seen = replace(
        observation(), images={}, tactile_kpa=np.ones((1, 2, num_taxels), dtype=np.float32)
    )
    return RolloutStart("rest", 0, "rest", observation=seen, anchor=anchor(), K_head=K_HEAD)


def test_the_baseline_beside_a_world_has_its_gloves():
    other = OURS.description.model_copy(update={"tactile_layout": small_layout()})
    world = CopyFirstWorld.beside(other)
    assert world.description.tactile_layout == small_layout()
    assert CopyFirstWorld.beside(OURS.description).description == OURS.description
    assert world.description.digest != OURS.description.digest
    state = world.reset(check_start(start(138), world.description)).state
    answer = world.step(state, actions(4), seed=0).observation
    check_answer(answer, world.description, first_step=1, num_steps=4)
    with pytest.raises(
        DexTouchError, match=r"138 taxels of one hand, expected 320 of .*dextouch_v1"
    ):
        check_answer(answer, OURS.description, first_step=1, num_steps=4)


@pytest.mark.parametrize(
    ("got", "expected", "name"), [(138, 320, "dextouch_v1"), (320, 138, "small")]
)
def test_a_start_with_another_glove_is_refused(got, expected, name):
    layout = small_layout() if name == "small" else None
    description = OURS.description.model_copy(update={"tactile_layout": layout})
    with pytest.raises(
        ShapeError, match=f"start: .* {got} taxels .* {expected} of layout '?{name}"
    ):
        check_start(start(got), description)
