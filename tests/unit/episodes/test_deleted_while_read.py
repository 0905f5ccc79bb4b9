"""A reader of a group that is deleted, or written anew, at any moment of reading it."""

import os
import pickle
import shutil
from functools import partial
from pathlib import Path

import numpy as np
import pytest

from dextouch.episodes import EpisodeStore
from dextouch.episodes import store as store_module
from dextouch.episodes.maintenance import inspect_group
from dextouch.errors import CorruptDataError, NotFoundError, StorageError
from dextouch.schemas import Review
from tests.contracts.s3_server import CREDENTIALS, running_s3
from tests.unit.episodes.conftest import episode_of

CAMERAS = ("camera_head", "camera_wrist_left")
FILE_CALLS = ("stat", "open", "read_bytes", "is_file", "is_symlink")


def read_a_window(store, item_id):
    return store.open(item_id).window(2, 5, cameras=CAMERAS).images["camera_head"]


def read_samples(store, item_id):
    return store.open(item_id).read("tactile_left").values


def read_encoded_images(store, item_id):
    return store.open(item_id).encoded_images("camera_head", 0, 3)


def verify(store, item_id):
    return store.open(item_id).verify()


def inspect(store, item_id):
    report = inspect_group(store.files(item_id), "episode")
    assert not report.damaged, report.findings
    return report


def look(store, item_id):
    return store.num_bytes(item_id), store.review(item_id)


USES = (read_a_window, read_samples, read_encoded_images, verify, inspect, look)


@pytest.fixture
def made():
    return episode_of(num_steps=9, camera_unit="jpeg")


class ChangedAtCall:
    """Calls `change` once, before the call number `number` that looks at a file of a group."""

    def __init__(self, monkeypatch, folder, number, change):
        self.folder, self.left, self.change = str(folder), number, change
        for name in FILE_CALLS:
            monkeypatch.setattr(Path, name, self.wrapped(getattr(Path, name)))

    def wrapped(self, original):
        def call(path, *args, **kwargs):
            if self.left is not None and str(path).startswith(self.folder):
                self.left -= 1
                if self.left < 0:
                    self.left = None
                    self.change()
            return original(path, *args, **kwargs)

        return call


def outcomes(made, root, use, change):
    """What a use gives if the group changes before its first, second, … look at a file."""
    number = 0
    made.write(EpisodeStore(root / "original"))
    while True:
        store = EpisodeStore(root / str(number))
        shutil.copytree(root / "original", store.root, copy_function=os.link)
        item_id = made.attributes.episode_id
        folder = store.root / "episodes" / item_id
        with pytest.MonkeyPatch.context() as patch:
            at_call = ChangedAtCall(patch, folder, number, partial(change, store, item_id))
            try:
                yield use(store, item_id)
            except NotFoundError as error:
                yield error
            if at_call.left is not None:
                return
        # All of the first looks, and ever fewer of the many at the arrays.
        number += 1 + number // 6


@pytest.mark.long
@pytest.mark.parametrize("use", USES)
@pytest.mark.parametrize("for_good", [False, True])
def test_a_deleted_item_is_not_found_and_never_damaged(made, tmp_path, use, for_good):
    found = list(
        outcomes(made, tmp_path, use, lambda store, name: store.delete(name, for_good=for_good))
    )
    assert any(isinstance(one, NotFoundError) for one in found)
    # The last one was not disturbed.
    assert not isinstance(found[-1], NotFoundError)
    errors = [one for one in found if isinstance(one, NotFoundError)]
    assert all(made.attributes.episode_id in error.message for error in errors)


@pytest.mark.long
@pytest.mark.parametrize("use", USES)
def test_an_item_that_is_written_anew_is_never_damaged(made, tmp_path, use):
    other = episode_of(num_steps=12, camera_unit="jpeg", seed=8)
    other.write(EpisodeStore(tmp_path / "other"))

    def replace(store, name):
        store.delete(name)
        shutil.copytree(
            tmp_path / "other" / "episodes", store.root / "episodes", dirs_exist_ok=True
        )

    assert len(list(outcomes(made, tmp_path, use, replace))) > 2


def test_a_damaged_item_stays_damaged(made, tmp_path):
    store = EpisodeStore(tmp_path)
    reader = made.write(store)
    next(tmp_path.rglob("tactile_left/c/0/0")).write_bytes(b"")
    with pytest.raises(CorruptDataError):
        reader.read("tactile_left")
    next(tmp_path.rglob("tactile_left/c/0/0")).unlink()
    with pytest.raises(CorruptDataError, match="shard file is missing"):
        pickle.loads(pickle.dumps(store.open(reader.item_id))).read("tactile_left")  # noqa: S301


def test_a_review_of_a_deleted_item_is_not_found(made, tmp_path, monkeypatch):
    store = EpisodeStore(tmp_path)
    reader = made.write(store)
    review = Review(verdict="accepted", reviewed_at="2026-01-02T03:04:05Z")
    real = store_module.replace_file

    def after_deletion(path, data):
        store.delete(reader.item_id)
        real(path, data)

    monkeypatch.setattr(store_module, "replace_file", after_deletion)
    with pytest.raises(NotFoundError):
        store.set_review(reader.item_id, review)


@pytest.fixture(scope="module")
def s3_server():
    with running_s3() as server:
        yield server


@pytest.mark.long
@pytest.mark.parametrize("again", [False, True])
def test_a_reader_of_a_bucket_finds_a_deleted_item_gone(s3_server, tmp_path, again):
    url = s3_server.url(f"deleted/{tmp_path.name}")
    store = EpisodeStore(url, CREDENTIALS | {"work_folder": str(tmp_path), "cache_bytes": "0"})
    made = episode_of(num_steps=121)
    reader = made.write(store)
    opened = reader.stamps_ns("tactile_left")
    assert len(opened)
    fresh = store.open(reader.item_id)
    fresh.num_samples("tactile_right")
    store.delete(reader.item_id)
    if again:
        episode_of(num_steps=33, seed=8).write(store)
    change = "replaced" if again else "deleted"
    for name in ("tactile_left", "camera_head"):
        with pytest.raises(NotFoundError, match=change):
            reader.values(name, 0, 2)
        with pytest.raises(NotFoundError, match=change):
            fresh.values(name, 0, 2)
    with pytest.raises(NotFoundError, match=change):
        fresh.verify()


def test_an_unreachable_store_does_not_hide_the_first_error(made, tmp_path, monkeypatch):
    store = EpisodeStore(tmp_path)
    reader = made.write(store)
    next(tmp_path.rglob("tactile_left/c/0/0")).unlink()

    def broken(*_):
        raise StorageError("no answer")

    monkeypatch.setattr(type(store.files(reader.item_id)), "get_now", broken)
    with pytest.raises(CorruptDataError, match="shard file is missing"):
        reader.read("tactile_left")
    assert np.isfinite(reader.read("tactile_right").values).all()
