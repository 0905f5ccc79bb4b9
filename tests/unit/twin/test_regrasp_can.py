"""Regrasp Can: only a second, lower grasp succeeds, and the stand is what makes it necessary."""

import numpy as np
import pytest

from services.twin.demonstrators import NUM_GRID_STEPS
from services.twin.episodes import TakeOptions, record
from services.twin.settings import TwinSettings
from services.twin.stage import Stage, command_row
from services.twin.tasks import get_task

NOTHING, SET_DOWN = (False,) * 5, (False, False, True, False, False)
STAND = [0.10, 0.0, 0.0, 1, 0, 0, 0]


@pytest.fixture(scope="module", params=["robot", pytest.param("human", marks=pytest.mark.slow)])
def stage(request):
    return Stage("regrasp_can", request.param, TwinSettings())


def contacts_by_name_m(simulation):
    """Contacts of the can with parts of a hand, by the names of MuJoCo's geoms."""
    model, found = simulation.scene.model, []
    for contact in simulation.data.contact:
        names = sorted(model.geom(int(geom)).name for geom in contact.geom)
        if names[0] == "can_wall" and names[1].startswith(("left_", "right_")):
            found.append(contact.pos)
    return np.array(found).reshape(-1, 3)


@pytest.mark.long
def test_the_demonstrator_grasps_high_and_then_low(stage):
    plan = stage.plan(1)
    stage.start(plan)
    simulation, heights_m, reached = stage.simulation, [], []
    for row in range(1, NUM_GRID_STEPS):
        for _ in simulation.advance(command_row(plan.commands, row)):
            pass
        touching = simulation.hand_contacts_m(0) - simulation.object_poses()[0, :3]
        np.testing.assert_array_equal(simulation.hand_contacts_m(0), contacts_by_name_m(simulation))
        heights_m.append(touching[:, 2].mean() if len(touching) else np.nan)
        reached.append(stage.task.reached(simulation))
    touched, lifted, set_down, regrasped, held = np.array(reached).T
    first, last = slice(0, int(np.flatnonzero(set_down)[0])), slice(-10, None)
    # 165 and 95 mm above the table at a can of 200 mm; contacts spread over a hand's width.
    assert np.nanmean(heights_m[first]) == pytest.approx(0.065, abs=0.03)
    assert np.nanmean(heights_m[last]) == pytest.approx(-0.005, abs=0.03)
    assert not (held & (set_down | regrasped)).any()
    assert not held[lifted & (np.arange(len(held)) < np.flatnonzero(set_down)[0])].any()
    assert (set_down & ~touched).any()
    assert held[last].all()


@pytest.mark.long
def test_a_can_held_by_its_upper_half_is_not_enough(stage):
    episode = record(stage, 1, TakeOptions(images=(), frozen_from_step=22))
    assert tuple(episode.attributes.event_times_s) == ("touched", "lifted")
    assert stage.simulation.object_poses()[0, 2] > 0.18
    assert stage.simulation.object_speeds()[0] < 0.05
    assert episode.attributes.success is False


@pytest.mark.parametrize(
    ("can", "expected"),
    [
        # In the stand, on its rim, beside it; leaning, in the air and lying there.
        ([0.10, 0.0, 0.1, 1, 0, 0, 0], NOTHING),
        ([0.10, 0.0, 0.18, 1, 0, 0, 0], NOTHING),
        ([-0.05, 0.0, 0.1, 1, 0, 0, 0], SET_DOWN),
        ([-0.05, 0.0, 0.1, np.cos(0.1), np.sin(0.1), 0, 0], NOTHING),
        ([-0.05, 0.0, 0.2, 1, 0, 0, 0], NOTHING),
        ([-0.05, 0.0, 0.025, 0.5**0.5, 0.5**0.5, 0, 0], NOTHING),
    ],
)
def test_states_made_by_hand_are_judged_rightly(can, expected, hand_made):
    simulation, task = hand_made("regrasp_can", [can, STAND]), get_task("regrasp_can")
    assert task.reached(simulation) == expected
    assert not task.succeeded(simulation)
    assert simulation.hand_contacts_m(0).shape == (0, 3)
