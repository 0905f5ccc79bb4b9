"""Lift Box: verdicts on states made by hand, both palms at work, boxes beside the platform."""

import numpy as np
import pytest

from dextouch.tactile.layout import PALM_SHAPE, SIDES
from services.twin.episodes import TakeOptions, record
from services.twin.settings import TwinSettings
from services.twin.stage import Stage
from services.twin.tasks import get_task

PLATFORM = [0.13, 0.08, 0.0, 1, 0, 0, 0]
NOTHING, STANDS = (False,) * 5, (False, False, False, True, True)


def turned(x, y, z, yaw_rad):
    return [x, y, z, np.cos(0.5 * yaw_rad), 0, 0, np.sin(0.5 * yaw_rad)]


@pytest.mark.parametrize(
    ("box", "expected"),
    [
        # The box is 62 mm high, the platform 30 mm.
        ([0.13, 0.08, 0.0609, 1, 0, 0, 0], STANDS),
        ([0.151, 0.08, 0.0609, 1, 0, 0, 0], STANDS),
        ([0.153, 0.08, 0.0609, 1, 0, 0, 0], NOTHING),
        (turned(0.13, 0.08, 0.0609, 0.30), STANDS),
        (turned(0.13, 0.08, 0.0609, 0.40), NOTHING),
        # On the table, in the air, on its side.
        ([-0.13, -0.05, 0.031, 1, 0, 0, 0], NOTHING),
        ([0.13, 0.08, 0.075, 1, 0, 0, 0], NOTHING),
        ([0.13, 0.08, 0.0849, 0.5**0.5, 0.5**0.5, 0, 0], NOTHING),
    ],
)
def test_states_made_by_hand_are_judged_rightly(box, expected, hand_made):
    task, simulation = get_task("lift_box"), hand_made("lift_box", [box, PLATFORM])
    assert task.reached(simulation) == expected
    assert task.succeeded(simulation) is expected[-1]


def test_a_box_at_one_hand_is_not_touched_by_both(hand_made):
    # In the air at the right hand, where it rests.
    simulation = hand_made("lift_box", [[0.26, -0.12, 0.14, 1, 0, 0, 0], PLATFORM])
    assert simulation.hand_contacts()[:, 0].tolist() == [False, True]
    assert get_task("lift_box").reached(simulation) == NOTHING


@pytest.mark.long
@pytest.mark.parametrize("domain", ["robot", "human"])
def test_both_palms_press_the_box_over_an_area(domain):
    stage = Stage("lift_box", domain, TwinSettings())
    episode = record(stage, 0, TakeOptions(images=()))
    assert episode.attributes.success is True
    touch_kpa = [episode.streams[f"tactile_{side}"].values for side in SIDES]
    # Of the 240 taxels of each palm, a hundred at the same time.
    lit = (np.stack(touch_kpa)[:, :, -np.prod(PALM_SHAPE) :] > 0.5).sum(axis=2)
    assert lit.min(axis=0).max() > 100
    # Friction carries 0.4 kg: with 1.2, two palms must press with 1.6 N each at least.
    assert episode.pad_forces_n[:, :, -1].min(axis=1).max() > 0.4 * 9.81 / 2 / 1.2


def test_no_box_begins_on_the_platform():
    task = get_task("lift_box")
    for seed in range(200):
        poses = task.place(np.random.default_rng(seed))
        # Half of the sides' sum, and what turning by 0.2 rad adds.
        assert poses[1, 0] - poses[0, 0] > 0.075 + 0.085 + 0.2 * (0.055 + 0.065)
