"""Datasets that are damaged, unfinished or hostile: a clear error, and nothing in the store."""

import contextlib
import json
import os
import shutil

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest

from dextouch.bridges.lerobot import (
    ExportOptions,
    ImportOptions,
    export_dataset,
    import_dataset,
    source,
    video,
)
from dextouch.bridges.lerobot.layout import confined, fill_path
from dextouch.episodes import EpisodeStore
from dextouch.errors import (
    CorruptDataError,
    DexTouchError,
    InvalidInputError,
    LimitExceededError,
    NotFoundError,
)
from tests.unit.bridges.lerobot_edits import (
    DATA,
    EPISODES,
    INFO,
    TASKS,
    cut_file,
    drop_columns,
    edit_column,
    edit_json,
    set_item,
)
from tests.unit.bridges.lerobot_episodes import make_episode

CAMERA = "observation.images.camera_head"
VIDEO = f"videos/{CAMERA}/chunk-000/file-000.mp4"
SIDECAR = "meta/dextouch/episode-000000.json"


@pytest.fixture(scope="module")
def sound(tmp_path_factory):
    root = tmp_path_factory.mktemp("sound")
    reader = make_episode(num_steps=9).write(EpisodeStore(root / "store"))
    export_dataset([reader], root / "dataset", repo_id="touch")
    return root / "dataset"


@pytest.fixture
def folder(sound, tmp_path):
    shutil.copytree(sound, tmp_path / "dataset")
    return tmp_path / "dataset"


@pytest.fixture
def store(tmp_path):
    return EpisodeStore(tmp_path / "store")


def _info(**changes):
    return lambda folder: edit_json(folder, INFO, lambda info: info.update(changes))


def _feature(name, **changes):
    return lambda folder: edit_json(
        folder, INFO, lambda info: info["features"][name].update(changes)
    )


def _column(name, column, index, to):
    return lambda folder: edit_column(folder, name, column, set_item(index, to))


def _write(name, data):
    return lambda folder: (folder / name).write_bytes(data)


def _remove(name):
    return lambda folder: (folder / name).unlink()


def _cut(name, keep):
    return lambda folder: cut_file(folder / name, keep)


def _link_out(folder):
    secret = folder.parent / "elsewhere.parquet"
    (folder / DATA).rename(secret)
    (folder / DATA).symlink_to(secret)


def _link_table(folder):
    secret = folder.parent / "elsewhere.parquet"
    (folder / EPISODES).rename(secret)
    (folder / EPISODES).symlink_to(secret)


def _sidecar(**changes):
    return lambda folder: edit_json(folder, SIDECAR, lambda content: content.update(changes))


def _evil_id(folder):
    edit_json(folder, SIDECAR, lambda c: c["attributes"].update(episode_id="../../evil"))


def _ragged(folder):
    """Lists of unequal length whose total is right: rows would shift."""
    _reshape(folder, (-1, 1))


def _longer(folder):
    _reshape(folder, (0, 1))


def _reshape(folder, more):
    table = pq.read_table(folder / DATA)
    rows = table.column("action").to_pylist()
    for index, count in enumerate(more):
        rows[index] = [*rows[index], 0.0][: 67 + count]
    place = table.column_names.index("action")
    ragged = pa.array(rows, pa.list_(pa.float32()))
    pq.write_table(table.set_column(place, "action", ragged), folder / DATA)


DAMAGE = {
    "no info": (_remove(INFO), NotFoundError, "info.json"),
    "info is no JSON": (_write(INFO, b"{"), CorruptDataError, "info.json"),
    "info is a list": (_write(INFO, b"[1]"), CorruptDataError, "info.json"),
    "info nests deeply": (_write(INFO, b"[" * 200_000), CorruptDataError, "info.json"),
    "older format": (_info(codebase_version="v1.6"), InvalidInputError, "v1.6"),
    "format of other files": (_info(codebase_version="v2.1"), NotFoundError, "tasks.jsonl"),
    "no fps": (_info(fps=0), CorruptDataError, "fps"),
    "data path leads out": (
        _info(data_path="../{chunk_index}/{file_index}.parquet"),
        CorruptDataError,
        "leads out",
    ),
    "data path is absolute": (_info(data_path="/etc/passwd"), CorruptDataError, "leads out"),
    "video path leads out": (_info(video_path="videos/../../x.mp4"), CorruptDataError, "leads out"),
    "path with a zero byte": (_info(data_path="data/\0"), CorruptDataError, "zero byte"),
    "template with attributes": (
        _info(data_path="{chunk_index.__class__}"),
        InvalidInputError,
        "template",
    ),
    "template with other fields": (_info(data_path="{secret}"), InvalidInputError, "secret"),
    "no video path": (_info(video_path=None), CorruptDataError, "video_path"),
    "link out of the folder": (_link_out, CorruptDataError, "leads out"),
    "linked table": (_link_table, CorruptDataError, "leads out"),
    "no tasks": (_remove(TASKS), NotFoundError, "tasks.parquet"),
    "tasks without text": (
        lambda f: drop_columns(f, TASKS, "task"),
        CorruptDataError,
        "tasks.parquet",
    ),
    "no episodes": (_remove(EPISODES), NotFoundError, "meta/episodes"),
    "episodes cut": (_cut(EPISODES, 0.5), CorruptDataError, "file-000.parquet"),
    "episodes empty": (_write(EPISODES, b""), CorruptDataError, "file-000.parquet"),
    "more episodes promised": (_info(total_episodes=2), CorruptDataError, "not finished"),
    "no length": (lambda f: drop_columns(f, EPISODES, "length"), CorruptDataError, "no length"),
    "endless episode": (_column(EPISODES, "length", 0, 10**9), CorruptDataError, "frames"),
    "episode too long": (_column(EPISODES, "length", 0, 10), CorruptDataError, "got 9 frames"),
    "negative file": (_column(EPISODES, "data/file_index", 0, -1), CorruptDataError, "its file"),
    "another file": (_column(EPISODES, "data/file_index", 0, 7), NotFoundError, "file-007"),
    "no start in the video": (
        _column(EPISODES, f"videos/{CAMERA}/from_timestamp", 0, None),
        CorruptDataError,
        CAMERA,
    ),
    "start behind the video": (
        _column(EPISODES, f"videos/{CAMERA}/from_timestamp", 0, 100.0),
        CorruptDataError,
        "mp4",
    ),
    "no data": (_remove(DATA), NotFoundError, "file-000.parquet"),
    "data cut": (_cut(DATA, 0.7), CorruptDataError, "file-000.parquet"),
    "data of another kind": (_write(DATA, b"PAR1" * 50), CorruptDataError, "file-000.parquet"),
    "frames in disorder": (_column(DATA, "frame_index", 4, 2), CorruptDataError, "frame_index"),
    "frame of another episode": (
        _column(DATA, "episode_index", 4, 1),
        CorruptDataError,
        "are not contiguous",
    ),
    "stamps go back": (_column(DATA, "dextouch.t_ref_ns", 4, 0), CorruptDataError, "t_ref_ns"),
    "image stamps go back": (
        _column(DATA, "dextouch.image_dt_ns", 4, [-(10**10)] * 2),
        CorruptDataError,
        "go back",
    ),
    "empty rows": (_column(DATA, "action", 4, None), CorruptDataError, "action"),
    "ragged rows": (_ragged, CorruptDataError, "action"),
    "longer rows": (_longer, CorruptDataError, "action"),
    "no measured actions": (
        lambda f: edit_json(f, INFO, lambda i: i["features"].pop("dextouch.action_measured")),
        CorruptDataError,
        "action_measured",
    ),
    "column that is not there": (
        lambda f: drop_columns(f, DATA, "action"),
        CorruptDataError,
        "action",
    ),
    "column of another type": (
        _feature("action", dtype="float64"),
        CorruptDataError,
        "declares float64",
    ),
    "column of ours with another shape": (
        _feature("dextouch.tactile_valid", shape=[1]),
        CorruptDataError,
        "tactile_valid",
    ),
    "no video": (_remove(VIDEO), NotFoundError, "file-000.mp4"),
    "video cut": (_cut(VIDEO, 0.6), CorruptDataError, "file-000.mp4"),
    "video empty": (_write(VIDEO, b""), CorruptDataError, "file-000.mp4"),
    "video is a playlist": (
        _write(VIDEO, b"#EXTM3U\n#EXTINF:1,\nfile:///etc/passwd\n"),
        CorruptDataError,
        "file-000.mp4",
    ),
    "video of another size": (_feature(CAMERA, shape=[96, 64, 3]), CorruptDataError, "(48, 64)"),
    "description of another episode": (_sidecar(episode_index=1), CorruptDataError, "episode 1"),
    "description with more": (_sidecar(extra=1), CorruptDataError, "extra"),
    "id that is a path": (_evil_id, CorruptDataError, "episode_id"),
}


def test_the_sound_dataset_comes_in(folder, store):
    assert import_dataset(folder, store).ids == ["stand-bottle-0003"]


@pytest.mark.long
@pytest.mark.parametrize("unit", ["h264", "rgb8"])
@pytest.mark.parametrize("name", DAMAGE)
def test_damage_is_named_and_nothing_is_stored(folder, store, name, unit):
    damage, error, words = DAMAGE[name]
    damage(folder)
    with pytest.raises(DexTouchError) as caught:
        import_dataset(folder, store, options=ImportOptions(images=unit))
    assert type(caught.value) is error
    assert words in caught.value.message
    assert store.list() == []


def test_a_video_with_fewer_images_is_refused(folder, store, tmp_path):
    short = make_episode(num_steps=5).write(EpisodeStore(tmp_path / "short"))
    export_dataset([short], tmp_path / "other", repo_id="touch")
    shutil.copy(tmp_path / "other" / VIDEO, folder / VIDEO)
    for unit in ("h264", "rgb8"):
        with pytest.raises(CorruptDataError, match="image 5 of 9"):
            import_dataset(folder, store, options=ImportOptions(images=unit))
    assert store.list() == []


@pytest.mark.parametrize(
    ("module", "limit", "value", "error"),
    [
        (source, "MAX_INFO_BYTES", 100, CorruptDataError),
        (source, "MAX_EPISODE_FRAMES", 8, CorruptDataError),
        (source, "MAX_TABLE_ROWS", 8, LimitExceededError),
        (source, "MAX_TABLE_BYTES", 1000, LimitExceededError),
        (video, "MAX_SIDE_PX", 63, LimitExceededError),
    ],
)
def test_sizes_are_bounded(folder, store, monkeypatch, module, limit, value, error):
    monkeypatch.setattr(module, limit, value)
    with pytest.raises(error):
        import_dataset(folder, store)
    assert store.list() == []


def test_nothing_but_plain_fields_is_filled_in():
    assert fill_path("a-{chunk_index:03d}/{name}.x", chunk_index=7, name="b") == "a-007/b.x"
    for template in ("{chunk_index!r}", "{chunk_index:>9}", "{0}", "{{chunk_index}}", "{", "{}"):
        with pytest.raises(InvalidInputError, match="template"):
            fill_path(template, chunk_index=1)


def test_paths_stay_in_the_folder(tmp_path):
    assert confined(tmp_path, "a/../b") == tmp_path.resolve() / "b"
    for path in ("..", "a/../../b", "/etc/passwd"):
        with pytest.raises(CorruptDataError, match="leads out"):
            confined(tmp_path, path)


def test_a_snapshot_in_the_cache_of_the_hub_is_whole_with_its_blobs(folder, store, tmp_path):
    """The layout that `huggingface_hub.snapshot_download` leaves: links to files beside it."""
    repository = tmp_path / "datasets--lab--touch"
    snapshot, blobs = repository / "snapshots" / "1a2b3c", repository / "blobs"
    blobs.mkdir(parents=True)
    for number, path in enumerate(sorted(p for p in folder.rglob("*") if p.is_file())):
        link = snapshot / path.relative_to(folder)
        link.parent.mkdir(parents=True, exist_ok=True)
        blob = path.rename(blobs / f"{number:064x}")
        link.symlink_to(os.path.relpath(blob, link.parent))
    assert import_dataset(snapshot, store).ids
    (tmp_path / "secret").write_text("{}")
    for place in (tmp_path / "secret", repository / "secret"):
        (snapshot / INFO).unlink()
        (snapshot / INFO).symlink_to(place)
        with pytest.raises(CorruptDataError, match="leads out"):
            import_dataset(snapshot, store)


def test_a_pointer_of_lfs_says_how_to_get_the_file(folder, store):
    for name in (DATA, next(folder.rglob("*.mp4")).relative_to(folder)):
        whole = (folder / name).read_bytes()
        (folder / name).write_text("version https://git-lfs.github.com/spec/v1\nsize 1\n")
        with pytest.raises(CorruptDataError, match="`git lfs pull`"):
            import_dataset(folder, store)
        (folder / name).write_bytes(whole)


def test_a_feature_of_a_video_cannot_leave_by_its_name(folder, store):
    """The video's key is part of its path."""

    def rename(info):
        info["features"]["../../x"] = info["features"].pop(CAMERA)

    edit_json(folder, INFO, rename)
    with pytest.raises(DexTouchError):
        import_dataset(folder, store, options=ImportOptions(mapping={"camera_head": "../../x"}))
    assert store.list() == []


@pytest.mark.long
def test_any_flipped_byte_of_the_metadata_is_survived(folder, store):
    """Whatever a byte says: our error or a sound import, never another exception."""
    rng = np.random.default_rng(11)
    for name in (INFO, TASKS, EPISODES, DATA, SIDECAR):
        whole = (folder / name).read_bytes()
        for place in rng.integers(0, len(whole), 6):
            damaged = bytearray(whole)
            damaged[place] ^= int(rng.integers(1, 256))
            (folder / name).write_bytes(damaged)
            prefix = f"f{place}-{name.count('a')}-"
            options = ImportOptions(id_prefix=prefix, images="rgb8", K_head=((1.0, 0.0, 0.0),) * 3)
            with contextlib.suppress(DexTouchError):
                import_dataset(folder, store, options=options)
        (folder / name).write_bytes(whole)


@pytest.mark.long
def test_a_flipped_byte_of_a_video_is_survived(folder):
    rng = np.random.default_rng(12)
    path = folder / VIDEO
    span = video.VideoSpan(path, 0.0, 9, 15, (48, 64, 3))
    whole, refused = path.read_bytes(), 0
    for place in rng.integers(0, len(whole), 40):
        damaged = bytearray(whole)
        damaged[place] ^= int(rng.integers(1, 256))
        path.write_bytes(damaged)
        try:
            video.read_units(span)
            list(video.read_images(span))
        except DexTouchError:
            refused += 1
    assert refused


def test_an_export_that_fails_late_leaves_nothing(tmp_path, store):
    readers = [make_episode(seed=seed, num_steps=5).write(store) for seed in (3, 4)]
    shard = next((store.root / "episodes/stand-bottle-0004/camera_head/c").rglob("0"))
    while shard.is_dir():
        shard = next(shard.iterdir())
    data = bytearray(shard.read_bytes())
    data[len(data) // 2] ^= 1
    shard.write_bytes(data)
    exports = tmp_path / "exports"
    with pytest.raises(CorruptDataError, match="camera_head"):
        export_dataset(readers, exports / "x", repo_id="t", options=ExportOptions())
    assert list(exports.iterdir()) == []


def test_the_sidecar_is_json_that_people_can_read(folder):
    said = json.loads((folder / SIDECAR).read_text())
    assert said["attributes"]["K_head"][0][0] == 60.0
    assert said["grid"] == "model"


def test_flipped_bytes_of_texts_neither_end_the_process_nor_read_elsewhere(tmp_path):
    texts = [f"x{k % 5}" for k in range(200)]
    lists = [[{"a": f"q{k % 7}", "b": k}] * 2 if k % 3 else None for k in range(200)]
    path = tmp_path / "texts.parquet"
    pq.write_table(
        pa.table({"text": texts, "lists": lists}), path, row_group_size=70, data_page_version="2.0"
    )
    whole, rng, refused = path.read_bytes(), np.random.default_rng(3), 0
    for place in rng.integers(4, len(whole), 200):
        damaged = bytearray(whole)
        damaged[place] = int(rng.integers(256))
        path.write_bytes(damaged)
        try:
            source._table_rows(source._read_table(path), path)
        except CorruptDataError:
            refused += 1
    assert refused
