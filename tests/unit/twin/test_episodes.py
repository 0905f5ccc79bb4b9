"""Truth episodes: the streams that were agreed on, the same bytes for the same seed."""

import hashlib
import shlex

import numpy as np
import pytest

from dextouch.episodes import EpisodeStore
from dextouch.errors import InvalidInputError, ShapeError, UnknownNameError
from dextouch.geometry import interpolate_poses, pose_from_transform, transform_from_pose
from dextouch.hands.actions import IDENTITY_POSE_9D
from services.cli.main import main
from services.twin.demonstrators import Motion
from services.twin.episodes import record, write_episode
from services.twin.names import MOTION_KINDS
from services.twin.settings import TwinSettings
from services.twin.simulation import Simulation
from services.twin.stage import Stage
from services.twin.take_options import PlayedActions, TakeOptions, episode_id

HEAD_ONLY = TakeOptions(images=("camera_head",))
BLIND = TakeOptions(images=())
COMMON = {
    "tactile_left": (321, 320),
    "tactile_right": (321, 320),
    "wrist_left": (534, 7),
    "wrist_right": (534, 7),
    "head": (534, 7),
    "camera_head": (161, 64, 64, 3),
    "action": (81, 67),
}
ROBOT = COMMON | {
    "object_poses": (534, 1, 7),
    "joints_measured": (534, 40),
    "joints_commanded": (534, 40),
    "wrist_left_commanded": (534, 7),
    "wrist_right_commanded": (534, 7),
    "action_commanded": (81, 67),
}
HUMAN = COMMON | {
    "object_poses": (534, 2, 7),
    "keypoints_left": (641, 25, 3),
    "keypoints_right": (641, 25, 3),
}


def digest(episode) -> str:
    sha = hashlib.sha256()
    for name, stream in sorted(episode.streams.items()):
        sha.update(name.encode() + stream.t_ref_ns.tobytes() + stream.values.tobytes())
    return sha.hexdigest()


@pytest.fixture(scope="module")
def robot_take(bottle_stage):
    return record(bottle_stage, 3, HEAD_ONLY)


@pytest.fixture(scope="module")
def human_take(bowls_stage):
    return record(bowls_stage, 3, HEAD_ONLY)


@pytest.mark.long
@pytest.mark.parametrize("domain", ["robot", "human"])
def test_an_episode_has_the_agreed_streams(robot_take, human_take, domain):
    episode, expected = (robot_take, ROBOT) if domain == "robot" else (human_take, HUMAN)
    assert {name: stream.values.shape for name, stream in episode.streams.items()} == expected
    for stream in episode.streams.values():
        assert stream.t_ref_ns[0] == 0
        assert stream.values.dtype == stream.descriptor.numpy_dtype()
        period_ns = 1e9 / stream.descriptor.nominal_rate_hz
        assert np.abs(np.diff(stream.t_ref_ns) - period_ns).max() <= 1
    assert episode.attributes.success is True
    assert episode.attributes.domain == domain


def test_actions_are_relative_to_what_is_measured_at_step_0(robot_take):
    for name in ("action", "action_commanded"):
        first = robot_take.streams[name].values[0]
        for start in (0, 9, 58):
            np.testing.assert_allclose(first[start : start + 9], IDENTITY_POSE_9D, atol=1e-12)
    gap = robot_take.streams["action_commanded"].values - robot_take.streams["action"].values
    assert 1e-3 < np.abs(gap[:, 9:12]).max() < 0.05


@pytest.mark.long
def test_the_same_seed_gives_the_same_bytes_on_a_fresh_stage(robot_take):
    again = record(Stage("stand_bottle", "robot", TwinSettings()), 3, HEAD_ONLY)
    assert digest(again) == digest(robot_take)
    assert again.attributes == robot_take.attributes


def _interpolated_one_by_one(self, target):
    """How a simulation interpolates commands, a body at a time."""
    weight = np.arange(1, 9) / 8
    before = transform_from_pose(self.commanded_poses())
    Ts = [
        interpolate_poses(np.stack(pair), np.zeros(8, dtype=np.int64), weight)
        for pair in zip(before, target.Ts_world_x, strict=True)
    ]
    q = self.commanded_joints_rad()
    joints = q + weight[:, None, None] * (target.joints_rad - q)
    return pose_from_transform(np.stack(Ts, axis=1)), joints


@pytest.mark.slow
def test_bodies_interpolated_together_give_the_bytes_of_each_by_itself(
    bottle_stage, bowls_stage, robot_take, human_take, monkeypatch
):
    monkeypatch.setattr(Simulation, "_interpolated", _interpolated_one_by_one)
    assert digest(record(bottle_stage, 3, HEAD_ONLY)) == digest(robot_take)
    assert digest(record(bowls_stage, 3, HEAD_ONLY)) == digest(human_take)


@pytest.mark.long
def test_another_seed_gives_another_take(bottle_stage, robot_take):
    assert digest(record(bottle_stage, 4, HEAD_ONLY)) != digest(robot_take)


@pytest.mark.long
def test_cameras_that_are_not_asked_for_change_nothing_else(bottle_stage, robot_take):
    blind = record(bottle_stage, 3, BLIND)
    assert "camera_head" not in blind.streams
    for name, stream in blind.streams.items():
        assert stream.values.tobytes() == robot_take.streams[name].values.tobytes()


def test_a_miss_keeps_the_motion_and_loses_the_touch(bottle_stage, robot_take):
    miss = record(bottle_stage, 3, TakeOptions(miss=True, images=()))
    commanded = miss.streams["action_commanded"].values
    assert commanded.tobytes() == robot_take.streams["action_commanded"].values.tobytes()
    assert miss.attributes.success is False
    assert miss.pad_forces_n.sum() < 0.2 * robot_take.pad_forces_n.sum()


@pytest.mark.long
def test_a_frozen_take_stops_where_it_is(bottle_stage, robot_take):
    frozen = record(bottle_stage, 3, TakeOptions(images=(), frozen_from_step=30))
    commanded = frozen.streams["action_commanded"].values
    whole = robot_take.streams["action_commanded"].values
    np.testing.assert_array_equal(commanded[:31], whole[:31])
    assert (commanded[31:] == whole[30]).all()
    wrist_m = frozen.streams["action"].values[:, 9:12]
    assert np.abs(wrist_m[-1] - wrist_m[45]).max() < 0.01 < np.abs(wrist_m[30] - wrist_m[0]).max()
    assert frozen.attributes.success is False
    assert frozen.attributes.generator_command.endswith("--freeze-from 30")


def test_pads_press_while_the_bottle_is_held(robot_take):
    held = robot_take.pad_forces_n[round(2.0 * 60), 1]
    assert held[0] > 1.0
    assert held[1:5].sum() > 1.0
    assert not robot_take.pad_forces_n[:, 0].any()
    assert not robot_take.pad_forces_n[0].any()


def test_an_episode_goes_through_the_store(robot_take, tmp_path):
    store = EpisodeStore(tmp_path)
    stored = store.open(write_episode(store, robot_take))
    window = stored.window(start=0, num_steps=17)
    np.testing.assert_array_equal(
        window.images["camera_head"], robot_take.streams["camera_head"].values[:33:2]
    )
    np.testing.assert_allclose(window.actions, robot_take.streams["action"].values[:17], atol=1e-9)


def test_ids_differ_for_every_way_to_make_an_episode():
    options = [TakeOptions(), TakeOptions(noise_m=0.01), TakeOptions(miss=True)]
    options += [TakeOptions(frozen_from_step=step) for step in (0, 40)]
    options += [TakeOptions(motion=Motion(kind, step)) for kind in MOTION_KINDS for step in (0, 9)]
    options += [TakeOptions(actions_of_seed=3), TakeOptions(image_every=4)]
    options += [TakeOptions(streams="training")]
    ids = [episode_id("stand_bottle", "robot", 1, option) for option in options]
    ids.append(episode_id("stand_bottle", "robot", 1, TakeOptions(), played="mine"))
    assert len(set(ids)) == len(ids) == 17


@pytest.mark.long
def test_images_of_every_fourth_step_and_the_last_three(bottle_stage, robot_take):
    options = TakeOptions(images=("camera_head",), image_every=4, streams="training")
    lean = record(bottle_stage, 3, options)
    steps = [*range(0, 77, 4), 78, 79, 80]
    images, whole = lean.streams["camera_head"], robot_take.streams["camera_head"]
    np.testing.assert_array_equal(images.values, whole.values[::2][steps])
    np.testing.assert_array_equal(images.t_ref_ns, lean.streams["action"].t_ref_ns[steps])
    assert set(lean.streams) == {
        "camera_head", "tactile_left", "tactile_right", "object_poses", "action", "action_commanded"
    }  # fmt: skip
    for name in ("tactile_right", "action", "action_commanded"):
        assert lean.streams[name].values.tobytes() == robot_take.streams[name].values.tobytes()
    # 100 Hz and 15 Hz meet every fifth of a second.
    np.testing.assert_array_equal(
        lean.streams["object_poses"].values[::3],
        robot_take.streams["object_poses"].values[::20],
    )


@pytest.mark.long
def test_actions_of_another_seed_are_those_of_its_own_take(bottle_stage, robot_take):
    take = record(bottle_stage, 5, TakeOptions(images=(), actions_of_seed=3))
    own = robot_take.streams["action_commanded"].values
    np.testing.assert_allclose(take.streams["action_commanded"].values, own, atol=1e-12)
    assert take.attributes.success is False
    assert take.attributes.generator_command.endswith("--actions-of 3")
    assert take.attributes.quality["actions_of_seed"] == 3


@pytest.mark.long
def test_played_actions_repeat_the_take_they_come_from(bottle_stage, robot_take):
    actions = robot_take.streams["action_commanded"].values
    again = record(bottle_stage, 3, BLIND, played=PlayedActions("mine", actions, "by hand"))
    assert again.attributes.episode_id == "twin-stand_bottle-robot-000003-by_mine"
    assert again.attributes.generator_command == "by hand"
    for name, stream in again.streams.items():
        assert stream.values.tobytes() == robot_take.streams[name].values.tobytes()
    with pytest.raises(InvalidInputError, match="named 'Mine'"):
        PlayedActions("Mine", actions, "by hand")
    with pytest.raises(ShapeError, match="80 played actions"):
        PlayedActions("mine", actions[1:], "by hand")


def test_bad_requests_are_refused(bottle_stage):
    with pytest.raises(InvalidInputError, match="noise"):
        bottle_stage.plan(0, noise_m=1.0)
    with pytest.raises(InvalidInputError, match="seed"):
        bottle_stage.plan(-1)
    for step in (-1, 81):
        with pytest.raises(InvalidInputError, match=r"frozen from step .*0 … 80"):
            TakeOptions(frozen_from_step=step)
    with pytest.raises(InvalidInputError, match="at most one"):
        TakeOptions(frozen_from_step=3, actions_of_seed=4)
    with pytest.raises(InvalidInputError, match=r"every 0 steps, expected 1 … 80"):
        TakeOptions(image_every=0)
    with pytest.raises(UnknownNameError, match="camera_head"):
        TakeOptions(images=("camera_foot",))
    with pytest.raises(UnknownNameError, match="stand_bottle"):
        Stage("juggle", "robot", TwinSettings())


@pytest.mark.long
def test_the_command_line_records_and_says_so(tmp_path, capsys):
    summary = tmp_path / "summary.json"
    arguments = [
        "twin",
        "record",
        "--task",
        "stack_bowls",
        "--seeds",
        "7:8",
        "--cameras",
        "camera_head",
    ]
    status = main([*arguments, "--store", str(tmp_path / "store"), "--json", str(summary)])
    assert status == 0
    assert "twin-stack_bowls-robot-000007" in summary.read_text()
    assert EpisodeStore(tmp_path / "store").open("twin-stack_bowls-robot-000007")
    # The same again keeps it; other options that give the same id are refused.
    capsys.readouterr()
    assert main([*arguments, "--store", str(tmp_path / "store")]) == 0
    assert "1 existed already" in capsys.readouterr().out
    told = shlex.split(
        EpisodeStore(tmp_path / "store")
        .open("twin-stack_bowls-robot-000007")
        .attributes.generator_command
    )
    assert main([*told[1:], "--store", str(tmp_path / "store")]) == 0
    others = [*arguments[:-1], "camera_wrist_left", "--store", str(tmp_path / "store")]
    assert main(others) == 3
    assert "exists already" in capsys.readouterr().err
