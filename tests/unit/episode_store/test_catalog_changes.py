"""The catalog beside other programs: what they write, erase and break while it is used."""

import json
import sqlite3
import threading
from datetime import datetime
from random import Random

import pytest
from pydantic import ValidationError
from structlog.testing import capture_logs

from dextouch.episodes import EpisodeStore
from dextouch.episodes.maintenance import DeletionRequest, delete_for_good
from dextouch.errors import StorageError
from dextouch.schemas import Review
from services.episode_store import catalog_index
from services.episode_store.app import PeriodicThread
from services.episode_store.catalog import Catalog
from services.episode_store.catalog_file import CatalogFile
from services.episode_store.filters import EpisodeFilter, ItemFilter, Page
from tests.unit.episode_store.random_items import NOON, put_item

REVIEW = Review(verdict="accepted", reviewer="reviewer-of-ada", reviewed_at=NOON)


@pytest.fixture
def store(settings):
    ours = EpisodeStore(settings.store_url)
    for name in ("a", "b"):
        put_item(ours, "episode", name, operator=f"operator-of-{name}")
    return ours


def ids(catalog, **wanted):
    found = catalog.episodes(EpisodeFilter(**wanted), limit=999)
    return [episode.episode_id for episode in found.episodes]


def test_a_query_reads_one_state(store):
    """Others write between its statements, as when a page is counted and then read."""
    catalog, other = Catalog(store), Catalog(store)
    assert ids(catalog) == ids(other)

    def query(connection):
        text = "SELECT id FROM item ORDER BY id"
        before = connection.execute(text).fetchall()
        store.delete("a")
        assert ids(other) == ["b"]
        return before, connection.execute(text).fetchall()

    before, after = catalog.index.read(query)
    assert before == after == [("a",), ("b",)]
    assert ids(catalog) == ["b"]


def test_a_query_that_fails_keeps_the_file(store):
    catalog = Catalog(store)
    ids(catalog)
    path = catalog.index._file.path
    with pytest.raises(sqlite3.OperationalError, match="no such table"):
        catalog.index.read(lambda connection: connection.execute("SELECT * FROM none"))
    assert ids(catalog) == ["a", "b"]
    assert catalog.index._file.path == path
    with pytest.raises(ValidationError, match="at most 20"):
        EpisodeFilter(min_quality=("coverage:0",) * 21)


def catalog_bytes(store):
    return b"".join(path.read_bytes() for path in (store.root / ".catalog").iterdir())


def erase(store, folder, operator):
    receipt = folder / f"{operator}.json"
    assert delete_for_good(store.root, DeletionRequest(operator=operator), receipt).complete


def test_what_is_erased_while_it_is_read_gets_no_row(store, tmp_path, monkeypatch):
    catalog = Catalog(store)
    ids(catalog)
    put_item(store, "episode", "c", operator="operator-of-c")
    put_item(store, "episode", "d")
    whole = catalog_index.read_row

    def slow(*args):
        row = whole(*args)
        if args[2] == "c":
            erase(store, tmp_path, "operator-of-c")
        return row

    monkeypatch.setattr(catalog_index, "read_row", slow)
    assert ids(catalog) == ["a", "b", "d"]
    assert b"operator-of-c" not in catalog_bytes(store)


def test_what_is_reviewed_while_it_is_read_is_read_again(store, monkeypatch):
    monkeypatch.setattr(catalog_index, "SETTLED_NS", 0)
    monkeypatch.setattr(catalog_index, "ALWAYS_CHECKED", 0)
    whole = catalog_index.read_row

    def slow(*args):
        row = whole(*args)
        store.set_review(args[2], REVIEW)
        return row

    monkeypatch.setattr(catalog_index, "read_row", slow)
    catalog = Catalog(store)
    ids(catalog)
    monkeypatch.setattr(catalog_index, "read_row", whole)
    assert ids(catalog) == ["a", "b"]
    assert len(catalog.items(ItemFilter(review="accepted"), limit=9).items) == 2


def test_files_of_no_catalog_are_erased(store, tmp_path):
    ids(catalog := Catalog(store))
    for name in ("v1-dead.sqlite-wal", "v1-dead.sqlite-journal", "copy"):
        (store.root / ".catalog" / name).write_bytes(b"... operator-of-a ...")
    erase(store, tmp_path, "operator-of-a")
    assert b"operator-of-a" not in catalog_bytes(store)
    assert catalog.index._file.path.exists()
    assert ids(catalog) == ["b"]


def test_rows_of_items_that_stay_come_back_after_an_erasure(store, tmp_path, monkeypatch):
    monkeypatch.setattr(catalog_index, "SETTLED_NS", 0)
    put_item(store, "recording", "r", operator="reviewer-of-ada")
    store.set_review("b", REVIEW)
    catalog = Catalog(store)
    assert ids(catalog) == ids(catalog) == ["a", "b"]
    erase(store, tmp_path, "reviewer-of-ada")
    assert ids(catalog) == ["a", "b"]


def test_a_number_of_a_folder_is_used_again(store, monkeypatch):
    monkeypatch.setattr(catalog_index, "SETTLED_NS", 0)
    monkeypatch.setattr(catalog_index, "ALWAYS_CHECKED", 0)
    whole = store.folder_numbers
    monkeypatch.setattr(store, "folder_numbers", lambda **of: dict.fromkeys(whole(**of), 7))
    catalog = Catalog(store)
    assert ids(catalog) == ids(catalog) == ["a", "b"]
    store.delete("b", for_good=True)
    put_item(store, "episode", "b", task="other")
    assert ids(catalog, task="other") == ["b"]


def test_a_failure_of_the_disk_hides_an_item_until_the_next_check(store, monkeypatch):
    catalog = Catalog(store)
    ids(catalog)
    put_item(store, "episode", "c")
    with monkeypatch.context() as broken, capture_logs() as logs:
        failure = StorageError("read: Too many open files")
        broken.setattr(store, "open", lambda _: (_ for _ in ()).throw(failure))
        # The row of an item that was changed stays.
        (store.root / "episodes" / "a" / "zarr.json").touch()
        for _ in range(2):
            catalog.index.check()
            assert ids(catalog) == ["a", "b"]
    assert sorted(entry["id"] for entry in logs) == ["a", "c"]
    catalog.index.check()
    assert ids(catalog) == ["a", "b", "c"]


@pytest.mark.parametrize("name", ["review.json", "clicks.json"])
def test_an_item_with_a_damaged_remark_is_listed_without_it(store, name):
    store.set_review("a", REVIEW)
    (store.root / "episodes" / "a" / name).write_text("{damaged")
    with capture_logs() as logs:
        catalog = Catalog(store)
        assert ids(catalog) == ids(catalog) == ["a", "b"]
    assert [(entry["event"], entry["id"]) for entry in logs] == [("remark_unreadable", "a")]
    reviews = [item.review for item in catalog.items(ItemFilter(kind="episode"), limit=9).items]
    assert reviews == [None if name == "review.json" else REVIEW, None]


def test_a_mistake_does_not_end_a_thread():
    done, rounds = threading.Event(), []

    def wrong():
        rounds.append(1)
        if len(rounds) > 2:
            done.set()
        raise ValueError("a mistake")

    thread = PeriodicThread("failed", 0.001, wrong)
    with capture_logs() as logs:
        thread.start()
        assert done.wait(10)
        thread.stop()
    assert [entry["event"] for entry in logs] == ["failed"]


def test_times_that_have_no_date_in_utc(store):
    for name, text in (("x", "0001-01-01T00:00:00+14:00"), ("y", "9999-12-31T23:00:00-14:00")):
        put_item(store, "episode", name, created_at=datetime.fromisoformat(text))
    order = Page(sort="time")
    found = Catalog(store).episodes(EpisodeFilter(), limit=9, page=order).episodes
    assert [episode.episode_id for episode in found][-1] == "y"
    assert len(found) == 4
    json.dumps([episode.model_dump(mode="json") for episode in found])


@pytest.mark.parametrize("descending", [False, True])
@pytest.mark.parametrize("sort", ["id", "duration"])
def test_pages_go_on_after_an_id(store, sort, descending):
    for name in ("a-b", "a_b", "a0"):
        put_item(store, "episode", name)
    put_item(store, "recording", "a")
    catalog, page = Catalog(store), {"descending": descending, "sort": sort}
    names = sorted(["a", "a-b", "a_b", "a0", "b"], reverse=descending)
    for kind in ("episode", "take"):
        query = ItemFilter(kind=kind)
        found = [one.id for one in catalog.items(query, limit=9, page=Page(**page)).items]
        if sort == "id":
            assert list(dict.fromkeys(found)) == names
            for place, name in enumerate(names):
                later = catalog.items(query, limit=9, page=Page(**page, after=name)).items
                assert list(dict.fromkeys(one.id for one in later)) == names[place + 1 :]
        # Page by page, as `next_after` says.
        paged, after = [], None
        while len(paged) < len(found):
            one = catalog.items(query, limit=1, page=Page(**page, after=after))
            paged, after = [*paged, one.items[0].id], one.next_after
        assert (paged, after) == (found, None)


@pytest.mark.parametrize("seed", range(3))
def test_what_others_change_is_listed_as_by_a_new_catalog(store, monkeypatch, seed):
    monkeypatch.setattr(catalog_index, "ALWAYS_CHECKED", 0)
    catalog, other, chance = Catalog(store), EpisodeStore(store.url), Random(seed)
    trashed = []
    for number in range(12):
        there = other.list()
        change = chance.choice(("commit", "delete", "restore", "replace", "rename"))
        if change == "restore" and trashed:
            other.restore(trashed.pop())
        elif change in ("commit", "restore") or len(there) < 2:
            put_item(other, "episode", f"new-{number}", task=f"task-{number % 3}")
        elif change == "rename":
            folder = other.root / "episodes" / chance.choice(there)
            folder.rename(folder.with_name(f"moved-{number}"))
        else:
            name = chance.choice(there)
            other.delete(name, for_good=change == "replace")
            if change == "replace":
                put_item(other, "episode", name, task="replaced")
            else:
                trashed.append(name)
        with monkeypatch.context() as alone:
            # In memory, so that it takes no row over from the file.
            alone.setattr(CatalogFile, "_open_file", lambda _: sqlite3.connect("/none/none"))
            fresh = Catalog(other)
            expected = fresh.items(ItemFilter(), limit=99), fresh.hours(EpisodeFilter())
        assert (catalog.items(ItemFilter(), limit=99), catalog.hours(EpisodeFilter())) == expected
