"""Datasets of others: each feature a stream of a recording, and what is not understood is named."""

import hashlib
import json
import re

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest

from dextouch.bridges.lerobot import (
    ImportOptions,
    import_dataset,
    recordings,
    source,
)
from dextouch.episodes import EpisodeStore
from dextouch.errors import (
    ConflictError,
    CorruptDataError,
    InvalidInputError,
    LimitExceededError,
    UnknownNameError,
)
from tests.unit.bridges.foreign_lerobot import (
    FPS,
    JOINTS,
    LENGTHS,
    SIZE_PX,
    TASKS,
    arm,
    encoded,
)
from tests.unit.bridges.lerobot_edits import DATA, INFO, edit_column, edit_json, set_item

TOP, WRIST = "observation.images.top", "observation.images.wrist"
_TEXT = pa.dictionary(pa.int32(), pa.string())
DICTIONARY_LISTS = pa.list_(pa.struct([("role", _TEXT), ("content", _TEXT)]))
WRITERS = {"v3.0": "write_v3", "v2.1": "write_v21"}


@pytest.fixture
def store(tmp_path):
    return EpisodeStore(tmp_path / "store")


def written(tmp_path, version="v3.0", **changes):
    made = arm(**changes)
    return made, getattr(made, WRITERS[version])(tmp_path / "arm")


def values(recording, name):
    return recording.values(name, 0, recording.num_samples(name))


def texts(recording, name):
    return [bytes(row).rstrip(b"\0").decode() for row in values(recording, name)]


@pytest.mark.parametrize("version", WRITERS)
def test_every_feature_of_another_robot_becomes_a_stream(store, tmp_path, version):
    made, folder = written(tmp_path, version)
    result = import_dataset(folder, store)
    assert result.kind == "recording"
    assert result.ids == ["arm-000000", "arm-000001"] == store.list(kind="recording")
    for episode, name in enumerate(result.ids):
        recording = store.recording(name)
        recording.verify()
        for key, stream in (
            ("action", "action"),
            ("observation.state", "observation_state"),
            ("observation.force", "observation_force"),
        ):
            expected = np.array(made.values[key][episode], dtype=np.float32)
            np.testing.assert_array_equal(values(recording, stream), expected)
            assert recording.streams[stream].dtype == "float32"
        assert recording.streams["action"].names == tuple(JOINTS)
        assert recording.streams["observation_state"].names == tuple("abcdefghi")
        assert recording.streams["action"].kind == "robot_state"
        counted, done = values(recording, "observation_count"), values(recording, "next_done")
        assert counted.ravel().tolist() == made.values["observation.count"][episode]
        assert done.ravel().tolist() == made.values["next.done"][episode]
        assert texts(recording, "subtask") == made.values["subtask"][episode]
        times = np.round(np.arange(LENGTHS[episode]) * (1e9 / FPS)).astype(np.int64)
        for stream in recording.streams:
            np.testing.assert_array_equal(recording.stamps_ns(stream), times)
        # PNG is exact; the video is not, but nearer to its own images than to their neighbours.
        wrist = np.stack(made.images(WRIST, episode))
        np.testing.assert_array_equal(values(recording, "observation_images_wrist"), wrist)
        top = recording.images("observation_images_top").astype(float)
        errors = [np.abs(top - image).mean(axis=(1, 2, 3)) for image in made.images(TOP, episode)]
        assert np.argmin(errors, axis=0).tolist() == list(range(LENGTHS[episode]))
        about = recording.attributes
        assert (about.task, about.instruction) == (TASKS[episode], TASKS[episode])
        assert (about.domain, about.station) == ("robot", "arm7")
        report = result.reports[episode]
        assert report.refused == []
        assert report.contradictions == []
        assert {one.source for one in report.imported} == {*made.features, *made.cameras}
        assert set(report.kept_as_numbers) == {"subtask"}


@pytest.mark.parametrize("place", ["inside", "apart"])
@pytest.mark.parametrize("version", WRITERS)
def test_jpeg_images_keep_their_bytes_in_tables_and_in_folders(store, tmp_path, version, place):
    cameras = {WRIST: ("image", ".jpg", place)}
    made, folder = written(tmp_path, version, cameras=cameras)
    for name in import_dataset(folder, store).ids:
        recording, episode = store.recording(name), int(name[-6:])
        assert recording.streams["observation_images_wrist"].unit == "jpeg"
        kept = recording.encoded_images("observation_images_wrist", 0, LENGTHS[episode])
        assert kept == [encoded(image, ".jpg") for image in made.images(WRIST, episode)]


def test_images_without_a_column_are_found_in_their_folder(store, tmp_path):
    made, folder = written(tmp_path, cameras={WRIST: ("image", ".png")})
    table = pq.read_table(folder / DATA)
    pq.write_table(table.drop_columns([WRIST]), folder / DATA)
    for episode in range(len(LENGTHS)):
        for index, image in enumerate(made.images(WRIST, episode)):
            path = folder / f"images/{WRIST}/episode-{episode:06d}/frame-{index:06d}.png"
            path.parent.mkdir(parents=True, exist_ok=True)
            path.write_bytes(encoded(image, ".png"))
    ids = import_dataset(folder, store).ids
    got = values(store.recording(ids[1]), "observation_images_wrist")
    np.testing.assert_array_equal(got, np.stack(made.images(WRIST, 1)))
    path.unlink()
    result = import_dataset(folder, store, options=ImportOptions(id_prefix="again-"))
    assert "episode 1: image 8 of 'observation.images.wrist'" in result.failed["episode 1"]


def test_depth_images_of_16_bits_are_exact_and_depth_video_is_refused(store, tmp_path):
    made, folder = written(tmp_path, cameras={WRIST: ("image", ".png"), TOP: ("video",)})
    depth = [np.full(SIZE_PX, 1000 * k + 7, dtype=np.uint16) for k in range(sum(LENGTHS))]
    import cv2

    def sixteen_bits(values):
        for row, image in zip(values, depth, strict=True):
            row["bytes"] = cv2.imencode(".png", image)[1].tobytes()

    edit_column(folder, DATA, WRIST, sixteen_bits)
    edit_json(folder, INFO, lambda i: i["features"][TOP].update(info={"is_depth_map": True}))
    result = import_dataset(folder, store)
    recording = store.recording(result.ids[0])
    stream = recording.streams["observation_images_wrist"]
    assert (stream.unit, stream.dtype, stream.shape) == ("mono16", "uint16", SIZE_PX)
    np.testing.assert_array_equal(
        values(recording, "observation_images_wrist"), np.stack(depth[: LENGTHS[0]])
    )
    (refused,) = result.reports[0].refused
    assert (refused.source, refused.num_samples) == (TOP, LENGTHS[0])
    assert "depth" in refused.reason
    assert len(made.cameras) == 2


def test_several_tasks_of_an_episode_are_kept_frame_by_frame(store, tmp_path):
    _, folder = written(tmp_path, tasks=((0, 1), (2,)))
    ids = import_dataset(folder, store).ids
    first, second = map(store.recording, ids)
    assert first.attributes.instruction == "pick the cube / place the cube"
    assert texts(first, "task") == ["pick the cube"] * 6 + ["place the cube"] * 6
    assert "task" not in second.streams
    assert second.attributes.task == "wave"


def test_times_are_those_of_the_timestamps_or_of_a_given_rate(store, tmp_path):
    _, folder = written(tmp_path)
    late = np.float32([0.0, 0.1, 0.25, 0.3])

    def change(values):
        values[: len(late)] = late.tolist()

    edit_column(folder, DATA, "timestamp", change)
    result = import_dataset(folder, store)
    (problem,) = result.reports[0].contradictions
    assert "episode 0" in problem
    assert "50 ms" in problem
    got = store.recording(result.ids[0]).stamps_ns("action")
    expected = [round(float(value) * 1e9) for value in late]
    assert got[:4].tolist() == expected
    options = ImportOptions(fps=20.0, id_prefix="fast-")
    result = import_dataset(folder, store, options=options)
    fast = store.recording(result.ids[0])
    assert fast.stamps_ns("action").tolist() == [50_000_000 * k for k in range(LENGTHS[0])]
    assert fast.streams["action"].nominal_rate_hz == 20
    assert len(fast.images("observation_images_top")) == LENGTHS[0]
    edit_column(folder, DATA, "timestamp", set_item(2, 0.05))
    result = import_dataset(folder, store, options=ImportOptions(id_prefix="back-"))
    assert result.ids == ["back-arm-000001"]
    assert re.search(r"does not rise.*--fps", result.failed["episode 0"])


def test_options_name_streams_camera_matrix_task_and_domain(store, tmp_path):
    _, folder = written(tmp_path)
    K = ((50.0, 0.0, 32.0), (0.0, 50.0, 24.0), (0.0, 0.0, 1.0))
    with pytest.raises(InvalidInputError, match=r"--map camera_head=FEATURE") as caught:
        import_dataset(folder, store, options=ImportOptions(K_head=K))
    assert TOP in caught.value.message
    mapping = {"camera_head": TOP, "arm": "observation.state"}
    options = ImportOptions(
        mapping=mapping, K_head=K, task="cubes", domain="human", images="jpeg", id_prefix="x-"
    )
    result = import_dataset(folder, store, options=options)
    recording = store.recording(result.ids[0])
    assert {"camera_head", "arm"} <= set(recording.streams)
    assert recording.streams["camera_head"].unit == "jpeg"
    about = recording.attributes
    assert (about.task, about.instruction, about.domain) == ("cubes", TASKS[0], "human")
    assert about.calibration["K_head"] == K
    assert result.ids[0] == "x-arm-000000"
    edit_column(folder, DATA, "observation.count", set_item(0, 99))
    with pytest.raises(ConflictError, match="--id-prefix"):
        import_dataset(folder, store, options=options)
    for mapping, error in (
        ({"camera_head": "observation.images.front"}, UnknownNameError),
        ({"Camera Head": TOP}, InvalidInputError),
    ):
        with pytest.raises(error):
            import_dataset(folder, store, options=ImportOptions(mapping=mapping))


def test_provenance_is_the_sha256_of_the_files_as_sha256sum_prints_it(store, tmp_path):
    _, folder = written(tmp_path)
    about = store.recording(import_dataset(folder, store).ids[1]).attributes
    names = [DATA, f"videos/{TOP}/chunk-000/file-000.mp4"]
    digests = [hashlib.sha256((folder / name).read_bytes()).hexdigest() for name in names]
    said = {one.id: one.sha256 for one in about.lineage}
    assert said == {f"lerobot:arm/{n}": d for n, d in zip(names, digests, strict=True)}
    printed = "".join(f"{d}  {n}\n" for n, d in zip(names, digests, strict=True))
    assert about.imported_from.sha256 == hashlib.sha256(printed.encode()).hexdigest()
    assert about.imported_from.importer.endswith("lerobot v3.0")


def test_contradictions_of_description_and_data_are_named(store, tmp_path):
    _, folder = written(tmp_path)
    table = pq.read_table(folder / DATA)
    place = table.column_names.index("action")
    doubled = pa.array(table.column("action").to_pylist(), pa.list_(pa.float64()))
    table = table.set_column(place, "action", doubled)
    pq.write_table(table.append_column("extra", [[0] * sum(LENGTHS)]), folder / DATA)
    edit_column(folder, DATA, "task_index", set_item(0, 2))

    def change(info):
        info.update(total_frames=99, total_tasks=7)
        info["features"][TOP]["info"] = {"video.fps": 30, "video.height": 9, "video.width": 9}

    edit_json(folder, INFO, change)
    result = import_dataset(folder, store)
    report = result.reports[0]
    assert [(r.source, r.reason) for r in report.refused] == [
        ("extra", "info.json does not declare this column")
    ]
    said = "\n".join(report.contradictions)
    for part in (
        "99 frames, the episodes have 21",
        "7 tasks, there are 3",
        "its video is of [9, 9]",
        "video of 30 Hz in a dataset of 10 Hz",
        "action is float64, info.json says float32",
        "its frames are of the tasks ['pick the cube', 'wave']",
    ):
        assert part in said, part
    assert store.recording(result.ids[0]).streams["action"].dtype == "float64"
    assert "contradiction: info.json says 99 frames" in "\n".join(report.lines())


def test_what_contradicts_the_rows_is_refused_and_leaves_nothing(store, tmp_path):
    cases = {
        "shape": lambda i: i["features"]["action"].update(shape=[6]),
        "images": lambda i: i["features"][WRIST].update(shape=[24, 64, 3]),
        "video": lambda i: i["features"][TOP].update(shape=[24, 64, 3]),
        "column": lambda i: i["features"].update(gone={"dtype": "string", "shape": [1]}),
        "episodes": lambda i: i.update(total_episodes=3),
    }
    for name, change in cases.items():
        _, folder = arm(), arm().write_v3(tmp_path / name)
        edit_json(folder, INFO, change)
        with pytest.raises(CorruptDataError):
            import_dataset(folder, store)
    folder = arm().write_v21(tmp_path / "short")
    path = folder / "meta/episodes.jsonl"
    path.write_text(path.read_text().replace('"length": 12', '"length": 11'))
    assert store.list(kind="recording") == []
    result = import_dataset(folder, store)
    assert "got 12 frames, expected 11" in result.failed["episode 0"]
    assert result.ids == ["short-000001"] == store.list(kind="recording")


@pytest.mark.parametrize("version", WRITERS)
def test_episodes_with_holes_or_out_of_order_keep_their_numbers(store, tmp_path, version):
    made, folder = written(tmp_path, version)
    tables = folder / "meta/episodes/chunk-000"
    if version == "v3.0":
        rows = pq.read_table(tables / "file-000.parquet")
        # Whole numbers, as pandas writes them where all of a column are.
        places = rows.column_names.index(f"videos/{TOP}/from_timestamp")
        rows = rows.set_column(places, f"videos/{TOP}/from_timestamp", pa.array([0, 0]))
        pq.write_table(rows.slice(1), tables / "file-000.parquet")
        pq.write_table(rows.slice(0, 1), tables / "file-001.parquet")
        assert import_dataset(folder, store).ids == ["arm-000000", "arm-000001"]
        (tables / "file-001.parquet").unlink()
    else:
        path = folder / "meta/episodes.jsonl"
        path.write_text(path.read_text().split("\n", 1)[1])
    edit_json(folder, INFO, lambda i: i.update(total_episodes=1, total_frames=LENGTHS[1]))
    result = import_dataset(folder, store, options=ImportOptions(id_prefix="b-"))
    assert result.ids == ["b-arm-000001"]
    assert "of the episodes 0 … 1 there are 1" in result.reports[0].contradictions
    np.testing.assert_array_equal(
        values(store.recording("b-arm-000001"), "action"), np.float32(made.values["action"][1])
    )


def test_columns_that_are_not_declared_are_named(store, tmp_path):
    _, folder = written(tmp_path)
    undeclared = ("timestamp", "index", "task_index")
    edit_json(folder, INFO, lambda i: [i["features"].pop(name) for name in undeclared])
    report = import_dataset(folder, store).reports[0]
    assert [one.source for one in report.refused] == [*undeclared]
    assert report.contradictions == ["episode 0 has no timestamps"]


@pytest.mark.parametrize("version", WRITERS)
def test_one_bad_episode_does_not_stop_the_others_and_can_be_made_good(store, tmp_path, version):
    _, folder = written(tmp_path, version)
    name = DATA if version == "v3.0" else "data/chunk-000/episode_000000.parquet"
    sound = (folder / name).read_bytes()
    edit_column(folder, name, "frame_index", set_item(3, 7))
    result = import_dataset(folder, store)
    assert result.ids == ["arm-000001"] == store.list(kind="recording")
    assert list(result.failed) == ["episode 0"]
    assert "frame_index" in result.failed["episode 0"]
    (folder / name).write_bytes(sound)
    result = import_dataset(folder, store)
    # In v3 the episodes share a file, which is now another one.
    kept = [] if version == "v3.0" else ["arm-000001"]
    assert (result.ids, result.present) == (["arm-000000"], kept)
    assert list(result.failed) == ([] if kept else ["episode 1"])
    again = import_dataset(folder, store)
    assert (again.ids, again.present[0]) == ([], "arm-000000")
    assert json.loads(json.dumps(again.as_json()))["failed"] == again.failed


def test_texts_and_numbers_that_swell_are_refused_before_they_do(store, tmp_path, monkeypatch):
    """Dictionaries and runs make a file small, and padding makes a stream large."""
    made = arm(cameras={})
    made.values["subtask"] = [["x" * 60_000] * n for n in LENGTHS]
    folder = made.write_v3(tmp_path / "repeated")
    assert (folder / DATA).stat().st_size < 100_000
    monkeypatch.setattr(source, "MAX_TABLE_BYTES", 1_000_000)
    with pytest.raises(LimitExceededError, match="21 rows that need 10"):
        import_dataset(folder, store)
    monkeypatch.setattr(source, "MAX_TABLE_BYTES", 1 << 30)
    monkeypatch.setattr(recordings, "MAX_TEXTS_BYTES", 600_000)
    result = import_dataset(folder, store)
    assert "60000 bytes, to which 12 would be padded" in result.reports[0].refused[0].reason
    assert texts(store.recording(result.ids[1]), "subtask") == ["x" * 60_000] * 9
    made.values["observation.force"] = [np.zeros((n, 2, 9_000)).tolist() for n in LENGTHS]
    made.values["subtask"] = [[""] * n for n in LENGTHS]
    made.features["observation.force"]["shape"] = [2, 9_000]
    folder = made.write_v3(tmp_path / "zeros")
    assert (folder / DATA).stat().st_size < 100_000
    monkeypatch.setattr(source, "MAX_TABLE_BYTES", 1_000_000)
    with pytest.raises(LimitExceededError, match="21 rows that need 1"):
        import_dataset(folder, store)


def test_lists_of_repeated_texts_count_and_zeros_at_an_end_are_said(store, tmp_path):
    _, folder = written(tmp_path, cameras={})
    table = pq.read_table(folder / DATA)
    said = [[{"role": "user", "content": "a" * 50}], None, []] * 7
    ends = ["a\0", "b\0c", None] * 7
    place = table.column_names.index("subtask")
    table = table.set_column(place, "subtask", pa.array(ends)).append_column("said", [said])
    pq.write_table(table, folder / DATA)
    edit_json(folder, INFO, lambda i: i["features"].update(said={"dtype": "language", "shape": []}))
    assert source._repeated_bytes(table["said"].cast(DICTIONARY_LISTS)) == 7 * (4 + 50)
    result = import_dataset(folder, store)
    recording = store.recording(result.ids[0])
    assert [json.loads(text or "null") for text in texts(recording, "said")] == said[:12]
    notes = {one.stream: one.notes for one in result.reports[0].imported}
    assert notes["subtask"] == ("4 texts end in zeros, which look like the padding",)
    assert notes["said"] == ()
    pq.write_table(
        table, folder / DATA, use_dictionary=False, column_encoding={"subtask": "DELTA_BYTE_ARRAY"}
    )
    with pytest.raises(CorruptDataError, match="DeltaByteArray"):
        import_dataset(folder, store, options=ImportOptions(id_prefix="delta-"))


def test_images_that_are_not_stored_as_they_were_are_said(store, tmp_path):
    def notes(options, **changes):
        folder = arm(**changes).write_v21(tmp_path / f"{options.id_prefix}set")
        report = import_dataset(folder, store, options=options).reports[0]
        return {
            one.stream.removeprefix("observation_images_"): one.notes for one in report.imported
        }

    def jpeg(**more):
        return {"cameras": {WRIST: ("image", ".jpg"), TOP: ("video",)}, **more}

    plain = notes(ImportOptions(id_prefix="a-"))
    assert (plain["top"], plain["wrist"]) == (("decoded, encoded as h264",), ("PNG decoded",))
    asked = notes(ImportOptions(id_prefix="b-", images="jpeg"))
    assert (asked["top"], asked["wrist"]) == (
        ("decoded, encoded as jpeg",),
        ("PNG decoded, encoded as jpeg",),
    )
    groups = {"g": "8", "bf": "0", "keyint_min": "8", "sc_threshold": "0"}
    same = notes(ImportOptions(id_prefix="c-"), **jpeg(video_options=groups))
    assert (same["top"], same["wrist"]) == ((), ())


def test_what_no_stream_can_hold_is_refused_with_the_reason(store, tmp_path):
    made, folder = written(tmp_path)
    made.values["subtask"] = [["x" * 70_000] * n for n in LENGTHS]
    made.features["big"] = {"dtype": "uint64", "shape": [1], "names": None}
    made.values["big"] = [[2**63 + k for k in range(n)] for n in LENGTHS]
    folder = made.write_v3(tmp_path / "big")
    report = import_dataset(folder, store).reports[0]
    assert {one.source for one in report.refused} == {"subtask", "big"}
    assert all("65536" in r.reason or "2^63" in r.reason for r in report.refused)
    assert json.dumps(report.as_json())


def test_texts_that_are_no_unicode_are_replaced_or_refused(store, tmp_path):
    _, folder = written(tmp_path, "v2.1")
    half = "\\ud800"
    edit_json(folder, INFO, lambda i: i["features"]["action"].update(names=["j\ud800"] * 7))
    path = folder / "meta/episodes.jsonl"
    path.write_text(path.read_text().replace(TASKS[0], f"pick {half}"))
    about = store.recording(import_dataset(folder, store).ids[0])
    assert about.attributes.task == "pick ?"
    assert about.streams["action"].names == ("j?",) * 7
    _, folder = arm(), arm().write_v3(tmp_path / "latin")
    table = pq.read_table(folder / DATA)
    place = table.column_names.index("subtask")
    latin = pa.array([b"gr\xfc\xdfe"] * table.num_rows, pa.binary()).view(pa.string())
    pq.write_table(table.set_column(place, "subtask", latin), folder / DATA)
    with pytest.raises(CorruptDataError, match="subtask"):
        import_dataset(folder, store)


def test_image_files_stay_in_the_folder_and_are_bounded(store, tmp_path, monkeypatch):
    made, folder = written(tmp_path, cameras={WRIST: ("image", ".png")})
    outside = tmp_path / "secret.png"
    outside.write_bytes(encoded(made.images(WRIST, 0)[0], ".png"))

    def lead_out(values):
        values[0] = {"bytes": None, "path": "../secret.png"}

    edit_column(folder, DATA, WRIST, lead_out)
    result = import_dataset(folder, store)
    assert "leads out" in result.failed["episode 0"]
    _, folder = arm(), arm().write_v3(tmp_path / "large")
    monkeypatch.setattr(source, "MAX_IMAGE_BYTES", 64)
    with pytest.raises(LimitExceededError, match="64 bytes"):
        import_dataset(folder, store)
    assert store.list(kind="recording") == result.ids == ["arm-000001"]


def test_video_of_x264_with_b_frames_and_no_entry_at_an_episode_comes_in(store, tmp_path):
    options = {"bf": "3", "g": "250"}
    made, folder = written(tmp_path, cameras={TOP: ("video",)}, video_options=options)
    result = import_dataset(folder, store)
    for episode, name in enumerate(result.ids):
        top = store.recording(name).images("observation_images_top").astype(float)
        errors = [np.abs(top - image).mean(axis=(1, 2, 3)) for image in made.images(TOP, episode)]
        assert np.argmin(errors, axis=0).tolist() == list(range(LENGTHS[episode]))
