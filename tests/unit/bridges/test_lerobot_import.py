"""Datasets back into the store: our own as they were on the grid, others by a mapping of names."""

import shutil

import numpy as np
import pyarrow.parquet as pq
import pytest

from dextouch.bridges.lerobot import (
    ExportOptions,
    ImportOptions,
    export_dataset,
    import_dataset,
)
from dextouch.episodes import EpisodeStore
from dextouch.errors import (
    ConflictError,
    CorruptDataError,
    InvalidInputError,
    UnknownNameError,
)
from dextouch.hands.actions import poses_from_actions
from tests.unit.bridges.lerobot_edits import (
    DATA,
    EPISODES,
    INFO,
    drop_columns,
    edit_column,
    edit_json,
    rename_columns,
    set_item,
)
from tests.unit.bridges.lerobot_episodes import CAMERAS, make_episode
from tests.unit.bridges.lerobot_structure import problems

K_HEAD = ((50.0, 0.0, 32.0), (0.0, 50.0, 24.0), (0.0, 0.0, 1.0))
OURS = ("dextouch.action_measured", "dextouch.tactile_valid", "dextouch.t_ref_ns")


@pytest.fixture
def store(tmp_path):
    return EpisodeStore(tmp_path / "store")


@pytest.fixture
def other(tmp_path):
    return EpisodeStore(tmp_path / "other")


@pytest.fixture
def folder(tmp_path):
    return tmp_path / "dataset"


def two(store, **changes):
    lengths = {3: 17, 4: 21}
    return [make_episode(seed=s, num_steps=n, **changes).write(store) for s, n in lengths.items()]


def foreign(store, folder):
    """A dataset as others write it: their camera's name, no columns and files of ours."""
    export_dataset(two(store), folder, repo_id="touch")
    shutil.rmtree(folder / "meta/dextouch")

    def theirs(name):
        return name.replace("images.camera_head", "images.top")

    def features(info):
        kept = {n: f for n, f in info["features"].items() if not n.startswith("dextouch.")}
        info["features"] = {theirs(name): feature for name, feature in kept.items()}

    edit_json(folder, INFO, features)
    drop_columns(folder, DATA, *OURS, "dextouch.image_dt_ns")
    rename_columns(folder, EPISODES, theirs)
    videos = folder / "videos"
    (videos / "observation.images.camera_head").rename(videos / "observation.images.top")
    return folder


@pytest.mark.long
@pytest.mark.parametrize("unit", ["rgb8", "jpeg", "h264"])
def test_our_own_dataset_gives_back_the_episodes(store, other, folder, unit):
    readers = two(store)
    export_dataset(readers, folder, repo_id="touch")
    assert import_dataset(folder, other, options=ImportOptions(images=unit)).ids == other.list()
    assert other.list() == [reader.attributes.episode_id for reader in readers]
    for reader in readers:
        back = other.open(reader.attributes.episode_id)
        back.verify()
        count = reader.num_steps
        expected, got = (e.window(0, count, cameras=CAMERAS) for e in (reader, back))
        np.testing.assert_array_equal(got.t_ref_ns, expected.t_ref_ns)
        np.testing.assert_array_equal(got.tactile_kpa, expected.tactile_kpa)
        np.testing.assert_array_equal(got.tactile_valid, expected.tactile_valid)
        np.testing.assert_array_equal(got.K_head, expected.K_head)
        assert got.instruction == expected.instruction
        for stream in ("action", "action_commanded"):
            values = reader.read(stream).values.astype(np.float32).astype(np.float64)
            np.testing.assert_array_equal(back.read(stream).values, values)
        for camera in CAMERAS:
            np.testing.assert_array_equal(got.image_dt_ns[camera], expected.image_dt_ns[camera])
            error = got.images[camera].astype(int) - expected.images[camera]
            assert np.abs(error).mean() < 5
            assert back.streams[camera].unit == unit


@pytest.mark.long
def test_cameras_of_any_name_come_back_also_without_that_of_the_head(store, other, folder):
    made = make_episode(num_steps=3)
    made.drop("camera_head")
    for columns in (made.values, made.stamps_ns):
        columns["overview"] = columns.pop("camera_wrist_left")
    made.descriptors = [
        d.model_copy(update={"name": "overview"}) if d.kind == "image" else d
        for d in made.descriptors
    ]
    export_dataset([made.write(store)], folder, repo_id="touch")
    (name,) = import_dataset(folder, other).ids
    assert other.open(name).num_samples("overview") == 3


def test_attributes_come_back_with_the_episode_in_the_lineage(store, other, folder):
    reader = two(store)[0]
    export_dataset([reader], folder, repo_id="touch")
    import_dataset(folder, other)
    back = other.open(reader.attributes.episode_id).attributes
    assert back.lineage[:-1] == reader.attributes.lineage
    assert back.lineage[-1].model_dump() == {
        "kind": "episode",
        "id": reader.attributes.episode_id,
        "sha256": reader.content_sha256,
    }
    for name in set(type(back).model_fields) - {"lineage", "streams"}:
        assert getattr(back, name) == getattr(reader.attributes, name), name


@pytest.mark.long
@pytest.mark.parametrize("fps", [15, 30, 20])
def test_what_was_imported_exports_to_the_same_numbers(store, other, tmp_path, fps):
    options = ExportOptions(fps=fps)
    export_dataset(two(store), tmp_path / "first", repo_id="touch", options=options)
    ids = import_dataset(tmp_path / "first", other, options=ImportOptions(images="rgb8")).ids
    again = [other.open(name) for name in ids]
    export_dataset(again, tmp_path / "second", repo_id="touch", options=options)
    assert problems(tmp_path / "second") == []
    first, second = (pq.read_table(tmp_path / name / DATA) for name in ("first", "second"))
    assert first.column_names == second.column_names
    for name in first.column_names:
        before, after = (np.array(t.column(name).to_pylist()) for t in (first, second))
        np.testing.assert_allclose(after, before, atol=2e-6, err_msg=name)


def test_h264_comes_back_to_the_byte(store, other, folder):
    readers = two(store, unit="h264")
    export_dataset(readers, folder, repo_id="touch", options=ExportOptions(fps=30))
    import_dataset(folder, other)
    for reader in readers:
        back = other.open(reader.attributes.episode_id)
        for camera in CAMERAS:
            count = reader.num_samples(camera)
            stored, copied = (e.encoded_images(camera, 0, count) for e in (reader, back))
            assert copied == stored
            np.testing.assert_array_equal(back.stamps_ns(camera), reader.stamps_ns(camera))


def test_lost_touch_stays_lost_and_repeated_images_come_once(store, other, folder):
    made = make_episode(camera_hz=10)
    keep = np.ones(len(made.stamps_ns["tactile_left"]), dtype=bool)
    keep[9:13] = False
    for arrays in (made.stamps_ns, made.values):
        arrays["tactile_left"] = arrays["tactile_left"][keep]
    reader = made.write(store)
    export_dataset([reader], folder, repo_id="touch")
    import_dataset(folder, other, options=ImportOptions(images="rgb8"))
    back = other.open(reader.attributes.episode_id)
    window = back.window(0, 17)
    assert window.tactile_valid[:, 0].tolist() == [True] * 3 + [False] + [True] * 13
    np.testing.assert_array_equal(window.tactile_kpa, reader.window(0, 17).tactile_kpa)
    np.testing.assert_array_equal(back.stamps_ns("camera_head"), reader.stamps_ns("camera_head"))
    error = back.images("camera_head").astype(int) - reader.images("camera_head")
    assert np.abs(error).mean() < 4


def test_frames_off_the_model_grid_keep_their_absolute_poses(store, other, folder):
    made = make_episode()
    made.stamps_ns["camera_head"] = made.stamps_ns["camera_head"] + 5_000_000
    reader = made.write(store)
    export_dataset([reader], folder, repo_id="touch", options=ExportOptions(fps=30))
    import_dataset(folder, other)
    back = other.open(reader.attributes.episode_id)
    assert back.attributes.model_rate_hz == 30
    np.testing.assert_allclose(
        back.read("action").values[0, :9], [0, 0, 0, 1, 0, 0, 0, 1, 0], atol=1e-6
    )
    state = np.array(pq.read_table(folder / DATA).column("observation.state").to_pylist())
    poses = poses_from_actions(back.read("action").values, back.attributes.anchor.to_poses())
    np.testing.assert_allclose(poses.Ts_world_wrist_left[:, :3, 3], state[:, :3], atol=2e-6)
    sent = poses_from_actions(
        back.read("action_commanded").values, back.attributes.anchor.to_poses()
    )
    moved = np.linalg.norm(sent.Ts_world_wrist_left - poses.Ts_world_wrist_left, axis=(1, 2))
    np.testing.assert_allclose(moved, 0.01 * np.sqrt(3), atol=1e-5)


def test_ids_that_exist_are_refused_and_a_prefix_helps(store, folder):
    readers = two(store)
    export_dataset(readers, folder, repo_id="touch")
    with pytest.raises(ConflictError, match="id_prefix"):
        import_dataset(folder, store)
    ids = import_dataset(folder, store, options=ImportOptions(id_prefix="again-")).ids
    assert ids == [f"again-{reader.attributes.episode_id}" for reader in readers]


@pytest.mark.long
def test_datasets_of_others_come_in_by_a_mapping(store, other, folder):
    readers = two(store)
    shutil.rmtree(store.root)
    foreign(store, folder)
    options = ImportOptions(
        mapping={"camera_head": "observation.images.top"}, K_head=K_HEAD, images="rgb8", task="pour"
    )
    assert import_dataset(folder, other, options=options).ids == [
        "dataset-000000",
        "dataset-000001",
    ]
    back = other.open("dataset-000001")
    said = back.attributes
    assert (said.origin, said.domain, said.task) == ("recorded", "robot", "pour")
    assert said.instruction == "lift the bottle"
    assert said.K_head == K_HEAD
    assert said.lineage[0].id == "lerobot:dataset/episode-000001"
    assert len(said.lineage[0].sha256) == 64
    assert set(back.streams) == {"tactile_left", "tactile_right", "action", *CAMERAS}
    original = make_episode(seed=4, num_steps=21)
    np.testing.assert_allclose(
        back.read("action").values, original.values["action_commanded"], atol=1e-6
    )
    np.testing.assert_array_equal(
        back.stamps_ns("action"), np.rint(np.arange(21) * 1e9 / 15).astype(np.int64)
    )
    np.testing.assert_allclose(
        said.anchor.to_poses().T_world_wrist_left,
        original.trajectory.Ts_world_wrist_left[0],
        atol=1e-6,
    )
    assert len(readers) == 2


@pytest.mark.parametrize("state", ["observation.state", "action"])
def test_actions_come_in_our_order_whatever_that_of_the_file(store, other, folder, state):
    foreign(store, folder)
    order = np.random.default_rng(0).permutation(67)

    def names(info):
        said = info["features"]["action"]
        said["names"] = {"motors": [said["names"][place] for place in order]}

    def values(rows):
        rows[:] = [[row[place] for place in order] for row in rows]

    edit_json(folder, INFO, names)
    edit_column(folder, DATA, "action", values)
    mapping = {"camera_head": "observation.images.top", "state": state}
    options = ImportOptions(mapping=mapping, K_head=K_HEAD)
    (_, second) = import_dataset(folder, other, options=options).ids
    original = make_episode(seed=4, num_steps=21).values["action_commanded"]
    np.testing.assert_allclose(other.open(second).read("action").values, original, atol=1e-6)


def test_without_a_head_camera_it_is_a_recording_and_the_reason_is_said(store, other, folder):
    foreign(store, folder)
    result = import_dataset(folder, other)
    assert result.kind == "recording"
    assert other.list() == []
    assert other.list(kind="recording") == result.ids == ["dataset-000000", "dataset-000001"]
    (note,) = result.notes
    assert "no feature 'observation.images.camera_head'" in note
    assert "--map camera_head=FEATURE" in note
    streams = other.recording(result.ids[0]).streams
    assert streams["observation_tactile"].shape == (2, 320)
    assert streams["action"].names[:3] == ("wrist_left.x_m", "wrist_left.y_m", "wrist_left.z_m")
    assert {"camera_wrist_left", "observation_images_top"} <= set(streams)


def test_features_without_a_role_are_streams_of_the_episode(store, other, folder):
    foreign(store, folder)
    table = pq.read_table(folder / DATA)
    numbers = np.arange(table.num_rows, dtype=np.float32)
    table = table.append_column("observation.current", [numbers])
    pq.write_table(table.append_column("note", [["a"] * len(numbers)]), folder / DATA)

    def change(info):
        info["features"]["observation.current"] = {"dtype": "float32", "shape": [1]}
        info["features"]["note"] = {"dtype": "string", "shape": [1]}

    edit_json(folder, INFO, change)
    mapping = {"camera_head": "observation.images.top", "amps": "observation.current"}
    result = import_dataset(folder, other, options=ImportOptions(mapping=mapping))
    assert result.kind == "episode"
    named = {(one.source, one.stream) for one in result.reports[0].imported}
    assert {("observation.current", "amps"), ("note", "note"), ("action", "action")} <= named
    assert {one.num_samples for one in result.reports[0].imported} == {17}
    assert import_dataset(folder, other, options=ImportOptions(mapping=mapping)).present == (
        result.ids
    )
    back = other.open(result.ids[1])
    np.testing.assert_array_equal(back.read("amps").values.ravel(), numbers[17:])
    np.testing.assert_array_equal(back.stamps_ns("amps"), back.stamps_ns("action"))


def test_a_mapping_of_unknown_names_is_refused(store, other, folder):
    foreign(store, folder)
    top = {"camera_head": "observation.images.top"}
    for mapping, error, words in (
        (top | {"gripper": "action"}, UnknownNameError, "gripper"),
        ({"camera_../x": "observation.images.top"}, InvalidInputError, "camera_../x"),
        ({"camera_head": "observation.images.front"}, UnknownNameError, "images.front"),
        ({"camera_head": "observation.state"}, InvalidInputError, "expected images"),
    ):
        with pytest.raises(error, match=words):
            import_dataset(folder, other, options=ImportOptions(mapping=mapping))
    assert other.list() == other.list(kind="recording") == []


def test_other_datasets_may_know_no_camera_matrix(store, other, folder):
    foreign(store, folder)
    mapping = {"camera_head": "observation.images.top"}
    names = import_dataset(folder, other, options=ImportOptions(mapping=mapping)).ids
    assert names
    for name in names:
        assert other.open(name).attributes.K_head is None
        assert other.open(name).window(0, 2).K_head is None
    for wrong in ({"K_head": ((1.0,),)}, {"K_head": K_HEAD, "id_prefix": "../"}):
        with pytest.raises(InvalidInputError, match="no episode"):
            import_dataset(folder, other, options=ImportOptions(mapping=mapping, **wrong))
    assert other.list() == names


def test_other_datasets_with_channels_first_and_without_touch(store, other, folder):
    foreign(store, folder)

    def change(info):
        info["features"]["observation.images.top"]["shape"] = [3, 48, 64]
        del info["features"]["observation.tactile"]
        del info["features"]["observation.state"]

    edit_json(folder, INFO, change)
    mapping = {"camera_head": "observation.images.top"}
    import_dataset(folder, other, options=ImportOptions(mapping=mapping, K_head=K_HEAD))
    back = other.open("dataset-000000")
    assert set(back.streams) == {"action", *CAMERAS}
    assert back.attributes.anchor.to_poses().T_world_wrist_left.tolist() == np.eye(4).tolist()


def test_nan_is_refused_and_nothing_of_the_episode_stays(store, other, folder):
    export_dataset(two(store), folder, repo_id="touch")
    edit_column(folder, DATA, "action", set_item(20, [float("nan")] * 67))
    (failure,) = import_dataset(folder, other).failed.values()
    assert "NaN" in failure
    assert other.list() == ["stand-bottle-0003"]


def test_a_rate_that_is_no_whole_number_is_kept(store, other, folder):
    foreign(store, folder)
    # As 29.97 is to 30, the rate of broadcast video.
    edit_json(folder, INFO, lambda info: info.update(fps=14.985))
    mapping = {"camera_head": "observation.images.top"}
    options = ImportOptions(mapping=mapping, K_head=K_HEAD, images="rgb8")
    for episode_id in import_dataset(folder, other, options=options).ids:
        episode = other.open(episode_id)
        assert episode.attributes.model_rate_hz == 14.985
        steps_ns = np.diff(episode.stamps_ns("action"))
        np.testing.assert_allclose(steps_ns, 1e9 / 14.985, atol=1)


def test_a_rate_that_is_no_number_is_told_without_a_text_of_a_library(store, other, folder):
    foreign(store, folder)
    edit_json(folder, INFO, lambda info: info.update(fps="fast"))
    with pytest.raises(CorruptDataError) as caught:
        import_dataset(folder, other)
    assert "fps: Input should be a valid number" in caught.value.message
    assert "\n" not in caught.value.message
    assert "pydantic" not in caught.value.message
