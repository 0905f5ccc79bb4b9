"""Turn Lever: verdicts on angles set by hand, and a palm that turns the lever against friction."""

import mujoco
import numpy as np
import pytest

from services.twin.episodes import TakeOptions, record
from services.twin.settings import TwinSettings
from services.twin.stage import Stage
from services.twin.tasks import get_task

# Turned by 0.6 rad.
TURNED = [np.cos(0.3), 0, 0, np.sin(0.3)]
STANDING = [[0.0, 0.1, 0.0, *TURNED], [0.0, 0.1, 0.018, *TURNED]]


@pytest.mark.parametrize(
    ("degrees", "speed_rad_s", "expected"),
    [
        (0, 0.0, (False, False, False, False)),
        (9, 0.0, (False, False, False, False)),
        (11, 0.0, (False, True, False, False)),
        (59, 0.0, (False, True, False, False)),
        (61, 0.0, (False, True, True, True)),
        (80, 0.3, (False, True, True, False)),
    ],
)
def test_the_verdict_follows_the_lever(hand_made, degrees, speed_rad_s, expected):
    simulation = hand_made("turn_lever", STANDING)
    model, data = simulation.scene.model, simulation.data
    joint = mujoco.mj_name2id(model, mujoco.mjtObj.mjOBJ_JOINT, "lever_hinge")
    data.qpos[model.jnt_qposadr[joint]] = np.deg2rad(degrees)
    data.qvel[model.jnt_dofadr[joint]] = speed_rad_s
    mujoco.mj_forward(model, data)
    task = get_task("turn_lever")
    assert task.reached(simulation) == expected
    assert task.succeeded(simulation) is expected[-1]


@pytest.mark.long
@pytest.mark.parametrize("domain", ["robot", "human"])
def test_the_right_palm_turns_the_lever_against_its_friction(domain):
    stage = Stage("turn_lever", domain, TwinSettings())
    episode = record(stage, 0, TakeOptions(images=()))
    assert episode.attributes.success is True
    peak_n = episode.pad_forces_n.max(axis=0)
    # Friction of 0.45 Nm at a grip 13 cm from the pivot.
    assert peak_n[1, -1] > 0.45 / 0.13
    assert not peak_n[0].any()
    # The lever turns clockwise seen from above, by 60° to 80°; the valve stays.
    poses = episode.streams["object_poses"].values
    np.testing.assert_array_equal(poses[:, 0], np.broadcast_to(poses[0, 0], poses[:, 0].shape))
    yaw_rad = 2 * np.unwrap(np.arctan2(poses[:, 1, 6], poses[:, 1, 3]))
    assert 60 < np.rad2deg(yaw_rad[0] - yaw_rad[-1]) < 80


@pytest.mark.long
def test_a_palm_that_stays_at_the_lever_is_not_done():
    stage = Stage("turn_lever", "robot", TwinSettings())
    # The hand stops where the push ends.
    episode = record(stage, 0, TakeOptions(images=(), frozen_from_step=50))
    assert tuple(episode.attributes.event_times_s) == ("touched", "moved", "turned")
    assert stage.simulation.hand_touches(1)
    assert episode.attributes.success is False
