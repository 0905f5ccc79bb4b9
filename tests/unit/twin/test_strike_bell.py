"""Strike Bell: a hit rings and a slow push does not; short, strong touch; verdicts set by hand."""

import mujoco
import numpy as np
import pytest

from services.twin.cameras import HEAD_HOME
from services.twin.demonstrators import NUM_GRID_STEPS, Waypoint, WaypointNoise, follow
from services.twin.episodes import TakeOptions, record
from services.twin.settings import TwinSettings
from services.twin.stage import Plan, Stage, command_row
from services.twin.tasks import get_task

TURNED = [np.cos(0.3), 0, 0, np.sin(0.3)]
ANGLE = 0.6
HINGE = [0.08 * np.cos(ANGLE) + 0.012 * np.sin(ANGLE), 0.08 * np.sin(ANGLE) - 0.012 * np.cos(ANGLE)]
STANDING = [[0, 0, 0, *TURNED], [0, 0, 0.075, *TURNED], [*HINGE, 0.035, *TURNED]]


@pytest.mark.parametrize(
    ("flag_rad", "depth_m", "expected"),
    [
        (0.0, 0.0, (False, False, False, False)),
        (0.2, 0.0, (False, True, False, False)),
        (0.9, 0.0, (False, True, False, False)),
        (1.1, 0.0, (False, True, True, True)),
        # The plunger is still down.
        (1.1, 0.005, (False, True, True, False)),
    ],
)
def test_the_verdict_follows_flag_and_plunger(hand_made, flag_rad, depth_m, expected):
    simulation = hand_made("strike_bell", STANDING)
    model, data = simulation.scene.model, simulation.data
    for name, value in (("flag_hinge", flag_rad), ("plunger_slide", depth_m)):
        data.qpos[model.joint(name).qposadr[0]] = value
    mujoco.mj_forward(model, data)
    task = get_task("strike_bell")
    assert task.reached(simulation) == expected
    assert task.succeeded(simulation) is expected[-1]


@pytest.mark.long
@pytest.mark.parametrize("domain", ["robot", "human"])
def test_a_strike_is_short_and_strong(domain):
    episode = record(Stage("strike_bell", domain, TwinSettings()), 0, TakeOptions(images=()))
    assert episode.attributes.success is True
    palm_n = episode.pad_forces_n[:, 1, -1]
    assert palm_n.max() > 15
    # At 60 Hz: a quarter of a second at most.
    assert 0 < (palm_n > 1).sum() <= 15
    assert not episode.pad_forces_n[:, 0].any()


def test_a_slow_push_to_the_stop_does_not_ring():
    stage, exact = Stage("strike_bell", "robot", TwinSettings()), WaypointNoise(np.zeros(3), 0.0)
    poses = stage.plan(0).object_poses
    script = stage.task.script(poses, "robot", np.random.default_rng(0), (exact, exact))
    hands = [(one.left, one.right) for one in script]
    slowly = [Waypoint(0.0, *hands[2]), Waypoint(3.0, *hands[3]), Waypoint(4.8, *hands[5])]
    commands = follow(slowly, np.tile(HEAD_HOME, (NUM_GRID_STEPS, 1, 1)))
    stage.start(Plan(poses, commands))
    depths_m = []
    for row in range(1, NUM_GRID_STEPS):
        for _ in stage.simulation.advance(command_row(commands, row)):
            pass
        depths_m.append(poses[1, 2] - stage.simulation.object_poses()[1, 2])
    # The plunger's whole travel.
    assert max(depths_m) > 0.0095
    assert stage.task.reached(stage.simulation) == (False, True, False, False)
