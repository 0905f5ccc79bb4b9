"""The structural checker finds every kind of fault: a dataset is broken once for each check."""

import shutil

import pyarrow as pa
import pyarrow.parquet as pq
import pytest

from dextouch.bridges.lerobot import export_dataset
from dextouch.episodes import EpisodeStore
from tests.unit.bridges.lerobot_edits import (
    DATA,
    EPISODES,
    INFO,
    STATS,
    TASKS,
    drop_columns,
    edit_column,
    edit_json,
    set_item,
)
from tests.unit.bridges.lerobot_episodes import make_episode
from tests.unit.bridges.lerobot_structure import problems

CAMERA = "observation.images.camera_head"
VIDEO = f"videos/{CAMERA}/chunk-000/file-000.mp4"


@pytest.fixture(scope="module")
def sound(tmp_path_factory):
    root = tmp_path_factory.mktemp("sound")
    store = EpisodeStore(root / "store")
    readers = [make_episode(seed=s, num_steps=n).write(store) for s, n in ((3, 5), (4, 7))]
    export_dataset(readers, root / "dataset", repo_id="touch")
    one = root / "one"
    export_dataset(readers[:1], one, repo_id="touch")
    return root / "dataset"


def _json(name, *keys, to):
    def change(folder):
        def put(content):
            for key in keys[:-1]:
                content = content[key]
            content[keys[-1]] = to

        edit_json(folder, name, put)

    return change


def _column(name, column, index, to):
    return lambda folder: edit_column(folder, name, column, set_item(index, to))


def _retype(folder):
    table = pq.read_table(folder / DATA)
    place = table.column_names.index("timestamp")
    wide = table.column("timestamp").cast(pa.float64())
    pq.write_table(table.set_column(place, "timestamp", wide), folder / DATA)


def _no_pandas(folder):
    table = pq.read_table(folder / TASKS)
    pq.write_table(table.replace_schema_metadata({}), folder / TASKS)


def _shorter_video(folder):
    shutil.copy(folder.parent / "one" / VIDEO, folder / VIDEO)


def _another_video(folder):
    shutil.copy(folder / VIDEO, folder / VIDEO.replace("000.mp4", "001.mp4"))


def _one_group(folder):
    pq.write_table(pq.read_table(folder / DATA), folder / DATA)


def _drop_info(folder):
    edit_json(folder, INFO, lambda content: content.pop("robot_type"))


def _drop_quantile(folder):
    edit_json(folder, STATS, lambda content: content["action"].pop("q10"))


FAULTS = {
    "info: keys": _drop_info,
    "info: codebase_version": _json(INFO, "codebase_version", to="v2.1"),
    "info: splits": _json(INFO, "splits", to={}),
    "info: data_path": _json(INFO, "data_path", to="data/{episode_index}.parquet"),
    "info: video_path": _json(INFO, "video_path", to=None),
    "info: fps": _json(INFO, "fps", to=15.0),
    "features: index": _json(INFO, "features", "index", "dtype", to="int32"),
    "features: timestamp": _json(INFO, "features", "timestamp", "shape", to=[2]),
    "features: action has other names": _json(INFO, "features", "action", "names", to=["x"]),
    f"features: {CAMERA} size": _json(INFO, "features", CAMERA, "info", "video.width", to=9),
    f"features: {CAMERA} fps": _json(INFO, "features", CAMERA, "info", "video.fps", to=9),
    "tasks: index of pandas": _no_pandas,
    "tasks: task_index": _column(TASKS, "task_index", 1, 5),
    "episodes: row 1 is another": _column(EPISODES, "episode_index", 1, 3),
    "episodes: 1 starts elsewhere": _column(EPISODES, "dataset_from_index", 1, 4),
    "episodes: 1 stops elsewhere": _column(EPISODES, "dataset_to_index", 1, 13),
    "episodes: 0 has unknown tasks": _column(EPISODES, "tasks", 0, ["other"]),
    "episodes: 0 says another file": _column(EPISODES, "meta/episodes/file_index", 0, 1),
    "episodes: total_frames": _json(INFO, "total_frames", to=13),
    "episodes: number of rows": _json(INFO, "total_episodes", to=3),
    "data: file index": _column(EPISODES, "data/file_index", 1, 1),
    "data: file-000.parquet has other groups": _one_group,
    "data: file-000.parquet has other columns": lambda f: drop_columns(
        f, DATA, "dextouch.t_ref_ns"
    ),
    "data: type of timestamp": _retype,
    "data: index": _column(DATA, "index", 6, 7),
    "data: episode_index": _column(DATA, "episode_index", 5, 0),
    "data: frame_index": _column(DATA, "frame_index", 6, 0),
    "data: timestamp": _column(DATA, "timestamp", 6, 0.5),
    "data: task_index": _column(DATA, "task_index", 6, 0),
    f"video: {CAMERA} spans other": _column(EPISODES, f"videos/{CAMERA}/to_timestamp", 1, 9.0),
    f"video: {CAMERA} spans do not join": _column(
        EPISODES, f"videos/{CAMERA}/from_timestamp", 1, 0.1
    ),
    f"video: {CAMERA} has other files": _another_video,
    f"video: {CAMERA} holds other frames": _shorter_video,
    f"video: {CAMERA} codec": _json(INFO, "features", CAMERA, "info", "video.codec", to="av1"),
    f"video: {CAMERA} pix_fmt": _json(INFO, "features", CAMERA, "info", "video.pix_fmt", to="x"),
    f"video: {CAMERA} rate": _json(INFO, "fps", to=30),
    "stats.json: action lacks statistics": _drop_quantile,
    "stats.json: action mean is not": _json(STATS, "action", "mean", 0, to=9.0),
    "stats.json: action std is not": _json(STATS, "action", "std", 0, to=9.0),
    "stats.json: action out of order": _json(STATS, "action", "q50", 0, to=-9.0),
    "stats.json: index count": _json(STATS, "index", "count", to=[11]),
    "stats.json: shape of action q01": _json(STATS, "action", "q01", to=[0.0]),
    f"stats.json: {CAMERA} not in": _json(STATS, CAMERA, "max", 0, 0, 0, to=2.0),
    "stats.json: statistics of other features": _json(STATS, "extra", to={}),
    "episodes: 1: action count": _column(EPISODES, "stats/action/count", 1, [5]),
}


def test_the_sound_dataset_is_sound(sound):
    assert problems(sound) == []


@pytest.mark.long
@pytest.mark.parametrize("sentence", FAULTS)
def test_a_fault_is_named(sound, tmp_path, sentence):
    shutil.copytree(sound.parent, tmp_path / "copy")
    folder = tmp_path / "copy" / sound.name
    FAULTS[sentence](folder)
    found = problems(folder)
    assert any(sentence in problem for problem in found), found
