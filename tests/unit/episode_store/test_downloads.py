"""Downloads: files are those of the export, sizes and numbers are limited, nothing stays behind."""

import asyncio
import io
import json
import os
import subprocess
import sys
import tempfile
import zipfile
from datetime import UTC, datetime
from pathlib import Path

import pytest
from httpx import ASGITransport, AsyncClient

pytest.importorskip("mcap", reason="mcap is not installed: pip install '.[export]'")

from dextouch.bridges.mcap import import_mcap
from dextouch.episodes import EpisodeStore
from dextouch.episodes.maintenance import DeletionRequest, delete_for_good, inspect_unfinished
from dextouch.installation import install_command
from dextouch.schemas import Review
from services.episode_store import downloads
from services.episode_store.app import create_app
from tests.unit.bridges.takes import differing_streams
from tests.unit.episode_store.episodes import write_episode, write_recording


@pytest.fixture(autouse=True)
def scratch(settings, tmp_path, monkeypatch):
    """Where downloads are made; it must be empty after each, like that of temporary files."""
    folder = tmp_path / "scratch"
    folder.mkdir()
    monkeypatch.setattr(tempfile, "tempdir", str(folder))
    folder = Path(settings.store_url) / ".downloads"
    yield folder
    assert [*folder.glob("*"), *Path(tempfile.tempdir).iterdir()] == []


@pytest.fixture
def store(settings):
    store = EpisodeStore(settings.store_url)
    write_episode(store, "one", operator="ada")
    write_episode(store, "two", operator="bob")
    write_recording(store, "one", operator="ada")
    return store


@pytest.fixture
def connect(settings):
    def make(**changes):
        app = create_app(settings.model_copy(update=changes))
        transport = ASGITransport(app, raise_app_exceptions=False)
        return AsyncClient(transport=transport, base_url="http://localhost")

    return make


def items(*names, kind="episode", **more):
    return {"items": [{"kind": kind, "id": name} for name in names]} | more


async def test_one_item_is_its_file(connect, store, tmp_path):
    answer = await connect().post("/v1/downloads", json=items("one"))
    assert answer.status_code == 200
    assert answer.headers["content-disposition"] == 'attachment; filename="one.mcap"'
    size = store.num_bytes("one", kind="episode")
    assert answer.headers["x-dextouch-estimated-bytes"] == str(size)
    (tmp_path / "one.mcap").write_bytes(answer.content)
    other = EpisodeStore(tmp_path / "other")
    import_mcap(tmp_path / "one.mcap", other)
    assert differing_streams(store.open("one"), other.open("one")) == []


async def test_several_are_a_zip_that_says_what_is_in_it(connect, store, tmp_path):
    wanted = [*items("one", "two", "two")["items"], *items("one", kind="recording")["items"]]
    answer = await connect().post("/v1/downloads", json={"items": wanted})
    assert answer.headers["content-type"] == "application/zip"
    archive = zipfile.ZipFile(io.BytesIO(answer.content))
    assert archive.testzip() is None
    files = ["episodes/one.mcap", "episodes/two.mcap", "recordings/one.mcap"]
    assert archive.namelist() == [*files, "foxglove_layout.json", "contents.json"]
    listed = json.loads(archive.read("contents.json"))
    assert [one["file"] for one in listed] == files
    other = EpisodeStore(tmp_path / "other")
    for name in files:
        import_mcap(Path(archive.extract(name, tmp_path)), other)
    assert (other.list(), other.list(kind="recording")) == (["one", "two"], ["one"])


async def test_what_was_rejected_is_left_out_if_that_is_asked_for(connect, store):
    rejected = Review(verdict="rejected", reviewed_at=datetime(2026, 5, 4, tzinfo=UTC))
    store.set_review("two", rejected)
    client = connect()
    answer = await client.post("/v1/downloads", json=items("one", "two", with_rejected=False))
    assert answer.headers["content-disposition"] == 'attachment; filename="one.mcap"'
    answer = await client.post("/v1/downloads", json=items("two", with_rejected=False))
    assert answer.status_code == 404
    assert "rejected" in answer.json()["detail"]
    assert (await client.post("/v1/downloads", json=items("two"))).status_code == 200


@pytest.mark.parametrize(
    ("changes", "wanted", "status", "words"),
    [
        ({}, items("three"), 404, "three"),
        ({}, items(), 422, "items"),
        ({}, items("../one"), 422, "id"),
        ({"max_download_items": 1}, items("one", "two"), 413, "2 items, expected at most 1"),
        ({"max_download_bytes": 1024}, items("one"), 413, "expected at most 0 MB"),
    ],
)
async def test_refusals_have_a_reason(connect, store, changes, wanted, status, words):
    answer = await connect(**changes).post("/v1/downloads", json=wanted)
    assert answer.status_code == status
    assert words in answer.json()["detail"]
    if status == 413:
        assert "dextouch export --format mcap" in answer.json()["detail"]


@pytest.mark.parametrize("absent", ["mcap", "lz4", "foxglove_schemas_protobuf"])
async def test_a_store_without_the_packages_says_which(connect, store, monkeypatch, absent):
    monkeypatch.setattr(downloads, "find_spec", lambda name: None if name == absent else name)
    answer = await connect().post("/v1/downloads", json=items("one"))
    assert answer.status_code == 503
    assert answer.json()["detail"].endswith(f"such as {absent}: {install_command('export')}")


async def ask(app, body, sent, *, leave_after):
    """Post a download, note the messages of the response, and leave after some of them."""
    content = json.dumps(body).encode()
    left = asyncio.Event()
    requests = [{"type": "http.request", "body": content, "more_body": False}]

    async def receive():
        if requests:
            return requests.pop()
        await left.wait()
        return {"type": "http.disconnect"}

    async def send(message):
        sent.append(message)
        if len(sent) >= leave_after:
            left.set()
            await asyncio.sleep(0)

    headers = [(b"host", b"localhost"), (b"content-type", b"application/json")]
    headers.append((b"content-length", str(len(content)).encode()))
    scope = {"type": "http", "method": "POST", "path": "/v1/downloads", "headers": headers}
    scope |= {"raw_path": b"/v1/downloads", "query_string": b"", "root_path": "", "scheme": "http"}
    scope |= {"http_version": "1.1", "client": ("127.0.0.1", 1), "server": ("localhost", 80)}
    await app(scope | {"asgi": {"version": "3.0"}, "state": {}}, receive, send)


async def test_a_client_that_leaves_frees_its_place(settings, store, connect):
    """Each leaves in the middle; with places for one, a second one gets in only if it is free."""
    app = create_app(settings.model_copy(update={"max_downloads": 1}))
    for _ in range(3):
        sent = []
        await ask(app, items("one", "two"), sent, leave_after=2)
        assert sent[0]["status"] == 200
        assert sent[-1].get("more_body")


async def test_more_at_once_than_there_are_places_are_asked_to_wait(connect, store, monkeypatch):
    client = connect(max_downloads=1)
    held, go = asyncio.Event(), asyncio.Event()
    loop, original = asyncio.get_running_loop(), downloads._single

    def slow(readers, folder):
        loop.call_soon_threadsafe(held.set)
        asyncio.run_coroutine_threadsafe(go.wait(), loop).result()
        yield from original(readers, folder)

    monkeypatch.setattr(downloads, "_single", slow)
    first = asyncio.create_task(client.post("/v1/downloads", json=items("one")))
    await held.wait()
    second = await client.post("/v1/downloads", json=items("one"))
    go.set()
    assert (second.status_code, second.headers["retry-after"]) == (429, "5")
    assert "busy" in second.json()["detail"]
    assert (await first).status_code == 200
    assert (await client.post("/v1/downloads", json=items("one"))).status_code == 200


async def test_a_failure_on_the_way_cuts_the_connection(settings, store, capsys):
    """A part of a zip must never end as if it were the whole."""
    shard = next((store.root / "episodes" / "two" / "tactile_left").rglob("c/*/0"))
    shard.write_bytes(shard.read_bytes()[:-30])
    app = create_app(settings.model_copy(update={"max_downloads": 1}))
    for _ in range(2):
        sent = []
        with pytest.raises(RuntimeError, match="response already started"):
            await ask(app, items("one", "two"), sent, leave_after=100)
        assert sent[0]["status"] == 200
        assert all(message.get("more_body", True) for message in sent)
    assert "download_failed" in (told := capsys.readouterr().out)
    assert "tactile_left" in told


KILLED = """
import asyncio, os, sys
from dextouch.episodes import EpisodeStore
from services.episode_store.downloads import DownloadItems, Downloads
from services.episode_store.settings import EpisodeStoreSettings
store = EpisodeStore(sys.argv[1])
wanted = DownloadItems.model_validate({"items": [{"kind": "episode", "id": "one"}]})
response = Downloads(store, EpisodeStoreSettings(store_url=sys.argv[1])).begin(wanted)
async def first():
    await anext(response.body_iterator)
    os.kill(os.getpid(), 9)
asyncio.run(first())
"""


@pytest.mark.parametrize("how", ["start", "deletion"])
def test_a_killed_download_is_swept(store, scratch, tmp_path, how):
    environment = os.environ | {"PYTHONPATH": os.pathsep.join(path for path in sys.path if path)}
    subprocess.run([sys.executable, "-c", KILLED, str(store.root)], env=environment, check=False)
    (left,) = scratch.iterdir()
    assert {path.name for path in left.iterdir()} == {"item.mcap", "items.json"}
    assert ("download", left.name) in [(r.kind, r.item_id) for r in inspect_unfinished(store.root)]
    if how == "start":
        assert store.sweep() == 1
    else:
        # A running one names its items, so that the receipt says what is left.
        held = downloads._Folder(store.root, [store.open("two")])
        receipts = [
            delete_for_good(store.root, DeletionRequest(operator=name), tmp_path / f"{name}.json")
            for name in ("ada", "bob")
        ]
        held.remove()
        assert [receipt.complete for receipt in receipts] == [True, False]
        assert receipts[1].remaining[0].where == f".downloads/{held.path.name}/items.json"


async def test_a_disk_that_refuses_costs_no_place(connect, store, monkeypatch):
    client = connect(max_downloads=1)
    with monkeypatch.context() as broken:
        broken.setattr(downloads, "make_held_folder", lambda path: os.open(path, os.O_RDONLY))
        for _ in range(2):
            answer = await client.post("/v1/downloads", json=items("one"))
            assert "begin a download" in answer.json()["detail"]
    assert (await client.post("/v1/downloads", json=items("one"))).status_code == 200
