"""Open Drawer: what decides is contact; state, misses and snapshots hold for what stands fixed."""

import mujoco
import numpy as np
import pytest

from dextouch.geometry import apply, invert, project
from dextouch.schemas import RolloutStart
from services.twin.cameras import HEAD_HOME
from services.twin.episodes import TakeOptions, record
from services.twin.settings import TwinSettings
from services.twin.stage import Stage
from services.twin.tasks import get_task
from services.twin.world import TwinWorld

SMALL = TwinSettings(image_height_px=16, image_width_px=16, cameras=("camera_head",))
WORKING = {"robot": [1, 2, 3], "human": [1, 3]}
BLIND = TakeOptions(images=())
STANDING = [[0.06, 0.06, 0.0, 1, 0, 0, 0], [0.06, 0.06, 0.046, 1, 0, 0, 0]]


@pytest.fixture(scope="module")
def stage():
    return Stage("open_drawer", "robot", SMALL)


def drawer_out(simulation, *, distance_m, speed_m_s=0.0):
    """Move the drawer by MuJoCo's own joint and bring contacts up to date."""
    model, data = simulation.scene.model, simulation.data
    joint = mujoco.mj_name2id(model, mujoco.mjtObj.mjOBJ_JOINT, "drawer_slide")
    data.qpos[model.jnt_qposadr[joint]] = distance_m
    data.qvel[model.jnt_dofadr[joint]] = speed_m_s
    mujoco.mj_forward(model, data)


@pytest.mark.long
@pytest.mark.parametrize("domain", ["robot", "human"])
def test_the_demonstrator_opens_the_drawer(domain):
    stage = Stage("open_drawer", domain, SMALL)
    for seed in (0, 1):
        episode = record(stage, seed, BLIND)
        assert episode.attributes.success is True
        poses = episode.streams["object_poses"].values
        np.testing.assert_array_equal(poses[:, 0], np.broadcast_to(poses[0, 0], poses[:, 0].shape))
        pulled_m = np.linalg.norm(poses[-1, 1, :3] - poses[0, 1, :3])
        assert 0.06 < pulled_m < 0.10
        # Index, middle and ring finger do the work, the left hand none of it. The human's middle
        # finger reaches 1 cm deeper and bears on the bar above its tip.
        peak_n = episode.pad_forces_n.max(axis=0)
        assert (peak_n[1, WORKING[domain]] > 0.1).all()
        assert not peak_n[0].any()


@pytest.mark.long
def test_a_demonstrator_far_off_fails(stage):
    rates = [record(stage, seed, TakeOptions(0.1, images=())).attributes.success for seed in (0, 2)]
    assert rates == [False, False]


@pytest.mark.long
@pytest.mark.parametrize("seed", range(4))
def test_a_drawer_that_is_elsewhere_stays_shut(stage, seed):
    episode = record(stage, seed, TakeOptions(miss=True, images=()))
    assert episode.attributes.success is False
    assert "opened" not in episode.attributes.event_times_s


@pytest.mark.parametrize(
    ("distance_m", "speed_m_s", "expected"),
    [
        (0.0, 0.0, (False, False, False, False)),
        (0.02, 0.0, (False, True, False, False)),
        (0.059, 0.0, (False, True, False, False)),
        (0.061, 0.0, (False, True, True, True)),
        (0.09, 0.3, (False, True, True, False)),
    ],
)
def test_the_verdict_follows_the_drawer(hand_made, distance_m, speed_m_s, expected):
    simulation = hand_made("open_drawer", STANDING)
    drawer_out(simulation, distance_m=distance_m, speed_m_s=speed_m_s)
    task = get_task("open_drawer")
    assert task.reached(simulation) == expected
    assert task.succeeded(simulation) is expected[-1]


@pytest.mark.long
def test_a_drawer_that_a_hand_holds_open_is_not_done(stage):
    # The hand stops where the pull ends, before it unloads.
    episode = record(stage, 0, TakeOptions(images=(), frozen_from_step=40))
    times_s = episode.attributes.event_times_s
    assert tuple(times_s) == ("touched", "moved", "opened")
    assert stage.simulation.hand_touches(1)
    assert stage.simulation.object_speeds().max() < 0.05
    assert episode.attributes.success is False


def test_seeds_place_the_handle_in_the_head_cameras_view(stage):
    K = stage.rig.K["camera_head"]
    for seed in range(40):
        corners = stage.plan(seed).object_poses[1, :3] + np.array(
            [[x, y, z] for x in (-0.09, 0.09) for y in (-0.15, 0.13) for z in (-0.046, 0.04)]
        )
        pixels, in_front = project(K, apply(invert(HEAD_HOME), corners))
        assert in_front.all()
        assert ((pixels > 0) & (pixels < SMALL.image_width_px)).all()


@pytest.mark.long
def test_a_snapshot_keeps_where_the_cabinet_stands():
    world = TwinWorld(SMALL)
    commanded = record(Stage("open_drawer", "robot", SMALL), 5, BLIND).streams["action_commanded"]
    started = world.reset(RolloutStart("open_drawer", 5, ""))
    held = world.step(started.state, commanded.values[1:33], seed=0)
    data = world.snapshot(held.state)
    expected = world.step(held.state, commanded.values[33:], seed=0).observation
    world.reset(RolloutStart("open_drawer", 6, ""))
    got = world.step(world.restore(data), commanded.values[33:], seed=0).observation
    assert expected.success is got.success is True
    np.testing.assert_array_equal(got.images["camera_head"], expected.images["camera_head"])
    np.testing.assert_array_equal(got.tactile_kpa, expected.tactile_kpa)
