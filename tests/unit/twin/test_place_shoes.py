"""Place Shoes: both kinds of hands do it, and a demonstrator who misreads places does not."""

import numpy as np
import pytest

from services.twin.episodes import TakeOptions, record
from services.twin.settings import TwinSettings
from services.twin.stage import Stage
from services.twin.tasks import get_task

BLIND = TakeOptions(images=())
RACK = [0, 0, 0, 1, 0, 0, 0]
ONE_SHOE = (False, True, False, True, False, False)


def shoe(x_m, *, z_m=0.01995, yaw_rad=0.0):
    """A pose of an upright boot beside the origin, by default on top of the rack."""
    return [x_m, 0, z_m, np.cos(yaw_rad / 2), 0, 0, np.sin(yaw_rad / 2)]


@pytest.fixture(scope="module", params=["robot", "human"])
def stage(request):
    return Stage("place_shoes", request.param, TwinSettings())


@pytest.mark.parametrize("seed", [11, *(pytest.param(n, marks=pytest.mark.slow) for n in (12, 13))])
def test_demonstrators_succeed(stage, seed):
    attributes = record(stage, seed, BLIND).attributes
    assert attributes.success is True
    assert tuple(attributes.event_times_s) == stage.task.milestones
    assert list(attributes.event_times_s.values()) == sorted(attributes.event_times_s.values())


@pytest.mark.slow
def test_both_hands_squeeze_their_boot(stage):
    held_n = record(stage, 11, BLIND).pad_forces_n[round(2.2 * 60)]
    assert (held_n[:, 0] > 2.0).all()
    assert (held_n[:, 1:5].sum(axis=1) > 2.0).all()


@pytest.mark.slow
def test_demonstrators_four_centimetres_wrong_fail(stage):
    takes = [record(stage, seed, TakeOptions(noise_m=0.04, images=())) for seed in (11, 12, 13)]
    assert sum(take.attributes.success for take in takes) <= 1


def test_boots_stand_on_the_table_at_the_start(stage):
    plan = stage.plan(11)
    stage.start(plan)
    assert stage.simulation.touches_table(0)
    assert stage.simulation.touches_table(1)
    np.testing.assert_allclose(stage.simulation.object_poses(), plan.object_poses, atol=1e-3)


# The rack is 2 cm high, with places 75 mm left and right of its middle.
@pytest.mark.parametrize(
    ("shoes", "expected"),
    [
        pytest.param([shoe(-0.075), shoe(0.075)], (False, *[True] * 5), id="both in place"),
        pytest.param([shoe(-0.075), shoe(0.105)], ONE_SHOE, id="30 mm off"),
        pytest.param([shoe(-0.075, yaw_rad=0.4), shoe(0.075)], ONE_SHOE, id="turned"),
        pytest.param([shoe(0.075), shoe(-0.075)], (False,) * 6, id="exchanged"),
        pytest.param([shoe(-0.075, z_m=0.1), shoe(0.075, z_m=0.1)], (False,) * 6, id="in the air"),
        pytest.param(
            [[-0.075, 0, 0.05, 0.5**0.5, 0, 0.5**0.5, 0], shoe(0.075)], ONE_SHOE, id="lying"
        ),
        pytest.param([shoe(-0.19, z_m=0), shoe(0.19, z_m=0)], (False,) * 6, id="beside the rack"),
    ],
)
def test_states_made_by_hand_are_judged_rightly(shoes, expected, hand_made):
    assert get_task("place_shoes").reached(hand_made("place_shoes", [*shoes, RACK])) == expected
