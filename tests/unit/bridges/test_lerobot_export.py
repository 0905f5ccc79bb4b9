"""Exports against the public specification, and their values against their episodes."""

import json

import av
import numpy as np
import pyarrow.parquet as pq
import pytest
from av.bitstream import BitStreamFilterContext

from dextouch.bridges.lerobot import ExportOptions, export_dataset, exporting, video
from dextouch.episodes import EpisodeStore
from dextouch.errors import ConflictError, InvalidInputError, NotFoundError, ShapeError
from dextouch.hands.actions import action_names, pose_to_9d, poses_from_actions
from tests.unit.bridges.lerobot_episodes import CAMERAS, make_episode
from tests.unit.bridges.lerobot_structure import problems

HEAD_VIDEO = "videos/observation.images.camera_head/chunk-000/file-000.mp4"


@pytest.fixture
def store(tmp_path):
    return EpisodeStore(tmp_path / "store")


@pytest.fixture
def folder(tmp_path):
    return tmp_path / "exports" / "dataset"


def two(store, **changes):
    lengths = {3: 17, 4: 21}
    return [make_episode(seed=s, num_steps=n, **changes).write(store) for s, n in lengths.items()]


def frames(folder):
    table = pq.read_table(folder / "data/chunk-000/file-000.parquet")
    return {name: np.array(table.column(name).to_pylist()) for name in table.column_names}


def sidecar(folder, index=0):
    return json.loads((folder / f"meta/dextouch/episode-{index:06d}.json").read_text())


def units_of(path):
    with av.open(path) as container:
        stream = container.streams.video[0]
        annexb = BitStreamFilterContext("h264_mp4toannexb", stream)
        packets = [packet for packet in container.demux(stream) if packet.size]
        return [b"".join(bytes(part) for part in annexb.filter(packet)) for packet in packets]


def images_of(path):
    with av.open(path) as container:
        decoded = container.decode(video=0)
        return [frame.to_ndarray(format="rgb24", interpolation="BICUBIC") for frame in decoded]


@pytest.mark.long
@pytest.mark.parametrize("fps", [None, 30, 20])
@pytest.mark.parametrize("unit", ["rgb8", "jpeg", "h264"])
def test_exports_hold_to_the_specification(store, folder, unit, fps):
    options = ExportOptions(fps=fps)
    made = export_dataset(two(store, unit=unit), folder, repo_id="lab/touch", options=options)
    assert problems(folder) == []
    assert made.num_frames == {None: 38, 30: 33 + 41, 20: 22 + 27}[fps]
    assert sidecar(folder)["grid"] == {None: "model", 30: "camera", 20: "uniform"}[fps]


def test_one_camera_no_camera_and_measured_actions_only(store, tmp_path):
    readers = two(store, commanded=False)
    for cameras in (("camera_wrist_left",), ()):
        folder = tmp_path / f"with-{len(cameras)}"
        export_dataset(readers, folder, repo_id="touch", options=ExportOptions(cameras=cameras))
        assert problems(folder) == []
    assert "dextouch.action_measured" not in frames(folder)
    np.testing.assert_array_equal(
        frames(folder)["action"][:17], readers[0].read("action").values.astype("f4")
    )


def test_values_are_those_of_the_windows(store, folder):
    readers = two(store)
    export_dataset(readers, folder, repo_id="touch")
    got = frames(folder)
    window = readers[1].window(0, 21, cameras=CAMERAS)
    part = slice(17, 38)
    np.testing.assert_array_equal(got["observation.tactile"][part], window.tactile_kpa)
    np.testing.assert_array_equal(got["dextouch.tactile_valid"][part], window.tactile_valid)
    np.testing.assert_array_equal(got["dextouch.t_ref_ns"][part], window.t_ref_ns)
    for column, camera in enumerate(CAMERAS):
        np.testing.assert_array_equal(
            got["dextouch.image_dt_ns"][part, column], window.image_dt_ns[camera]
        )
        path = folder / f"videos/observation.images.{camera}/chunk-000/file-000.mp4"
        error = np.stack(images_of(path))[part].astype(int) - window.images[camera]
        assert np.abs(error).mean() < 4
    for name, stream in (("action", "action_commanded"), ("dextouch.action_measured", "action")):
        values = readers[1].read(stream).values.astype("f4")
        np.testing.assert_array_equal(got[name][part], values)


def test_state_is_absolute(store, folder):
    readers = two(store)
    export_dataset(readers, folder, repo_id="touch")
    poses = poses_from_actions(
        readers[0].read("action").values, readers[0].attributes.anchor.to_poses()
    )
    state = frames(folder)["observation.state"][:17]
    np.testing.assert_allclose(state[:, :9], pose_to_9d(poses.Ts_world_wrist_left), atol=1e-6)
    np.testing.assert_allclose(state[:, 58:], pose_to_9d(poses.Ts_world_camera_head), atol=1e-6)
    np.testing.assert_allclose(state[:, 18:38], poses.joints_left_rad, atol=1e-6)


def test_every_number_of_an_action_has_its_name():
    names = action_names()
    assert len(names) == len(set(names)) == 67
    assert names[:4] == ["wrist_left.x_m", "wrist_left.y_m", "wrist_left.z_m", "wrist_left.r00"]
    assert names[4:7] == ["wrist_left.r10", "wrist_left.r20", "wrist_left.r01"]
    assert names[18].startswith("l_thumb")
    assert names[38].startswith("r_thumb")
    assert names[58] == "camera_head.x_m"


def test_off_the_model_grid_poses_lie_between_the_steps(store, folder):
    reader = two(store)[0]
    export_dataset([reader], folder, repo_id="touch", options=ExportOptions(fps=30))
    got, measured = frames(folder)["dextouch.action_measured"], reader.read("action").values
    np.testing.assert_allclose(got[::2], measured, atol=1e-6)
    np.testing.assert_allclose(
        got[1::2, 18:58], (measured[1:, 18:58] + measured[:-1, 18:58]) / 2, atol=1e-6
    )
    between = poses_from_actions(got.astype(float), reader.attributes.anchor.to_poses())
    ends = poses_from_actions(measured, reader.attributes.anchor.to_poses())
    middle = (ends.Ts_world_wrist_right[1:, :3, 3] + ends.Ts_world_wrist_right[:-1, :3, 3]) / 2
    np.testing.assert_allclose(between.Ts_world_wrist_right[1::2, :3, 3], middle, atol=1e-6)


def test_the_cameras_own_stamps_are_the_frames(store, folder):
    made = make_episode()
    jitter = np.random.default_rng(5).integers(-4_000_000, 4_000_000, 33)
    made.stamps_ns["camera_head"] = made.stamps_ns["camera_head"] + jitter
    made.stamps_ns["camera_head"][20:] += 33_000_000
    export_dataset([made.write(store)], folder, repo_id="touch", options=ExportOptions(fps=30))
    assert problems(folder) == []
    stamps = made.stamps_ns["camera_head"]
    stamps = stamps[stamps <= 16 / 15 * 1e9 + 0.5e9 / 30]
    got = frames(folder)
    np.testing.assert_array_equal(got["dextouch.t_ref_ns"], stamps)
    assert (got["dextouch.image_dt_ns"][:, 0] == 0).all()
    assert np.abs(got["dextouch.image_dt_ns"][:, 1]).max() > 1_000_000


def test_h264_is_copied_where_every_image_is_taken(store, folder):
    readers = two(store, unit="h264")
    export_dataset(readers, folder, repo_id="touch", options=ExportOptions(fps=30))
    stored = [r.encoded_images("camera_head", 0, r.num_samples("camera_head")) for r in readers]
    assert units_of(folder / HEAD_VIDEO) == stored[0] + stored[1]
    decoded = np.concatenate([reader.images("camera_head") for reader in readers])
    np.testing.assert_array_equal(images_of(folder / HEAD_VIDEO), decoded)
    assert sidecar(folder)["cameras"] == dict.fromkeys(CAMERAS, "remuxed")


def test_h264_is_encoded_anew_where_images_are_left_out(store, folder):
    readers = two(store, unit="h264")
    export_dataset(readers, folder, repo_id="touch")
    assert sidecar(folder)["cameras"] == dict.fromkeys(CAMERAS, "encoded")
    decoded = np.concatenate([reader.images("camera_head")[::2] for reader in readers])
    error = np.array(images_of(folder / HEAD_VIDEO)).astype(int) - decoded
    assert 0 < np.abs(error).mean() < 4


def test_other_parameter_sets_start_another_file(store, folder):
    copied = make_episode(seed=3, unit="h264", camera_hz=15).write(store)
    encoded = make_episode(seed=4, unit="jpeg", camera_hz=15).write(store)
    again = make_episode(seed=5, unit="jpeg", camera_hz=15).write(store)
    export_dataset([copied, encoded, again], folder, repo_id="touch")
    assert problems(folder) == []
    table = pq.read_table(folder / "meta/episodes/chunk-000/file-000.parquet")
    key = "videos/observation.images.camera_head/file_index"
    assert table.column(key).to_pylist() == [0, 1, 1]


def test_large_files_are_followed_by_others(store, folder, monkeypatch):
    monkeypatch.setattr(video, "VIDEO_FILE_MB", 0)
    monkeypatch.setattr(exporting.layout, "DATA_FILE_MB", 0)
    monkeypatch.setattr(exporting, "ROWS_AT_ONCE", 1)
    export_dataset(two(store), folder, repo_id="touch")
    assert problems(folder) == []
    assert sorted(p.name for p in folder.glob("data/*/*")) == [
        "file-000.parquet",
        "file-001.parquet",
    ]
    assert (folder / HEAD_VIDEO.replace("000.mp4", "001.mp4")).is_file()


def test_equal_episodes_give_equal_bytes(store, tmp_path):
    readers = two(store)
    for name in ("first", "second"):
        export_dataset(readers, tmp_path / name, repo_id="touch")
    files = [path for path in (tmp_path / "first").rglob("*") if path.is_file()]
    assert len(files) == 10
    paths = [path.relative_to(tmp_path / "first") for path in files]
    for path in paths:
        assert (tmp_path / "first" / path).read_bytes() == (tmp_path / "second" / path).read_bytes()


def test_what_lerobot_cannot_hold_is_beside_it(store, folder):
    readers = two(store)
    export_dataset(readers, folder, repo_id="touch")
    said = sidecar(folder, 1)
    assert said["content_sha256"] == readers[1].content_sha256
    assert said["attributes"] == readers[1].attributes.model_dump(mode="json")


def _without_images(store):
    made = make_episode()
    for camera in CAMERAS:
        made.stamps_ns[camera], made.values[camera] = (
            made.stamps_ns[camera][:0],
            made.values[camera][:0],
        )
    return [made.write(store)]


def _without_camera(store):
    first, second = make_episode(), make_episode(seed=4)
    second.drop("camera_wrist_left")
    return [first.write(store), second.write(store)]


def _without_actions(store):
    made = make_episode()
    made.drop("action", "action_commanded")
    return [made.write(store)]


def _odd(store):
    made = make_episode(unit="jpeg")
    for camera in CAMERAS:
        made.values[camera] = made.values[camera][:, :47]
    made.descriptors = [
        d.model_copy(update={"shape": (47, 64, 3)}) if d.kind == "image" else d
        for d in made.descriptors
    ]
    return [made.write(store)]


def _mixed(store):
    return [make_episode().write(store), make_episode(seed=4, commanded=False).write(store)]


@pytest.mark.long
@pytest.mark.parametrize(
    ("make", "options", "error", "words"),
    [
        (lambda _: [], {}, InvalidInputError, "no episode"),
        (_without_images, {}, NotFoundError, "camera_head"),
        (_without_camera, {}, InvalidInputError, "camera_wrist_left"),
        (_without_actions, {}, InvalidInputError, "'action'"),
        (_odd, {}, ShapeError, "47"),
        (_mixed, {}, InvalidInputError, "commanded"),
        (two, {"cameras": ("camera_top",)}, InvalidInputError, "camera_top"),
        (two, {"fps": 0}, InvalidInputError, "fps"),
    ],
)
def test_a_refused_export_leaves_nothing(store, folder, make, options, error, words):
    with pytest.raises(error, match=words):
        export_dataset(make(store), folder, repo_id="touch", options=ExportOptions(**options))
    assert not folder.parent.exists() or list(folder.parent.iterdir()) == []


def test_rates_that_are_no_whole_numbers_are_refused(store, folder):
    reader = make_episode().write(store, model_rate_hz=12.5)
    with pytest.raises(InvalidInputError, match="whole frames"):
        export_dataset([reader], folder, repo_id="touch")


def test_an_existing_folder_and_a_strange_name_are_refused(store, folder):
    readers = two(store)
    folder.mkdir(parents=True)
    # No advice that would be refused, too.
    with pytest.raises(ConflictError, match="is not a LeRobot data set; choose another folder"):
        export_dataset(readers, folder, repo_id="touch")
    for name in ("", "a/b/c", "../x", "a b"):
        with pytest.raises(InvalidInputError, match="repo_id"):
            export_dataset(readers, folder.with_name("new"), repo_id=name)


def _without_colours(dtype, unit):
    made = make_episode()
    made.values["camera_wrist_left"] = made.values["camera_wrist_left"][..., 0].astype(dtype)
    changes = {"shape": (48, 64), "dtype": dtype, "unit": unit}
    made.descriptors = [
        d.model_copy(update=changes) if d.name == "camera_wrist_left" else d
        for d in made.descriptors
    ]
    return made


@pytest.mark.parametrize(("dtype", "unit"), [("uint8", "mono8"), ("uint16", "mm")])
def test_cameras_without_colours_are_left_out_unless_chosen(store, folder, dtype, unit):
    reader = _without_colours(dtype, unit).write(store)
    made = export_dataset([reader], folder, repo_id="touch")
    assert made.cameras_left_out == ("camera_wrist_left",)
    assert problems(folder) == []
    assert not (folder / "videos/observation.images.camera_wrist_left").exists()
    chosen = ExportOptions(cameras=("camera_wrist_left",), existing="replace")
    with pytest.raises(ShapeError, match=rf"'camera_wrist_left': got {dtype} \[48, 64\]"):
        export_dataset([reader], folder, repo_id="touch", options=chosen)
