"""UMI zip: read by zarr-python as it stands, back into a store, and refused when foreign."""

import json
import tracemalloc
import zipfile
from contextlib import closing
from dataclasses import replace

import numpy as np
import pytest
import zarr
from numcodecs import Zstd

from dextouch.bridges.umi import export_umi, import_umi
from dextouch.bridges.umi.zarr_zip import ZarrZipReader, ZarrZipWriter
from dextouch.episodes import EpisodeReader, EpisodeStore
from dextouch.errors import (
    ConflictError,
    CorruptDataError,
    DexTouchError,
    InvalidInputError,
    LimitExceededError,
    NotFoundError,
    StorageError,
)
from dextouch.geometry.rotations import rotation_from_vector
from dextouch.hands.actions import poses_from_actions
from tests.unit.bridges.takes import CAMERAS, write_episode


@pytest.fixture
def store(tmp_path):
    return EpisodeStore(tmp_path / "store")


@pytest.fixture
def other(tmp_path):
    return EpisodeStore(tmp_path / "other")


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


def test_what_is_on_the_grid_comes_back(two, other, tmp_path):
    export_umi(two, tmp_path / "take.zarr.zip")
    assert import_umi(tmp_path / "take.zarr.zip", other) == ["first", "second"]
    for reader in two:
        again = other.open(reader.attributes.episode_id)
        assert again.verify()
        before = reader.window(0, reader.num_steps, cameras=CAMERAS)
        after = again.window(0, reader.num_steps, cameras=CAMERAS)
        for name in ("tactile_kpa", "tactile_valid", "actions", "t_ref_ns"):
            np.testing.assert_array_equal(getattr(after, name), getattr(before, name))
        for camera in CAMERAS:
            np.testing.assert_array_equal(after.images[camera], before.images[camera])
            np.testing.assert_array_equal(after.image_dt_ns[camera], before.image_dt_ns[camera])
        commanded = again.read("action_commanded").values
        np.testing.assert_array_equal(commanded, reader.read("action_commanded").values)
        assert again.attributes.lineage[-1].sha256 == reader.content_sha256
        assert again.attributes.anchor == reader.attributes.anchor
        assert again.attributes.quality == reader.attributes.quality
    with pytest.raises(ConflictError):
        import_umi(tmp_path / "take.zarr.zip", other)


def test_exporting_again_gives_the_same_arrays(two, other, tmp_path):
    export_umi(two, tmp_path / "one.zip")
    import_umi(tmp_path / "one.zip", other)
    export_umi([other.open("first"), other.open("second")], tmp_path / "two.zip")
    one, again = opened(tmp_path / "one.zip")["data"], opened(tmp_path / "two.zip")["data"]
    for name, array in one.arrays():
        np.testing.assert_array_equal(again[name][:], array[:])


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


def test_episodes_that_do_not_fit_together_are_refused(store, tmp_path):
    path = tmp_path / "take.zip"
    readers = [write_episode(store, "all"), write_episode(store, "one", cameras=("camera_head",))]
    with pytest.raises(InvalidInputError, match="one"):
        export_umi(readers, path)
    with pytest.raises(InvalidInputError, match="no episode"):
        export_umi([], path)
    assert not path.exists()
    export_umi(readers[1:], path)
    assert "camera1_rgb" not in opened(path)["data"]
    with pytest.raises(ConflictError):
        export_umi(readers[1:], path)
    export_umi(readers[1:], path, overwrite=True)


def rewritten(path, change):
    """The same zip file with its entries changed by a function of their dictionary."""
    with zipfile.ZipFile(path) as archive:
        entries = {name: archive.read(name) for name in archive.namelist()}
    change(entries)
    with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED) as archive:
        for name, data in entries.items():
            archive.writestr(name, data)


def edit(entries, key, **changes):
    entries[key] = json.dumps(json.loads(entries[key]) | changes).encode()


@pytest.mark.parametrize(
    ("change", "error"),
    [
        (lambda e: e.pop("data/action/0.0"), CorruptDataError),
        (lambda e: e.update({"data/action/0.0": b"no zstd"}), CorruptDataError),
        (lambda e: e.update({"data/action/0.0": Zstd().encode(b"short")}), CorruptDataError),
        (
            lambda e: e.update({"data/camera0_rgb/3.0.0.0": Zstd().encode(b"\0" * (1 << 24))}),
            CorruptDataError,
        ),
        (lambda e: e.update({"data/action/.zarray": b"{"}), CorruptDataError),
        (lambda e: edit(e, "data/action/.zarray", chunks=[1 << 20, 67]), LimitExceededError),
        (lambda e: edit(e, "data/action/.zarray", shape=[-1, 67]), CorruptDataError),
        (lambda e: edit(e, "data/action/.zarray", dtype="|O"), CorruptDataError),
        (
            lambda e: edit(e, "data/camera0_rgb/.zarray", compressor={"id": "imagecodecs_jpegxl"}),
            StorageError,
        ),
        (lambda e: edit(e, "meta/episode_ends/.zarray", shape=[7]), CorruptDataError),
        (lambda e: e.pop("meta/.zattrs"), InvalidInputError),
        (lambda e: edit(e, "meta/.zattrs", dextouch={"layout_version": 9}), StorageError),
        (
            lambda e: edit(
                e,
                "meta/.zattrs",
                dextouch={"layout_version": 1, "cameras": ["../x"], "episodes": []},
            ),
            CorruptDataError,
        ),
        (lambda e: e.update({"../../evil": b""}), CorruptDataError),
        (lambda e: e.update({"/etc/passwd": b""}), CorruptDataError),
        (lambda e: e.update({"data\\..\\x": b""}), CorruptDataError),
    ],
)
def test_damage_and_tricks_are_refused(change, error, store, other, tmp_path):
    path = tmp_path / "take.zip"
    export_umi([write_episode(store, "all", num_steps=5)], path)
    rewritten(path, lambda entries: None)
    import_umi(path, other)
    other.delete("all")
    rewritten(path, change)
    with pytest.raises(error, match=r"take\.zip"):
        import_umi(path, other)
    assert other.list() == []


def test_an_episode_without_end_is_refused(store, other, tmp_path, monkeypatch):
    path = tmp_path / "take.zip"
    export_umi([write_episode(store, "all", num_steps=5)], path)
    monkeypatch.setattr("dextouch.bridges.umi.replay_buffer.MAX_STEPS", 4)
    with pytest.raises(LimitExceededError, match="5 steps"):
        import_umi(path, other)


def test_a_storage_chunk_is_unfolded_no_further_than_its_size(store, tmp_path):
    path = tmp_path / "take.zip"
    export_umi([write_episode(store, "all", num_steps=5)], path)
    bomb = Zstd().encode(b"\0" * (1 << 26))
    rewritten(path, lambda e: e.update({"data/camera0_rgb/3.0.0.0": bomb}))
    with closing(ZarrZipReader(path)) as archive:
        archive.metadata("data/camera0_rgb")
        tracemalloc.start()
        try:
            with pytest.raises(CorruptDataError, match="or more"):
                archive.read("data/camera0_rgb", 3, 4)
            assert tracemalloc.get_traced_memory()[1] < 1 << 23
        finally:
            tracemalloc.stop()


def test_a_deflated_bomb_is_not_unfolded(store, other, tmp_path, monkeypatch):
    path = tmp_path / "take.zip"
    export_umi([write_episode(store, "all", num_steps=5)], path)
    rewritten(path, lambda e: e.update({"data/action/0.0": b"\0" * (1 << 26)}))
    assert path.stat().st_size < 1 << 20
    monkeypatch.setattr("dextouch.bridges.umi.zarr_zip.MAX_CHUNK_BYTES", 1 << 20)
    tracemalloc.start()
    try:
        with pytest.raises(LimitExceededError, match=r"data/action/0\.0"):
            import_umi(path, other)
        assert tracemalloc.get_traced_memory()[1] < 1 << 23
    finally:
        tracemalloc.stop()


def test_files_that_are_no_zip_are_refused(other, tmp_path):
    path = tmp_path / "take.zip"
    with pytest.raises(NotFoundError):
        import_umi(path, other)
    path.write_bytes(b"no zip at all")
    with pytest.raises(CorruptDataError):
        import_umi(path, other)


def test_a_truncated_or_flipped_file_never_gives_wrong_numbers(store, other, tmp_path):
    path = tmp_path / "take.zip"
    reader = write_episode(store, "all", num_steps=5, cameras=("camera_head",))
    export_umi([reader], path)
    data = path.read_bytes()
    rng = np.random.default_rng(8)
    damaged = [data[: int(at)] for at in rng.integers(0, len(data), 5)]
    for at in rng.integers(0, len(data), 15):
        flipped = bytearray(data)
        flipped[at] ^= 0x10
        damaged.append(bytes(flipped))
    for bad in damaged:
        path.write_bytes(bad)
        try:
            import_umi(path, other)
        except DexTouchError:
            assert other.list() == []
        else:
            again = other.open("all").read("action").values
            np.testing.assert_array_equal(again, reader.read("action").values)
            other.delete("all")


def test_rows_across_storage_chunks_and_empty_slices(tmp_path):
    rows = np.arange(30, dtype=np.int64).reshape(10, 3)
    writer = ZarrZipWriter(tmp_path / "x.zip")
    for start in (0, 1, 7):
        writer.append("data/x", rows[start : {0: 1, 1: 7, 7: 10}[start]], chunk_rows=4)
    for wrong in (np.zeros((2, 4), dtype=np.int64), np.zeros((2, 3))):
        with pytest.raises(InvalidInputError, match="data/x"):
            writer.append("data/x", wrong)
    writer.finish({})
    with closing(ZarrZipReader(tmp_path / "x.zip")) as archive:
        for start, stop in ((0, 10), (3, 9), (4, 8), (5, 5), (10, 10)):
            np.testing.assert_array_equal(archive.read("data/x", start, stop), rows[start:stop])
        with pytest.raises(InvalidInputError):
            archive.read("data/x", 0, 11)
    np.testing.assert_array_equal(opened(tmp_path / "x.zip")["data/x"][:], rows)
