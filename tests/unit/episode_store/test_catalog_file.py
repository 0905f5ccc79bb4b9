"""The catalog on disk: shared, rebuilt, damaged, locked, erased; and what is noticed when."""

import json
import os
import shutil
import signal
import sqlite3
import subprocess
import sys
import threading
import time
from contextlib import closing
from datetime import UTC, datetime

import pytest
from structlog.testing import capture_logs

from dextouch.episodes import EpisodeStore
from dextouch.episodes.bucket_storage import ORPHAN_AGE, sweep_orphans, upload_group
from dextouch.episodes.maintenance import DeletionRequest, delete_for_good
from dextouch.episodes.s3_bucket import Bucket
from dextouch.errors import StorageError
from dextouch.schemas import Review
from services.episode_store import catalog_file, catalog_index, command_line
from services.episode_store.catalog import Catalog
from services.episode_store.filters import EQUALITY_FILTERS, Condition, EpisodeFilter, ItemFilter
from tests.contracts.s3_server import CREDENTIALS, running_s3
from tests.unit.episode_store.random_items import NOON, put_item

REJECTED = Review(verdict="rejected", reviewer="reviewer-of-ada", reviewed_at=NOON)


@pytest.fixture
def store(settings):
    ours = EpisodeStore(settings.store_url)
    for name in ("a", "b", "c"):
        put_item(ours, "episode", name, operator=f"operator-of-{name}", quality={"coverage": 0.9})
    return ours


def ids(catalog, **wanted):
    found = catalog.episodes(EpisodeFilter(**wanted), limit=999)
    return [episode.episode_id for episode in found.episodes]


def test_lists_are_counted_by_columns_of_the_counts_alone():
    with closing(sqlite3.connect(":memory:")) as connection:
        connection.executescript(catalog_file._SCHEMA)
        columns = {row[1] for row in connection.execute("PRAGMA table_info(tally)")}
    for name in EQUALITY_FILTERS:
        where = Condition()
        ItemFilter.model_construct(**{name: "x"}).restrict(where)
        assert (where.terms, where.is_counted) == ([f"i.{name} = ?"], name in columns)


def databases(store):
    return sorted((store.root / ".catalog").glob("*.sqlite"))


def opened_items(store, monkeypatch):
    """The episodes that are read from now on."""
    opened, whole = [], store.open
    monkeypatch.setattr(store, "open", lambda name: opened.append(name) or whole(name))
    return opened


def test_another_process_reads_no_item_again(store, monkeypatch):
    assert ids(Catalog(store)) == ["a", "b", "c"]
    opened = opened_items(store, monkeypatch)
    put_item(store, "episode", "d")
    assert ids(Catalog(store)) == ["a", "b", "c", "d"]
    assert ids(Catalog(store), min_quality=("coverage:0.9",)) == ["a", "b", "c"]
    assert opened == ["d"]


def test_what_one_process_writes_another_sees(store, monkeypatch):
    first, second = Catalog(store), Catalog(store)
    assert ids(first) == ids(second)
    opened = opened_items(store, monkeypatch)
    put_item(store, "episode", "d")
    store.delete("a")
    assert ids(first) == ids(second) == ["b", "c", "d"]
    assert opened == ["d"]


@pytest.mark.parametrize("how", ["removed", "damaged", "half made", "of another version"])
def test_a_lost_file_loses_nothing(store, how):
    running = Catalog(store)
    assert ids(running) == ["a", "b", "c"]
    (path,) = databases(store)
    if how == "removed":
        shutil.rmtree(path.parent)
    elif how == "damaged":
        running.index._file.close()
        path.write_bytes(b"no database".ljust(8192, b"\0"))
    elif how == "half made":
        shutil.rmtree(path.parent)
        path.parent.mkdir()
        path.write_bytes(b"")
    else:
        with closing(sqlite3.connect(path)) as connection:
            connection.execute("PRAGMA user_version = 99")
        path.rename(path.with_name("v0-1.sqlite"))
        for suffix in ("-wal", "-shm"):
            path.with_name(path.name + suffix).unlink(missing_ok=True)
    put_item(store, "episode", "d")
    assert ids(Catalog(store)) == ids(running) == ["a", "b", "c", "d"]
    (path,) = databases(store)
    assert path.name.startswith(f"v{catalog_file.VERSION}-")
    assert not catalog_file.check_file(path)


def test_damage_within_is_found_while_it_is_used(store):
    catalog = Catalog(store)
    ids(catalog)
    (path,) = databases(store)
    with closing(sqlite3.connect(path)) as connection:
        connection.execute("PRAGMA wal_checkpoint(TRUNCATE)")
        size = connection.execute("PRAGMA page_size").fetchone()[0]
    data = path.read_bytes()
    path.write_bytes(data[:size] + b"\xff" * (len(data) - size))
    with capture_logs() as logs:
        assert ids(Catalog(store)) == ["a", "b", "c"]
    assert "catalog_damaged" in [entry["event"] for entry in logs]


@pytest.mark.parametrize("how", ["locked", "no folder"])
def test_without_a_file_all_items_are_scanned(store, monkeypatch, how):
    monkeypatch.setattr(catalog_file, "BUSY_S", 0.1)
    ids(Catalog(store))
    (path,) = databases(store)
    if how == "no folder":
        shutil.rmtree(path.parent)
        path.parent.write_text("a file where the folder should be")
    with closing(sqlite3.connect(path if how == "locked" else ":memory:")) as other:
        other.execute("BEGIN EXCLUSIVE")
        with capture_logs() as logs:
            catalog = Catalog(store)
            assert ids(catalog) == ["a", "b", "c"]
        put_item(store, "episode", "d")
        assert ids(catalog) == ["a", "b", "c", "d"]
    (entry,) = [entry for entry in logs if entry["event"] == "catalog_not_used"]
    assert "read" in entry["instead"]


WRITER = """
import sys
from dextouch.episodes import EpisodeStore
from services.episode_store import catalog_index
from services.episode_store.catalog import Catalog
catalog_index.BATCH = 5
print("ready", flush=True)
sys.stdin.readline()
Catalog(EpisodeStore(sys.argv[1])).values()
print("done", flush=True)
"""


def writer(store):
    """A process that makes the catalog when it is told to."""
    environment = os.environ | {"PYTHONPATH": os.pathsep.join(path for path in sys.path if path)}
    process = subprocess.Popen(
        [sys.executable, "-c", WRITER, str(store.root)],
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        env=environment,
    )
    assert process.stdout.readline() == b"ready\n"
    process.stdin.write(b"\n")
    process.stdin.flush()
    return process


def test_a_killed_writer_leaves_a_whole_catalog(store):
    for number in range(300):
        put_item(store, "episode", f"e-{number:03d}", quality={f"q{k}": 1.0 for k in range(50)})
    process = writer(store)
    # In the middle: some of the batches are there.
    wait_for(lambda: databases(store) and num_rows(databases(store)[0]) > 20)
    process.send_signal(signal.SIGKILL)
    assert b"done" not in process.communicate()[0]
    assert not catalog_file.check_file(databases(store)[0])
    assert len(ids(Catalog(store))) == 303
    assert Catalog(store).groups().groups[0].num_items == 303


def wait_for(condition):
    deadline = time.monotonic() + 60
    while not condition():
        assert time.monotonic() < deadline
        threading.Event().wait(0.005)


def num_rows(path):
    with closing(sqlite3.connect(path)) as connection:
        try:
            return connection.execute("SELECT count(*) FROM item").fetchone()[0]
        except sqlite3.OperationalError:
            return 0


def test_two_processes_write_at_once(store):
    for number in range(100):
        put_item(store, "episode", f"e-{number:03d}")
    processes = [writer(store) for _ in range(2)]
    for process in processes:
        assert process.communicate()[0] == b"done\n"
    (path,) = databases(store)
    assert num_rows(path) == 103
    assert Catalog(store).groups().groups[0].num_items == 103


@pytest.mark.parametrize("file", ["zarr.json", "review.json", "commit.json"])
def test_an_edit_by_hand_is_noticed_by_a_check(store, file):
    store.set_review("b", REJECTED.model_copy(update={"verdict": "accepted"}))
    catalog, folder = Catalog(store), store.root / "episodes" / "b"
    assert len(catalog.items(ItemFilter(review="accepted"), limit=9).items) == 1
    text = (folder / file).read_bytes().replace(b"accepted", b"rejected")
    # Of the same size, in place; the clock has gone back.
    (folder / file).write_bytes(text.replace(b"do it", b"do IT").replace(b"record", b"RECORD"))
    os.utime(folder / file, ns=(5, 5))
    catalog.index.check()
    if file == "review.json":
        assert len(catalog.items(ItemFilter(review="rejected"), limit=9).items) == 1
    else:
        # It no longer fits its hash.
        assert ids(catalog) == ["a", "c"]


def test_an_exchanged_item_is_noticed_by_a_look(store):
    catalog = Catalog(store)
    ids(catalog)
    folder = store.root / "episodes"
    put_item(store, "episode", "spare", task="other")
    ids(catalog)
    (folder / "b").rename(store.root / "old")
    put_item(store, "episode", "b", task="other")
    # A clock that went back: the folder is older than at the last look.
    os.utime(folder, ns=(10**9, 10**9))
    assert ids(catalog, task="other") == ["b", "spare"]


def test_reviews_of_other_processes_are_noticed_by_a_check(store):
    ours, theirs = Catalog(store), Catalog(store)
    assert ids(ours) == ids(theirs)
    store.set_review("a", REJECTED)
    ours.index.check()
    for catalog in (ours, theirs):
        assert len(catalog.items(ItemFilter(review="rejected"), limit=9).items) == 1


def test_verify_compares_rows_with_items(store, capsys):
    ids(Catalog(store))
    where = ["--store", str(store.root)]
    (path,) = databases(store)
    assert not Catalog(store).index.verify()
    with closing(sqlite3.connect(path)) as connection, connection:
        connection.execute("UPDATE item SET sha256 = 'other' WHERE id = 'b'")
    assert command_line.main(["verify", *where]) == command_line.EXIT_DAMAGED
    said = capsys.readouterr().out
    assert "catalog has a row of episode b that is not of its content; remove the folder" in said


@pytest.mark.parametrize("is_open", [True, False])
def test_a_deleted_operator_is_in_no_byte_of_it(store, tmp_path, is_open):
    store.set_review("b", REJECTED)
    put_item(store, "recording", "gone", operator="operator-of-a", instruction="as operator-of-a")
    running = Catalog(store)
    ids(running)
    # In free pages and in the journal, too.
    store.delete("gone", kind="recording")
    ids(running)
    if not is_open:
        running.index._file.close()

    def found(word):
        files = (store.root / ".catalog").iterdir()
        return sum(word.encode() in path.read_bytes() for path in files)

    for name, place in (("operator-of-a", "a"), ("reviewer-of-ada", "b")):
        assert found(name)
        request = DeletionRequest(operator=name)
        receipt = delete_for_good(store.root, request, tmp_path / f"{place}.json")
        assert receipt.complete, receipt.remaining
        assert not found(name)
    assert len(databases(store)) == 1
    assert ids(running) == ids(Catalog(store)) == ["b", "c"]
    (item,) = running.items(ItemFilter(review="rejected"), limit=9).items
    assert (item.id, item.review.reviewer) == ("b", None)


def test_what_names_a_deleted_operator_is_searched_for(store, tmp_path, monkeypatch):
    from dextouch.episodes.maintenance import deletion

    ids(Catalog(store))
    monkeypatch.setattr(deletion, "erase_from_catalog", lambda *_: None)
    request = DeletionRequest(operator="operator-of-a")
    receipt = delete_for_good(store.root, request, tmp_path / "receipt.json")
    (where,) = {one.where.partition(" ")[0] for one in receipt.remaining}
    assert where == f".catalog/{databases(store)[0].name}"


@pytest.fixture(scope="module")
def s3_server():
    with running_s3() as server:
        yield server


@pytest.fixture
def in_bucket(s3_server, tmp_path):
    """A function that opens a store in a bucket, as the programs of one computer do."""

    def opened(computer):
        options = CREDENTIALS | {"work_folder": str(tmp_path / computer)}
        return EpisodeStore(s3_server.url(f"catalog/{tmp_path.name}"), options)

    return opened


@pytest.fixture
def now_ns(monkeypatch):
    """The clock by which a bucket is looked at again; its first value can be changed."""
    now_ns = [time.monotonic_ns()]
    monkeypatch.setattr(catalog_index.time, "monotonic_ns", lambda: now_ns[0])
    return now_ns


def requests_of(store, monkeypatch):
    """What is asked of the bucket from now on."""
    bucket, asked = store._storage._bucket, []
    for method in ("get", "head", "tail", "list", "folders"):
        whole = getattr(bucket, method)
        monkeypatch.setattr(
            bucket, method, lambda key, *args, _f=whole: asked.append(key) or _f(key, *args)
        )
    return asked


def upload_item(store, kind, name, **changes):
    """Commit an item to a bucket, by the upload that ends every writer."""
    local = EpisodeStore(store.root / "local")
    put_item(local, kind, name, **changes)
    upload_group(store._storage._bucket, kind, local.root / f"{kind}s" / name)


def put_as_before(store, names, folder):
    """Put episodes into a bucket as releases did that announced no changes."""
    local = EpisodeStore(folder)
    for name in names:
        put_item(local, "episode", name)
        for file in ("zarr.json", "commit.json"):
            path = local.root / "episodes" / name / file
            store._storage._bucket.put(f"episodes/{name}/{file}", path.read_bytes())


def test_a_bucket_of_an_earlier_release_is_listed_by_ids(in_bucket, tmp_path, monkeypatch, now_ns):
    """The second look takes a request per kind and thousand ids, not one per item."""
    store = in_bucket("work")
    names = [f"e-{number:03d}" for number in range(30)]
    put_as_before(store, names, tmp_path / "local")
    assert ids(Catalog(store)) == names
    bucket, asked = store._storage._bucket, requests_of(store, monkeypatch)
    catalog = Catalog(store)
    assert ids(catalog) == names
    assert asked == [".changes", "episodes", "recordings"]
    bucket.remove([f"episodes/e-007/{file}" for file in ("commit.json", "zarr.json")])
    assert ids(catalog) == names
    asked.clear()
    now_ns[0] += catalog_index.BUCKET_PERIOD_NS
    assert ids(catalog) == [name for name in names if name != "e-007"]
    assert asked == [".changes", "episodes", "recordings"]
    # A check finds what a list of ids does not.
    review = json.dumps(REJECTED.model_dump(mode="json")).encode()
    bucket.put("episodes/e-003/review.json", review)
    catalog.index.check()
    assert [one.id for one in catalog.items(ItemFilter(review="rejected"), limit=9).items] == [
        "e-003"
    ]


def test_changes_of_a_bucket_are_found_without_listing_it(in_bucket, tmp_path, monkeypatch, now_ns):
    ours, theirs = in_bucket("ours"), in_bucket("theirs")
    for name in ("a", "b", "c"):
        upload_item(theirs, "episode", name)
    catalog, asked = Catalog(ours), requests_of(ours, monkeypatch)

    def found(**wanted):
        asked.clear()
        now_ns[0] += catalog_index.BUCKET_PERIOD_NS
        return [one.id for one in catalog.items(ItemFilter(**wanted), limit=9).items]

    assert found() == ["a", "b", "c"]
    assert found() == ["a", "b", "c"]
    assert asked == [".changes"]
    upload_item(theirs, "episode", "d")
    upload_item(theirs, "recording", "r")
    assert found() == ["a", "b", "c", "d", "r"]
    assert not {"episodes", "recordings"} & set(asked)
    assert not [key for key in asked if "/a" in key]
    theirs.set_review("b", REJECTED)
    assert found(review="rejected") == ["b"]
    theirs.set_review("b", None)
    theirs.delete("c")
    assert (found(), found(review="rejected")) == (["a", "b", "d", "r"], [])
    theirs.delete("a")
    upload_item(theirs, "episode", "a", task="other")
    assert found(task="other") == ["a"]
    # Another process of this computer reads on where this one ended.
    catalog = Catalog(ours)
    assert (found(), asked) == (["a", "b", "d", "r"], [".changes"])
    assert [catalog.index.num_items(kind) for kind in ("episode", "recording")] == [3, 1]
    # What an earlier release commits is found by the list that follows.
    catalog.index.check()
    put_as_before(theirs, ["e"], tmp_path / "local")
    assert found() == ["a", "b", "d", "r"]
    later_s = time.time() + catalog_index.BUCKET_CHECK_PERIOD_S
    monkeypatch.setattr(catalog_index.time, "time", lambda: later_s)
    # And what was announced since is compared, too: a list of ids shows neither.
    theirs.set_review("b", REJECTED)
    theirs.delete("a")
    upload_item(theirs, "episode", "a", task="again")
    assert found(review="rejected") == ["b"]
    assert "episodes" in asked
    assert (found(task="again"), found()) == (["a"], ["a", "b", "d", "e", "r"])


def test_the_last_change_of_a_bucket_stays(in_bucket):
    store = in_bucket("work")
    upload_item(store, "episode", "a")
    time.sleep(1.1)  # what the server rounds times to
    upload_item(store, "episode", "b")
    assert sorted(store.changes().values()) == [("episode", "a"), ("episode", "b")]
    sweep_orphans(store._storage._bucket, now=datetime.now(UTC) + 2 * ORPHAN_AGE)
    assert list(store.changes().values()) == [("episode", "b")]
    assert store.list() == ["a", "b"]


def test_an_item_that_cannot_be_read_is_looked_at_by_other_processes(
    in_bucket, monkeypatch, now_ns
):
    store = in_bucket("work")
    upload_item(store, "episode", "a")
    catalog = Catalog(store)
    assert ids(catalog) == ["a"]
    upload_item(store, "episode", "b")
    now_ns[0] += catalog_index.BUCKET_PERIOD_NS
    with monkeypatch.context() as broken, capture_logs() as logs:
        failure = StorageError("read: no answer")
        broken.setattr(store, "open", lambda _: (_ for _ in ()).throw(failure))
        assert ids(catalog) == ["a"]
    assert [entry["id"] for entry in logs] == ["b"]
    assert ids(Catalog(store)) == ["a", "b"]


def test_a_bucket_whose_policy_allows_items_alone(in_bucket, monkeypatch, now_ns):
    ours, theirs = in_bucket("ours"), in_bucket("theirs")
    for method in ("put", "list"):
        whole = getattr(Bucket, method)

        def refused(self, key, *args, _f=whole, **options):
            if key.startswith(".changes"):
                raise StorageError(f"write {key}: refused (403 AccessDenied)")
            return _f(self, key, *args, **options)

        monkeypatch.setattr(Bucket, method, refused)
    with capture_logs() as logs:
        upload_item(theirs, "episode", "a")
    assert [entry["event"] for entry in logs] == ["change_not_announced"]
    catalog = Catalog(ours)
    assert ids(catalog) == ["a"]
    upload_item(theirs, "episode", "b")
    now_ns[0] += catalog_index.BUCKET_PERIOD_NS
    assert ids(catalog) == ["a", "b"]
    assert ours.sweep() == 0
