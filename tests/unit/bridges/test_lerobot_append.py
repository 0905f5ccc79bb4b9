"""Datasets that grow, are replaced, hold every touch sample, and describe themselves on a card."""

import hashlib
import json
import os
import signal
import subprocess
import sys
from pathlib import Path

import numpy as np
import pyarrow.parquet as pq
import pytest
import yaml

from dextouch.bridges import export_files as files
from dextouch.bridges.lerobot import (
    ExportOptions,
    export_dataset,
    exporting,
    import_dataset,
)
from dextouch.episodes import EpisodeStore
from dextouch.errors import ConflictError, CorruptDataError, InvalidInputError, StorageError
from tests.unit.bridges.lerobot_edits import (
    EPISODES,
    INFO,
    STATS,
    edit_column,
    edit_json,
    set_item,
)
from tests.unit.bridges.lerobot_episodes import make_episode
from tests.unit.bridges.lerobot_structure import problems

APPEND = ExportOptions(existing="append")
LENGTHS = {3: 9, 4: 7, 5: 11, 6: 5}


@pytest.fixture
def store(tmp_path):
    return EpisodeStore(tmp_path / "store")


@pytest.fixture
def folder(tmp_path):
    return tmp_path / "exports" / "dataset"


def episode(store, seed, **changes):
    return make_episode(seed=seed, num_steps=LENGTHS[seed], **changes).write(store)


def hashes(folder):
    return {
        path.relative_to(folder).as_posix(): hashlib.sha256(path.read_bytes()).hexdigest()
        for path in folder.rglob("*")
        if path.is_file()
    }


def read(path):
    return json.loads(path.read_text())


def rows(folder, place):
    paths = sorted((folder / place).glob("*/*.parquet"))
    return [row for path in paths for row in pq.read_table(path).to_pylist()]


def test_appended_episodes_give_the_dataset_of_one_export(store, folder, tmp_path):
    readers = [episode(store, seed) for seed in LENGTHS]
    export_dataset(readers, tmp_path / "whole", repo_id="lab/touch")
    export_dataset(readers[:1], folder, repo_id="lab/touch")
    before = hashes(folder)
    first = export_dataset(readers[:3], folder, repo_id="lab/touch", options=APPEND)
    assert (first.num_episodes, first.num_frames) == (2, LENGTHS[4] + LENGTHS[5])
    assert first.present == (readers[0].item_id,)
    export_dataset(readers, folder, repo_id="lab/touch", options=APPEND)
    assert problems(folder) == []
    assert [p.name for p in folder.parent.iterdir()] == ["dataset"]
    kept = {name: digest for name, digest in hashes(folder).items() if name in before}
    changed = {name for name in before if before[name] != kept[name]}
    assert changed == {INFO, STATS, "README.md", "meta/tasks.parquet"}
    assert rows(folder, "data") == rows(tmp_path / "whole", "data")
    ids = import_dataset(folder, EpisodeStore(tmp_path / "other")).ids
    assert ids == [reader.attributes.episode_id for reader in readers]
    whole, grown = (
        {(n, k): np.array(v) for n, kinds in read(f / STATS).items() for k, v in kinds.items()}
        for f in (tmp_path / "whole", folder)
    )
    for key, value in whole.items():
        np.testing.assert_allclose(grown[key], value, rtol=1e-9, atol=1e-12, err_msg=str(key))


def test_appending_what_is_there_changes_nothing(store, folder):
    reader = episode(store, 3)
    export_dataset([reader], folder, repo_id="lab/touch")
    before = hashes(folder)
    done = export_dataset([reader], folder, repo_id="lab/touch", options=APPEND)
    assert (done.num_episodes, done.present) == (0, (reader.item_id,))
    assert hashes(folder) == before


def _other_rate(folder, _):
    return ExportOptions(fps=30, existing="append"), "fps 15, not 30"


def _fewer_cameras(folder, _):
    options = ExportOptions(cameras=("camera_head",), existing="append")
    return options, "only the dataset has"


def _other_codec(folder, _):
    def change(info):
        about = info["features"]["observation.images.camera_head"]["info"]
        about["video.codec"] = "av1"

    edit_json(folder, INFO, change)
    return APPEND, "video.codec 'av1', not 'h264'"


def _other_shape(folder, _):
    edit_json(folder, INFO, lambda i: i["features"]["observation.state"].update(names=None))
    return APPEND, "'observation.state': names None"


def _other_splits(folder, _):
    edit_json(folder, INFO, lambda info: info.update(splits={"train": "0:0", "test": "0:1"}))
    return APPEND, "splits"


def _holes(folder, _):
    edit_column(folder, EPISODES, "episode_index", set_item(0, 2))
    return APPEND, "total_episodes 1, expected 3"


def _touch(folder, _):
    return ExportOptions(touch_samples=True, existing="append"), "--touch-samples"


@pytest.mark.parametrize(
    "change",
    [_other_rate, _fewer_cameras, _other_codec, _other_shape, _other_splits, _holes, _touch],
)
def test_what_does_not_fit_is_refused_and_the_dataset_stays(store, folder, change):
    export_dataset([episode(store, 3)], folder, repo_id="lab/touch")
    options, words = change(folder, store)
    before = hashes(folder)
    with pytest.raises(InvalidInputError, match=words):
        export_dataset([episode(store, 4)], folder, repo_id="lab/touch", options=options)
    assert hashes(folder) == before
    assert [p.name for p in folder.parent.iterdir()] == ["dataset"]


def test_statistics_and_links_of_others_are_refused(store, folder, tmp_path):
    export_dataset([episode(store, 3)], folder, repo_id="lab/touch")
    new = episode(store, 4)
    (folder / "link").symlink_to(tmp_path)
    with pytest.raises(CorruptDataError, match="is a link"):
        export_dataset([new], folder, repo_id="lab/touch", options=APPEND)
    (folder / "link").unlink()
    edit_json(folder, STATS, lambda stats: stats["action"].pop("q99"))
    with pytest.raises(CorruptDataError, match="q99"):
        export_dataset([new], folder, repo_id="lab/touch", options=APPEND)


def test_a_change_meanwhile_is_noticed(store, folder):
    export_dataset([episode(store, 3)], folder, repo_id="lab/touch")

    def readers():
        yield episode(store, 4)
        export_dataset([episode(store, 5)], folder, repo_id="lab/touch", options=APPEND)

    with pytest.raises(ConflictError, match="was changed"):
        export_dataset(readers(), folder, repo_id="lab/touch", options=APPEND)
    assert problems(folder) == []
    assert len(rows(folder, "meta/episodes")) == 2


_OTHERS = ("data", "card", "sync", "removal")
CRASH = """
import os, signal, sys
from pathlib import Path
from dextouch.bridges import export_files as files
from dextouch.bridges.lerobot import ExportOptions, export_dataset, exporting
from dextouch.episodes import EpisodeStore
root, where = Path(sys.argv[1]), sys.argv[2]
store = EpisodeStore(root / "store")
def die(*args, **more):
    os.kill(os.getpid(), signal.SIGKILL)
if where == "data":
    exporting.image_statistics = die
elif where == "card":
    exporting.write_card = die
elif where == "sync":
    files._sync = die
elif where == "exchange":
    files._exchange = die
elif where == "removal":
    files.shutil.rmtree = die
readers = [store.open(name) for name in store.list()]
options = ExportOptions(existing="append")
export_dataset(readers, root / "exports/dataset", repo_id="lab/touch", options=options)
"""


@pytest.mark.parametrize(
    "where",
    ["exchange", *(pytest.param(w, marks=pytest.mark.long) for w in _OTHERS)],
)
def test_a_killed_process_leaves_a_whole_dataset(store, folder, tmp_path, where):
    export_dataset([episode(store, 3)], folder, repo_id="lab/touch")
    before = hashes(folder)
    episode(store, 4)
    command = [sys.executable, "-c", CRASH, str(tmp_path), where]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    assert done.returncode == -signal.SIGKILL, done.stderr
    assert problems(folder) == []
    if where == "removal":
        assert len(rows(folder, "meta/episodes")) == 2
    else:
        assert hashes(folder) == before
    readers = [store.open(name) for name in store.list()]
    export_dataset(readers, folder, repo_id="lab/touch", options=APPEND)
    assert problems(folder) == []
    assert len(rows(folder, "meta/episodes")) == 2


@pytest.mark.skipif(sys.platform != "linux", reason="renameat2 is a system call of Linux")
def test_two_folders_are_exchanged_in_one_step(tmp_path):
    for name in ("new", "old"):
        (tmp_path / name).mkdir()
        (tmp_path / name / f"{name}.txt").touch()
    assert files._exchange(tmp_path / "new", tmp_path / "old")
    assert [p.name for p in (tmp_path / "old").iterdir()] == ["new.txt"]
    assert [p.name for p in (tmp_path / "new").iterdir()] == ["old.txt"]
    assert not files._exchange(tmp_path / "new", tmp_path / "none")


def test_disks_that_cannot_exchange_or_link_do_as_well(store, folder, monkeypatch):
    export_dataset([episode(store, 3)], folder, repo_id="lab/touch")
    monkeypatch.setattr(files, "_exchange", lambda *_: False)
    monkeypatch.setattr(os, "link", lambda *_: (_ for _ in ()).throw(OSError("no links")))
    export_dataset([episode(store, 4)], folder, repo_id="lab/touch", options=APPEND)
    assert problems(folder) == []
    replace = ExportOptions(existing="replace")
    export_dataset([episode(store, 5)], folder, repo_id="lab/touch", options=replace)
    assert len(rows(folder, "meta/episodes")) == 1
    assert [p.name for p in folder.parent.iterdir()] == ["dataset"]


def test_a_link_to_a_dataset_stays_one(store, folder, tmp_path, monkeypatch):
    link = tmp_path / "link"
    link.symlink_to(folder)
    export_dataset([episode(store, 3)], link, repo_id="lab/touch")
    export_dataset([episode(store, 4)], link, repo_id="lab/touch", options=APPEND)
    monkeypatch.chdir(folder)
    export_dataset([episode(store, 5)], Path(), repo_id="lab/touch", options=APPEND)
    assert link.is_symlink()
    assert len(rows(folder, "meta/episodes")) == 3
    assert [p.name for p in folder.parent.iterdir()] == ["dataset"]


def test_a_replacement_that_fails_leaves_the_old_dataset(store, folder, monkeypatch):
    export_dataset([episode(store, 3)], folder, repo_id="lab/touch")
    before = hashes(folder)

    def full(*_):
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(files, "_sync", full)
    options = ExportOptions(existing="replace")
    with pytest.raises(StorageError):
        export_dataset([episode(store, 4)], folder, repo_id="lab/touch", options=options)
    assert hashes(folder) == before
    (folder / INFO).unlink()
    with pytest.raises(ConflictError, match="is not a LeRobot data set"):
        export_dataset([episode(store, 5)], folder, repo_id="lab/touch", options=options)


def test_every_touch_sample_is_in_its_frame(store, folder):
    options = ExportOptions(touch_samples=True, fps=10)
    readers = [episode(store, 3), episode(store, 4)]
    done = export_dataset(readers, folder, repo_id="lab/touch", options=options)
    assert problems(folder) == []
    assert done.num_touch_left_out == 0
    info = read(folder / INFO)
    size = info["features"]["observation.tactile_samples"]["shape"][0]
    assert size == 9  # 60 Hz in frames of 10 Hz, and half as many more.
    kpa, offsets_ns, counts, stamps = ([] for _ in range(4))
    for row in rows(folder, "data"):
        if row["episode_index"] == 1:
            kpa.append(row["observation.tactile_samples"])
            offsets_ns.append(row["dextouch.tactile_samples_dt_ns"])
            counts.append(row["dextouch.tactile_samples_count"])
            stamps.append(row["dextouch.t_ref_ns"])
    kpa, offsets_ns, counts = np.float32(kpa), np.array(offsets_ns), np.array(counts)
    assert counts[0].tolist() == [1, 1]
    assert (counts[1:] == 6).all()
    for hand, side in enumerate(("left", "right")):
        data = readers[1].read(f"tactile_{side}")
        taken = [kpa[k, :n, hand] for k, n in enumerate(counts[:, hand])]
        times = [stamps[k] + offsets_ns[k, :n, hand] for k, n in enumerate(counts[:, hand])]
        inside = data.t_ref_ns <= stamps[-1] + 1000
        np.testing.assert_array_equal(np.concatenate(taken), data.values[inside])
        np.testing.assert_array_equal(np.concatenate(times), data.t_ref_ns[inside])
        for k, n in enumerate(counts[:, hand]):
            assert not kpa[k, n:, hand].any()
            assert not offsets_ns[k, n:, hand].any()


def test_touch_samples_beyond_the_room_are_counted(store, folder):
    first = episode(store, 3)
    made = make_episode(seed=4, num_steps=7)
    for side in ("left", "right"):
        name = f"tactile_{side}"
        made.stamps_ns[name] = np.arange(100, dtype=np.int64) * 4_000_000
        made.values[name] = np.ones((100, 320), dtype=np.float32)
    options = ExportOptions(touch_samples=True)
    done = export_dataset([first, made.write(store)], folder, repo_id="lab/touch", options=options)
    counts = [row["dextouch.tactile_samples_count"] for row in rows(folder, "data")]
    room = read(folder / INFO)["features"]["observation.tactile_samples"]["shape"][0]
    assert room == 6
    assert done.num_touch_left_out == sum(max(0, n - room) for row in counts for n in row) > 0


def test_the_card_is_valid_front_matter_and_says_what_there_is(store, folder):
    first = episode(store, 3)
    odd = make_episode(seed=4, num_steps=7).write(store, instruction="a | b\n<c>")
    options = ExportOptions(license_name="cc-by-4.0")
    export_dataset([first, odd], folder, repo_id="lab/touch", options=options)
    _, header, text = (folder / "README.md").read_text().split("---\n", 2)
    assert yaml.safe_load(header) == {
        "license": "cc-by-4.0",
        "task_categories": ["robotics"],
        "tags": ["LeRobot", "tactile", "bimanual", "dextouch"],
        "size_categories": ["n<1K"],
        "configs": [{"config_name": "default", "data_files": "data/*/*.parquet"}],
    }
    for part in (
        "# lab/touch",
        "| episodes | 2 |",
        "| frames | 16, 15 a second |",
        "| duration | 0.000 h |",
        "| cameras | camera_head 64 x 48, camera_wrist_left 64 x 48 |",
        "| acted by | robot 2 |",
        "| origin | twin 2 |",
        "| success | yes 2 |",
        "| stand the bottle up | 1 | 0.0 |",
        r"| a \| b \<c> | 1 |",
        "| `observation.tactile` | float32 | 2 x 320 | kPa",
        'LeRobotDataset("lab/touch")',
    ):
        assert part in text, part
    more = ExportOptions(existing="append")
    export_dataset([episode(store, 5)], folder, repo_id="lab/touch", options=more)
    card = folder / "README.md"
    assert "license: cc-by-4.0" in card.read_text()
    assert "| episodes | 3 |" in card.read_text()
    card.write_text("my own words\n")
    export_dataset([episode(store, 6)], folder, repo_id="lab/touch", options=more)
    assert card.read_text() == "my own words\n"
    wrong = ExportOptions(license_name="CC BY\nx: y")
    with pytest.raises(InvalidInputError, match="license"):
        export_dataset([first], folder.with_name("new"), repo_id="lab/touch", options=wrong)


def test_tables_of_episodes_with_other_columns_are_refused(store, folder, monkeypatch):
    export_dataset([episode(store, 3)], folder, repo_id="lab/touch")
    monkeypatch.delitem(exporting.layout.QUANTILES, "q10")
    with pytest.raises(InvalidInputError, match="q10"):
        export_dataset([episode(store, 4)], folder, repo_id="lab/touch", options=APPEND)
