"""Policies by name: scripts with a mistake of one kind."""

import numpy as np
import pytest

from dextouch.errors import InvalidInputError, UnknownNameError
from dextouch.hands.actions import poses_from_actions
from services.twin.mistakes import Mistake
from services.twin.settings import TwinSettings
from services.twin.stage import Stage, mistake_name, mistake_of, script_name, scripted_actions

SEED = 5


@pytest.fixture(scope="module")
def stage():
    return Stage("stand_bottle", "robot", TwinSettings(cameras=()))


def test_names_of_mistakes():
    assert mistake_name(Mistake("tilt", 0.5)) == "tilt 0.5"
    assert mistake_of("one_hand_late 0.15") == Mistake("one_hand_late", 0.15)
    for other in ("script 10 mm", "hold", "another scene's actions", "tilt=0.5", "cloned@12"):
        assert mistake_of(other) is None


def test_a_mistake_changes_the_exact_script(stage):
    exact, high = (scripted_actions(stage, SEED, name) for name in (script_name(0.0), "height 0.4"))
    anchor = stage.start(stage.plan(SEED))
    paths_m = [
        poses_from_actions(actions, anchor).Ts_world_wrist_right[:, :3, 3]
        for actions in (exact, high)
    ]
    # 25 mm times 0.4, up or down.
    np.testing.assert_allclose(np.abs(paths_m[1] - paths_m[0])[20:, 2], 0.010, atol=1e-6)
    # Wrists and head stay as they are where the strength is zero.
    still = scripted_actions(stage, SEED, "tilt 0")
    np.testing.assert_allclose(still[:, :18], exact[:, :18], atol=1e-9)


def test_unknown_names_are_refused(stage):
    with pytest.raises(UnknownNameError, match=r"tilt 0\.5"):
        scripted_actions(stage, SEED, "lean")
    with pytest.raises(UnknownNameError, match="kind of mistake"):
        scripted_actions(stage, SEED, "lean 0.5")
    with pytest.raises(InvalidInputError, match="0 … 1"):
        scripted_actions(stage, SEED, "tilt 2")
