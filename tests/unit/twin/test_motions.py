"""Motions beside the scripts: smooth, different from the script, and with the effect they name."""

import shlex

import numpy as np
import pytest

from dextouch.errors import InvalidInputError
from dextouch.geometry import apply
from services.cli.main import main
from services.twin.demonstrators import Motion, MotionScene, with_motion
from services.twin.episodes import record
from services.twin.hands import twin_hand
from services.twin.names import MOTION_KINDS
from services.twin.take_options import TakeOptions

# Faster than this a wrist would leave its command far behind (m a grid step).
MAX_STEP_M = 0.08


def planned(stage, kind, from_step, seed=3):
    plan = stage.plan(seed)
    scene = MotionScene(stage.domain, plan.object_poses)
    draw = np.random.default_rng(seed)
    return plan, with_motion(plan.commands, Motion(kind, from_step), scene, draw)


@pytest.mark.parametrize("kind", MOTION_KINDS)
@pytest.mark.parametrize("from_step", [0, 30, 79])
def test_the_script_is_left_at_the_step_and_smoothly(bottle_stage, kind, from_step):
    plan, changed = planned(bottle_stage, kind, from_step)
    before = slice(0, from_step + 1)
    for name in ("Ts_world_wrist_left", "Ts_world_wrist_right", "joints_right_rad"):
        np.testing.assert_array_equal(
            getattr(changed, name)[before], getattr(plan.commands, name)[before]
        )
    np.testing.assert_array_equal(changed.Ts_world_camera_head, plan.commands.Ts_world_camera_head)
    for Ts in (changed.Ts_world_wrist_left, changed.Ts_world_wrist_right):
        assert np.linalg.norm(np.diff(Ts[:, :3, 3], axis=0), axis=1).max() < MAX_STEP_M
        products = Ts[:, :3, :3] @ np.swapaxes(Ts[:, :3, :3], 1, 2)
        np.testing.assert_allclose(products - np.eye(3), 0.0, atol=1e-9)


def test_the_same_generator_gives_the_same_motion_and_another_another(bottle_stage):
    paths = [planned(bottle_stage, "wander", 0, seed)[1] for seed in (3, 3, 4)]
    first, again, other = (path.Ts_world_wrist_right[40] for path in paths)
    np.testing.assert_array_equal(first, again)
    assert np.abs(first - other).max() > 0.01


def test_retreats_end_where_they_began_or_up_and_away(bottle_stage):
    ends = []
    for seed in range(12):
        plan, changed = planned(bottle_stage, "retreat", 24, seed)
        now, end = changed.Ts_world_wrist_right[[24, 80], :3, 3]
        home = plan.commands.Ts_world_wrist_right[0, :3, 3]
        is_home = np.allclose(end, home, atol=1e-9)
        ends.append(is_home)
        assert is_home or 0.10 <= end[2] - now[2] <= 0.20
    assert 0 < sum(ends) < 12


def test_a_push_passes_through_the_place_of_an_object_above_the_table(bowls_stage):
    lowest_m, nearest_m = [], []
    for seed in range(12):
        plan, changed = planned(bowls_stage, "push", 0, seed)
        points = []
        for side, Ts, joints in (
            ("left", changed.Ts_world_wrist_left, changed.joints_left_rad),
            ("right", changed.Ts_world_wrist_right, changed.joints_right_rad),
        ):
            chains = twin_hand(side, "human").kinematics.chain_points_m(joints).reshape(81, -1, 3)
            points.append(apply(Ts, chains))
        places = np.concatenate(points, axis=1)
        lowest_m.append(places[..., 2].min())
        low = places[places[..., 2] < 0.08]
        gaps = np.linalg.norm(low[:, None, :2] - plan.object_poses[:, :2], axis=2)
        nearest_m.append(gaps.min())
    assert min(lowest_m) > 0.004
    assert max(nearest_m) < 0.05


@pytest.mark.slow
def test_a_push_moves_the_object_and_a_slip_can_drop_it(bottle_stage):
    pushed = [
        record(bottle_stage, seed, TakeOptions(images=(), motion=Motion("push"))) for seed in (0, 3)
    ]
    for take in pushed:
        assert take.attributes.success is False
    way_m = [np.ptp(take.streams["object_poses"].values[:, 0, :3], axis=0).max() for take in pushed]
    assert max(way_m) > 0.05
    slips = [
        record(bottle_stage, seed, TakeOptions(images=(), motion=Motion("slip", 30)))
        for seed in range(5)
    ]
    heights_m = [take.streams["object_poses"].values[:, 0, 2].max() for take in slips]
    assert {take.attributes.success for take in slips} == {True, False}, heights_m


def test_two_flat_palms_let_go_by_going_apart(bowls_stage):
    plan, changed = planned(bowls_stage, "slip", 28)
    gaps = [
        np.linalg.norm(c.Ts_world_wrist_right[:, :3, 3] - c.Ts_world_wrist_left[:, :3, 3], axis=1)
        for c in (plan.commands, changed)
    ]
    wider_m = gaps[1] - gaps[0]
    np.testing.assert_allclose(wider_m[:29], 0.0, atol=1e-12)
    np.testing.assert_allclose(wider_m[31:], wider_m[40], atol=1e-9)
    assert 0.010 <= wider_m[40] <= 0.090


@pytest.mark.long
def test_a_motion_says_how_it_is_made_again(bottle_stage, tmp_path, capsys):
    options = TakeOptions(
        0.004, images=(), motion=Motion("retreat", 33), image_every=2, streams="training"
    )
    take = record(bottle_stage, 8, options)
    assert take.attributes.quality == {"noise_m": 0.004, "miss": 0.0, "retreat_from_step": 33.0}
    told = shlex.split(take.attributes.generator_command)
    summary = tmp_path / "summary.json"
    store = ["--store", str(tmp_path / "store"), "--json", str(summary)]
    assert main([*told[1:], *store]) == 0
    assert f'"{take.attributes.episode_id}"' in summary.read_text()
    capsys.readouterr()


def test_a_motion_that_is_none_is_refused():
    for step in (-1, 80):
        with pytest.raises(InvalidInputError, match="0 … 79"):
            Motion("push", step)
