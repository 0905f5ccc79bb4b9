"""Deleting is a rename that can be taken back until it is purged."""

import shutil
from pathlib import Path

import numpy as np
import pytest

from dextouch.episodes.trash import TRASH, list_trash, purge_trash, put_into_trash
from dextouch.errors import ConflictError, NotFoundError

ID = "stand-bottle-0003"
DAY_NS = 86_400 * 10**9


@pytest.fixture
def filled(made, store):
    made.write(store)
    return store


def test_what_is_deleted_vanishes_and_comes_back_whole(filled, made):
    size = sum(p.stat().st_size for p in (filled.root / "episodes" / ID).rglob("*") if p.is_file())
    sha256 = filled.open(ID).content_sha256
    filled.delete(ID)
    assert filled.list() == []
    assert not filled.exists(ID)
    with pytest.raises(NotFoundError):
        filled.open(ID)
    with pytest.raises(NotFoundError, match="not in the store"):
        filled.delete(ID)
    (entry,) = filled.trash_list()
    assert (entry.kind, entry.item_id, entry.num_bytes) == ("episode", ID, size)
    filled.restore(ID)
    assert filled.trash_list() == []
    reader = filled.open(ID)
    reader.verify()
    assert reader.content_sha256 == sha256
    np.testing.assert_array_equal(reader.read("action").values, made.values["action"])
    with pytest.raises(NotFoundError, match="not in the trash"):
        filled.restore(ID)


def test_the_newest_comes_back_first_and_never_over_another(filled, made):
    filled.delete(ID)
    second = made.write(filled, task="stack_bowls").content_sha256
    with pytest.raises(ConflictError, match="exists"):
        filled.restore(ID)
    assert filled.open(ID).content_sha256 == second
    filled.delete(ID)
    assert len(filled.trash_list()) == 2
    filled.restore(ID)
    assert filled.open(ID).attributes.task == "stack_bowls"


def test_of_one_moment_both_are_kept(filled, made):
    put_into_trash(filled.root, "episode", ID, now_ns=5)
    made.write(filled)
    put_into_trash(filled.root, "episode", ID, now_ns=5)
    assert [entry.deleted_at_ns for entry in list_trash(filled.root)] == [5, 6]


def test_purge_takes_what_is_old_enough(filled, made):
    put_into_trash(filled.root, "episode", ID, now_ns=10 * DAY_NS)
    made.write(filled)
    put_into_trash(filled.root, "episode", ID, now_ns=20 * DAY_NS)
    month_s = 30 * 86_400.0
    assert purge_trash(filled.root, older_than_s=month_s, now_ns=40 * DAY_NS - 1) == []
    assert len(purge_trash(filled.root, older_than_s=month_s, now_ns=40 * DAY_NS)) == 1
    assert [entry.deleted_at_ns for entry in list_trash(filled.root)] == [20 * DAY_NS]
    assert purge_trash(filled.root, older_than_s=month_s, now_ns=50 * DAY_NS - 1) == []
    assert len(filled.purge()) == 1
    assert list((filled.root / TRASH).iterdir()) == []


def test_an_interrupted_purge_is_completed_and_nothing_half_comes_back(filled, monkeypatch):
    filled.delete(ID)

    def die(folder):
        (Path(folder) / "action" / "c" / "0" / "0").unlink()
        raise KeyboardInterrupt

    monkeypatch.setattr(shutil, "rmtree", die)
    with pytest.raises(KeyboardInterrupt):
        filled.purge()
    monkeypatch.undo()
    assert len(filled.trash_list()) == 1
    with pytest.raises(NotFoundError, match="not in the trash"):
        filled.restore(ID)
    filled.purge()
    assert filled.trash_list() == []


def test_for_good_leaves_nothing(filled):
    filled.delete(ID, for_good=True)
    assert filled.trash_list() == []
    assert [path for path in filled.root.rglob("*") if path.is_file()] == []


def test_of_a_link_only_the_link_goes(filled, tmp_path):
    folder = filled.root / "episodes" / ID
    folder.rename(tmp_path / "elsewhere")
    folder.symlink_to(tmp_path / "elsewhere")
    filled.delete(ID, for_good=True)
    assert (tmp_path / "elsewhere" / "commit.json").is_file()
    assert filled.list() == []


@pytest.mark.parametrize("name", ["foreign", "episode.x", "episode.x.-1", "thing.x.1", "x"])
def test_foreign_things_in_the_trash_are_left_alone(filled, name):
    (filled.root / TRASH / name).mkdir(parents=True)
    assert filled.trash_list() == []
    assert filled.purge() == []
    assert (filled.root / TRASH / name).is_dir()
