"""UMI zip: read by zarr-python as it stands."""

from dataclasses import replace

import numpy as np
import pytest
import zarr

from dextouch.bridges.umi import export_umi
from dextouch.episodes import EpisodeReader, EpisodeStore
from dextouch.errors import ConflictError, InvalidInputError
from dextouch.geometry.rotations import rotation_from_vector
from dextouch.hands.actions import poses_from_actions
from tests.unit.bridges.lerobot_episodes import make_episode
from tests.unit.bridges.takes import CAMERAS, write_episode


@pytest.fixture
def store(tmp_path):
    return EpisodeStore(tmp_path / "store")


@pytest.fixture
def two(store):
    return [
        write_episode(store, "first", num_steps=40, seed=1),
        write_episode(store, "second", num_steps=13, seed=2),
    ]


def opened(path):
    return zarr.open_group(zarr.storage.ZipStore(path, mode="r"), mode="r")


def test_zarr_python_reads_the_layout_of_a_replay_buffer(two, tmp_path):
    assert export_umi(two, tmp_path / "take.zarr.zip") == 53
    group = opened(tmp_path / "take.zarr.zip")
    assert group["meta/episode_ends"][:].tolist() == [40, 53]
    assert {a.shape[0] for _, a in group["data"].arrays()} == {53}
    start = 0
    for reader in two:
        stop = start + reader.num_steps
        window = reader.window(0, reader.num_steps, cameras=CAMERAS)
        for index, camera in enumerate(("camera_wrist_left", "camera_wrist_right", "camera_head")):
            images = group[f"data/camera{index}_rgb"]
            assert images.attrs["stream"] == camera
            np.testing.assert_array_equal(images[start:stop], window.images[camera])
        np.testing.assert_array_equal(group["data/tactile"][start:stop], window.tactile_kpa)
        np.testing.assert_array_equal(group["data/tactile_valid"][start:stop], window.tactile_valid)
        actions = reader.read("action")
        np.testing.assert_array_equal(group["data/action"][start:stop], actions.values)
        np.testing.assert_array_equal(group["data/t_ref_ns"][start:stop], actions.t_ref_ns)
        poses = poses_from_actions(actions.values, reader.attributes.anchor.to_poses())
        hands = (poses.Ts_world_wrist_left, poses.Ts_world_wrist_right)
        joints = (poses.joints_left_rad, poses.joints_right_rad)
        for index, (Ts, angles) in enumerate(zip(hands, joints, strict=True)):
            data = {
                name: group[f"data/robot{index}_{name}"][start:stop]
                for name in ("eef_pos", "eef_rot_axis_angle", "joint_pos", "demo_end_pose")
            }
            np.testing.assert_array_equal(data["eef_pos"], Ts[:, :3, 3].astype("f4"))
            R = rotation_from_vector(data["eef_rot_axis_angle"].astype("f8"))
            np.testing.assert_allclose(R, Ts[:, :3, :3], atol=1e-6)
            np.testing.assert_array_equal(data["joint_pos"], angles.astype("f4"))
            np.testing.assert_array_equal(
                data["demo_end_pose"][:, :3], np.tile(Ts[-1, :3, 3], (len(Ts), 1))
            )
        start = stop


@pytest.mark.long
def test_equal_episodes_give_equal_bytes(two, tmp_path):
    export_umi(two, tmp_path / "one.zip")
    export_umi(two, tmp_path / "two.zip")
    assert (tmp_path / "one.zip").read_bytes() == (tmp_path / "two.zip").read_bytes()


def test_commands_beside_the_grid_of_actions_are_refused(two, tmp_path, monkeypatch):
    read = EpisodeReader.read

    def beside(reader, stream, *span):
        batch = read(reader, stream, *span)
        shift_ns = 1 if stream == "action_commanded" else 0
        return replace(batch, t_ref_ns=batch.t_ref_ns + shift_ns)

    monkeypatch.setattr(EpisodeReader, "read", beside)
    with pytest.raises(InvalidInputError, match="not on the grid"):
        export_umi(two, tmp_path / "take.zarr.zip")


def test_episodes_of_other_rates_are_refused(store, tmp_path):
    made = [make_episode(seed=seed, num_steps=3) for seed in (1, 2)]
    readers = [made[0].write(store), made[1].write(store, model_rate_hz=30.0)]
    with pytest.raises(InvalidInputError, match=r"-0002: got .*30.0.* expected .*15.0"):
        export_umi(readers, tmp_path / "take.zip")


def test_episodes_that_do_not_fit_together_are_refused(store, tmp_path):
    path = tmp_path / "take.zip"
    readers = [write_episode(store, "all"), write_episode(store, "one", cameras=("camera_head",))]
    with pytest.raises(InvalidInputError, match="one"):
        export_umi(readers, path)
    with pytest.raises(InvalidInputError, match="no episode"):
        export_umi([], path)
    assert [p.name for p in tmp_path.iterdir()] == ["store"]
    export_umi(readers[1:], path)
    assert "camera1_rgb" not in opened(path)["data"]
    with pytest.raises(ConflictError):
        export_umi(readers[1:], path)
    export_umi(readers[1:], path, overwrite=True)
