"""Which LeRobot policies can act here; `make check-lerobot-policy` runs one."""

from types import SimpleNamespace

import pytest

from dextouch.bridges.lerobot import layout
from dextouch.clients import lerobot_policy
from dextouch.errors import InvalidInputError, ShapeError

# As in config.json of a policy trained on an export: ACT's defaults.
INPUTS = ("observation.state", "observation.images.camera_head")


def config(*, inputs=INPUTS, width=67, **changed):
    return SimpleNamespace(
        input_features=dict.fromkeys(inputs),
        output_features={"action": SimpleNamespace(shape=(width,))},
        **{"n_obs_steps": 1, "n_action_steps": 100} | changed,
    )


def test_inputs_are_named_as_in_exports():
    names = (lerobot_policy.STATE, lerobot_policy.TACTILE, lerobot_policy.IMAGES)
    assert names == (layout.STATE, layout.TACTILE, layout.IMAGES)


def test_a_policy_of_an_export_is_accepted():
    lerobot_policy._check(config(), 20)
    lerobot_policy._check(config(inputs=(*INPUTS, "observation.tactile"), n_action_steps=16), 16)


@pytest.mark.parametrize(
    ("changed", "error", "says"),
    [
        ({"inputs": ("observation.environment_state",)}, InvalidInputError, "environment_state"),
        ({"n_obs_steps": 2}, InvalidInputError, "2 observations at once"),
        ({"n_action_steps": 10}, InvalidInputError, "divisor of .* n_action_steps, 10"),
        ({"width": 14}, ShapeError, r"\[\[14\]\], expected \[\[67\]\]"),
    ],
)
def test_others_are_refused(changed, error, says):
    with pytest.raises(error, match=says):
        lerobot_policy._check(config(**changed), 4)
