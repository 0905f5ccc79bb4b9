"""Rerun: every sample of a file is what the store holds, as Rerun's own reader gives it back."""

import resource
import warnings

import numpy as np
import pytest

rr = pytest.importorskip("rerun", reason="rerun-sdk is not installed: pip install '.[rerun]'")

from dextouch.bridges import import_rerun  # noqa: E402
from dextouch.bridges.export_files import heat_map  # noqa: E402
from dextouch.bridges.import_recording import ImportAttributes  # noqa: E402
from dextouch.bridges.import_rerun import import_rrd  # noqa: E402
from dextouch.bridges.rerun import entity_of, export_rrd  # noqa: E402
from dextouch.episodes import EpisodeStore  # noqa: E402
from dextouch.errors import ConflictError, InvalidInputError, StorageError  # noqa: E402
from dextouch.geometry import transform_from_pose  # noqa: E402
from tests.unit.bridges.takes import (  # noqa: E402
    DISTORTION,
    K_HEAD,
    descriptor,
    write_episode,
    write_recording,
)


@pytest.fixture
def store(tmp_path):
    return EpisodeStore(tmp_path / "store")


def columns_of(path):
    """Per entity its stamps and components over time, and those that never change."""
    moving, still = {}, {}
    for chunk in rr.chunk.RrdReader(path).stream():
        batch = chunk.to_record_batch()
        columns = {
            name: batch.column(name).to_pylist() for name in batch.schema.names if ":" in name
        }
        if chunk.is_static:
            still.setdefault(chunk.entity_path[1:], {}).update(columns)
            continue
        timeline = chunk.timeline_names[0]
        columns[timeline] = batch.column(timeline).cast("int64").to_pylist()
        known = moving.setdefault(chunk.entity_path[1:], {})
        for name, values in columns.items():
            known.setdefault(name, []).extend(values)
    for columns in moving.values():
        timeline = next(name for name in columns if ":" not in name)
        order = np.argsort(columns[timeline], kind="stable")
        for name in columns:
            columns[name] = [columns[name][i] for i in order]
    return moving, still


def one(values):
    """The only instance of every row."""
    assert {len(row) for row in values} == {1}
    return np.array([row[0] for row in values])


def test_an_episode_is_there_whole(store, tmp_path):
    reader = write_episode(store, num_steps=21)
    num_samples = export_rrd(reader, tmp_path / "take.rrd")
    assert num_samples == sum(reader.num_samples(name) for name in reader.streams)
    moving, still = columns_of(tmp_path / "take.rrd")
    for name, stream in reader.streams.items():
        if name == "object_poses":
            continue
        stamps = reader.read(name).t_ref_ns
        assert moving[entity_of(stream)]["t_ref"] == stamps.tolist(), name
    images = reader.read("camera_head").values
    shown = one(moving["world/camera_head/image"]["Image:buffer"])
    np.testing.assert_array_equal(shown.reshape(images.shape), images)
    format_ = still["world/camera_head/image"]["Image:format"][0][0]
    assert (format_["width"], format_["height"]) == (64, 64)
    joints = np.array(moving["numbers/joints_measured"]["Scalars:scalars"])
    np.testing.assert_array_equal(joints, reader.read("joints_measured").values)
    points = np.array(moving["world/wrist_left/keypoints_left"]["Points3D:positions"])
    expected = reader.read("keypoints_left").values
    np.testing.assert_array_equal(points, expected.astype(np.float32))


def test_poses_and_the_camera_stand_where_they_were(store, tmp_path):
    reader = write_episode(store)
    export_rrd(reader, tmp_path / "take.rrd")
    moving, still = columns_of(tmp_path / "take.rrd")
    expected = {
        "world/wrist_left": reader.read("wrist_left").values,
        "world/camera_head": reader.read("head").values,
        "world/object_poses/1": reader.read("object_poses").values[:, 1],
    }
    for entity, poses in expected.items():
        q_xyzw = one(moving[entity]["Transform3D:quaternion"])
        t = one(moving[entity]["Transform3D:translation"])
        shown = np.concatenate([t, q_xyzw[:, [3, 0, 1, 2]]], axis=1)
        T, T_shown = transform_from_pose(poses), transform_from_pose(shown)
        np.testing.assert_allclose(T_shown, T, atol=1e-6)
    pinhole = still["world/camera_head/image"]["Pinhole:image_from_camera"][0][0]
    np.testing.assert_allclose(np.reshape(pinhole, (3, 3)).T, K_HEAD)


def test_touch_is_drawn_as_a_hand(store, tmp_path):
    reader = write_episode(store)
    export_rrd(reader, tmp_path / "take.rrd")
    moving, _ = columns_of(tmp_path / "take.rrd")
    shown = one(moving["tactile/tactile_right"]["Image:buffer"])
    row = reader.read("tactile_right").values[7]
    expected = heat_map(row, side="right", full_scale=40.0)
    np.testing.assert_array_equal(shown[7].reshape(28, 26, 3), expected)
    mirrored = heat_map(row, side="left", full_scale=40.0)
    assert not np.array_equal(mirrored, expected)


@pytest.mark.parametrize(
    ("unit", "column"), [("jpeg", "EncodedImage:blob"), ("h264", "VideoStream:sample")]
)
def test_encoded_images_are_copied_as_they_are(unit, column, store, tmp_path):
    reader = write_episode(store, unit=unit)
    export_rrd(reader, tmp_path / "take.rrd")
    moving, _ = columns_of(tmp_path / "take.rrd")
    entity = moving["world/camera_head/image"]
    stored = reader.encoded_images("camera_head", 0, reader.num_samples("camera_head"))
    assert [bytes(row[0]) for row in entity[column]] == stored
    if unit == "h264":
        keys = one(entity["VideoStream:is_keyframe"])
        assert keys[0]
        assert 0 < keys.sum() < len(keys)


def test_a_recording_is_shown_on_its_own_clock(store, tmp_path):
    reader = write_recording(store)
    export_rrd(reader, tmp_path / "take.rrd")
    moving, still = columns_of(tmp_path / "take.rrd")
    stamps = reader.read("tactile_left").t_host_ns
    assert moving["tactile/tactile_left"]["t_host"] == stamps.tolist()
    assert "take-0001" in still["attributes"]["TextDocument:text"][0][0]
    lens = still["world/camera_head/image"]["dextouch.Lens:distortion_k1_k2_p1_p2_k3"]
    np.testing.assert_array_equal(lens[0], DISTORTION)
    largest = reader.read("tactile_left").values.max()
    shown = one(moving["tactile/tactile_left"]["Image:buffer"])[3].reshape(28, 26, 3)
    row = reader.read("tactile_left").values[3]
    expected = heat_map(row, side="left", full_scale=float(largest), is_raw=True)
    np.testing.assert_array_equal(shown, expected)


def test_existing_files_are_kept_unless_told_otherwise(store, tmp_path):
    path = tmp_path / "take.rrd"
    path.write_bytes(b"mine")
    reader = write_episode(store, num_steps=3)
    with pytest.raises(ConflictError):
        export_rrd(reader, path)
    assert path.read_bytes() == b"mine"
    export_rrd(reader, path, overwrite=True)
    assert [e.recording_id for e in rr.chunk.RrdReader(path).recordings()] == ["stand-bottle-0003"]
    assert len(rr.chunk.RrdReader(path).blueprints()) == 1


def test_warnings_of_others_do_not_discard_an_export(store, tmp_path, monkeypatch):
    def opened(path):
        warnings.warn("this form of arrays is to go", DeprecationWarning, stacklevel=1)
        return rr.chunk.RrdReader(path)

    monkeypatch.setattr(import_rerun, "RrdReader", opened)
    export_rrd(write_episode(store, num_steps=3), tmp_path / "take.rrd")
    assert (tmp_path / "take.rrd").is_file()


def test_errors_of_rerun_do_not_ask_for_space(store, tmp_path, monkeypatch):
    def fail(*_args, **_more):
        raise RuntimeError("no such codec")

    monkeypatch.setattr(rr.RecordingStream, "flush", fail)
    with pytest.raises(StorageError, match=r"take.rrd: no such codec$"):
        export_rrd(write_episode(store, num_steps=3), tmp_path / "take.rrd")


# Files of one episode differ in size: by up to 161 bytes among 14.
@pytest.mark.parametrize("missing", [500, 6_000, 200_000])
def test_a_full_disk_leaves_no_file(missing, store, tmp_path):
    reader = write_episode(store, num_steps=9)
    export_rrd(reader, tmp_path / "whole.rrd")
    limits = resource.getrlimit(resource.RLIMIT_FSIZE)
    least = (tmp_path / "whole.rrd").stat().st_size - missing
    resource.setrlimit(resource.RLIMIT_FSIZE, (least, limits[1]))
    try:
        with pytest.raises(StorageError, match=r"take.rrd: .*(free space and try|shut down)"):
            export_rrd(reader, tmp_path / "take.rrd")
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, limits)
    assert sorted(p.name for p in tmp_path.iterdir()) == ["store", "whole.rrd"]


@pytest.mark.parametrize(("dtype", "unit"), [("uint8", "mono8"), ("uint16", "mm")])
def test_gray_and_depth_images_come_back(dtype, unit, store, tmp_path):
    values = np.arange(2 * 3 * 4, dtype=dtype).reshape(2, 3, 4) * 10
    stream = descriptor("eye", "image", (3, 4), dtype, unit, 30)
    about = write_recording(store).attributes
    about = about.model_copy(update={"recording_id": "eye", "streams": (stream,)})
    with store.writer(kind="recording", attributes=about) as writer:
        times = np.array([0, 10**8])
        none = np.full(2, -1)
        writer.append("eye", values=values, t_host_ns=times, t_device_ns=none, sequence=none)
    export_rrd(store.recording("eye"), tmp_path / "eye.rrd")
    import_rrd(tmp_path / "eye.rrd", store, ImportAttributes(id_prefix="again-"))
    again = store.recording("again-eye")
    np.testing.assert_array_equal(again.values("cameras_eye", 0, 2), values)


def test_images_that_cannot_be_shown_are_refused(store, tmp_path):
    reader = write_episode(store, num_steps=3)
    deep = descriptor("camera_head", "image", (4, 4, 2), "uint8", "uv", 30)
    reader.streams["camera_head"] = deep
    with pytest.raises(InvalidInputError, match="uint8"):
        export_rrd(reader, tmp_path / "take.rrd")
    assert not (tmp_path / "take.rrd").exists()
