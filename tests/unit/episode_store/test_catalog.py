"""The catalog: every filter, pages that stand still, hours, and no look at what did not change."""

import os
import shutil
import tempfile
import time
from contextlib import contextmanager
from datetime import UTC, datetime
from pathlib import Path

import pytest
from pydantic import ValidationError

from dextouch.episodes import EpisodeStore
from dextouch.errors import InvalidInputError, LimitExceededError, StorageError
from services.episode_store import catalog_index
from services.episode_store.catalog import Catalog
from services.episode_store.filters import CatalogFilter, EpisodeFilter, Page
from tests.unit.episode_store.episodes import write_episode

MORNING, NOON = (datetime(2026, 5, 4, hour, tzinfo=UTC) for hour in (8, 12))


@pytest.fixture
def store(settings):
    ours = EpisodeStore(settings.store_url)
    write_episode(ours, "a", operator="ada", station="bench", created_at=MORNING)
    write_episode(ours, "b", task="stack_bowls", success=False, quality={"coverage": 0.95})
    write_episode(ours, "c", domain="human", origin="recorded", success=None, operator="bo")
    quality = {"coverage": 0.5, "tip_error_mm": 3.0}
    write_episode(ours, "d", origin="imagined", recovered=True, quality=quality, created_at=NOON)
    return ours


def ids(catalog, **wanted):
    found = catalog.episodes(EpisodeFilter.model_validate(wanted), limit=100)
    return "".join(episode.episode_id for episode in found.episodes)


@pytest.mark.parametrize(
    ("wanted", "expected"),
    [
        ({}, "abcd"),
        ({"task": "stack_bowls"}, "b"),
        ({"operator": "ada"}, "a"),
        ({"station": "bench"}, "a"),
        ({"domain": "human"}, "c"),
        ({"origin": "imagined"}, "d"),
        ({"success": False}, "b"),
        ({"recovered": True}, "d"),
        ({"recovered": False}, "abc"),
        ({"min_quality": ("coverage:0.5",)}, "bd"),
        ({"min_quality": ("coverage:0.95",)}, "b"),
        ({"min_quality": ("coverage:0.1", "tip_error_mm:3")}, "d"),
        ({"min_quality": ("unknown:-inf",)}, "abcd"),
        ({"created_after": MORNING}, "ad"),
        ({"created_after": NOON}, "d"),
        ({"created_before": NOON}, "a"),
        ({"task": "stand_bottle", "success": True, "origin": "twin"}, "a"),
    ],
)
def test_filters(store, wanted, expected):
    assert ids(Catalog(store), **wanted) == expected


@pytest.mark.parametrize("bound", ["coverage", "coverage:", ":1", "coverage:nan", "coverage:x"])
def test_a_bound_that_is_none_is_refused(bound):
    with pytest.raises(ValidationError, match="NAME:NUMBER"):
        EpisodeFilter(min_quality=(bound,))


def test_rows_say_how_long_an_episode_is(store):
    (row,) = Catalog(store).episodes(EpisodeFilter(operator="ada"), limit=9).episodes
    assert (row.station, row.num_steps, row.created_at) == ("bench", 9, MORNING)
    assert row.duration_s == pytest.approx(9 / 15)


def test_pages_stand_still_while_episodes_come_and_go(store):
    catalog = Catalog(store)
    first = catalog.episodes(EpisodeFilter(), limit=2)
    assert (first.next_after, first.num_matching) == ("b", 4)
    store.delete("a")
    write_episode(store, "aa")
    second = catalog.episodes(EpisodeFilter(), limit=2, page=Page(after=first.next_after))
    assert [episode.episode_id for episode in second.episodes] == ["c", "d"]
    assert second.next_after is None
    assert catalog.episodes(EpisodeFilter(), limit=2, page=Page(after="d")).episodes == ()
    assert catalog.episodes(EpisodeFilter(), limit=2, page=Page(offset=9)).next_after is None


def test_hours(store):
    found = Catalog(store).hours(EpisodeFilter())
    rows = {(row.task, row.domain, row.origin): row for row in found.rows}
    assert list(rows) == sorted(rows)
    assert len(rows) == 4
    write_episode(store, "e", num_steps=45)
    again = Catalog(store).hours(EpisodeFilter(origin="twin", task="stand_bottle"))
    (row,) = again.rows
    assert (row.num_episodes, row.num_successes) == (2, 2)
    assert row.hours == pytest.approx((9 + 45) / 15 / 3600)
    assert (again.num_episodes, again.hours) == (2, pytest.approx(row.hours))


def test_what_did_not_change_is_not_looked_at(store, monkeypatch):
    """After the folder's stamp has settled, a list costs one stat."""
    catalog = Catalog(store)
    long_ago_ns = time.time_ns() - 10 * catalog_index.SETTLED_NS
    os.utime(store.root / "episodes", ns=(long_ago_ns, long_ago_ns))
    assert ids(catalog) == "abcd"
    with monkeypatch.context() as patch:
        for name in ("folder_numbers", "fingerprints", "open"):
            patch.setattr(store, name, None)
        assert ids(catalog, origin="twin") == "ab"
    store.delete("b")
    write_episode(store, "f")
    assert ids(catalog) == "acdf"
    opened = []
    whole = store.open
    monkeypatch.setattr(store, "open", lambda name: opened.append(name) or whole(name))
    store.delete("a")
    write_episode(store, "a", task="stack_bowls")
    opened.clear()
    assert ids(catalog, task="stack_bowls") == "a"
    assert opened == ["a"]


def test_a_young_stamp_is_not_believed(store):
    """Two changes may have one stamp, where the stamps of a file system are coarse."""
    catalog, folder, now_ns = Catalog(store), store.root / "episodes", time.time_ns()
    os.utime(folder, ns=(now_ns, now_ns))
    assert ids(catalog) == "abcd"
    store.delete("a")
    os.utime(folder, ns=(now_ns, now_ns))
    assert ids(catalog) == "bcd"


def test_recordings_are_filtered_too(start, attributes, batch_of, store):
    client = start()
    for number, changes in enumerate(
        ({"operator": "ada", "quality": {"coverage": 0.9}}, {"station": "other"})
    ):
        take = attributes.model_copy(update={"recording_id": f"take-{number}", **changes})
        client.create(take)
        client.send_batch(take.recording_id, take.streams[0], batch_of(0, 30), number=0)
        client.finish(take.recording_id, {"glove_left": 1, "wrist_left": 0}, success=not number)
    catalog = Catalog(store)

    def found(**wanted):
        rows = catalog.recordings(CatalogFilter.model_validate(wanted), limit=9).recordings
        return [row.recording_id for row in rows]

    assert found() == ["take-0", "take-1"]
    assert found(operator="ada") == ["take-0"]
    assert found(station="other", success=False) == ["take-1"]
    assert found(min_quality=("coverage:0.8",)) == ["take-0"]
    row = catalog.recordings(limit=1).recordings[0]
    assert row.duration_s == pytest.approx(30 / 60)
    files = (store.root / "recordings" / "take-0").rglob("*")
    assert row.num_bytes == sum(file.stat().st_size for file in files if file.is_file())
    assert catalog.bytes_by_station() == {
        "bench": row.num_bytes,
        "other": pytest.approx(row.num_bytes, abs=99),
    }


def test_over_http(start, store):
    client = start(max_page=3)
    page = client.episodes()
    assert [episode.episode_id for episode in page.episodes] == ["a", "b", "c"]
    assert client.episodes(after=page.next_after).episodes[0].episode_id == "d"
    assert client.episodes(min_quality=["coverage:0.1", "tip_error_mm:1"]).num_matching == 1
    assert client.episodes(created_after=NOON, created_before=None).num_matching == 1
    assert client.hours(domain="human").num_episodes == 1
    assert client.recordings(task="x").num_matching == 0
    with pytest.raises(LimitExceededError, match="at most 3") as caught:
        client.episodes(limit=4)
    assert caught.value.details["expected"] == 3
    for unknown in ({"opertor": "ada"}, {"min_quality": "coverage"}, {"created_after": "noon"}):
        with pytest.raises(InvalidInputError):
            client.episodes(**unknown)


NOBODY = 65534


@contextmanager
def no_superuser():
    """Permissions count within, also where the tests run as root."""
    before = os.geteuid()
    os.seteuid(NOBODY if before == 0 else before)
    try:
        yield
    finally:
        os.seteuid(before)


@pytest.fixture
def reachable():
    """A folder that every user can reach, unlike those of pytest."""
    base = Path(tempfile.mkdtemp(prefix="dextouch-store-"))
    base.chmod(0o755)
    yield base
    shutil.rmtree(base)


def test_an_episode_that_may_not_be_read_hides_no_other(reachable):
    store = EpisodeStore(reachable)
    for name in ("closed", "open"):
        write_episode(store, name)
    # As mkfs leaves it in a disk of its own.
    (reachable / "episodes" / "lost+found").mkdir(mode=0)
    closed = reachable / "episodes" / "closed"
    closed.chmod(0)
    with no_superuser():
        assert ids(Catalog(store)) == "open"
        # Opening it says what is wrong.
        assert store.list() == ["closed", "open"]
        for look in (store.open, store.exists, store.num_bytes):
            with pytest.raises(StorageError, match=r"closed.*Permission denied"):
                look("closed")
    closed.chmod(0o755)
    assert ids(Catalog(store)) == "closedopen"
