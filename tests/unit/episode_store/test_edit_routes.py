"""Edits and notes over HTTP: what they answer, and that the catalog knows of them at once."""

import pytest
from httpx import ASGITransport, AsyncClient

from dextouch.episodes import EpisodeStore
from services.episode_store import catalog_index
from services.episode_store.app import create_app
from tests.unit.episode_store.episodes import write_episode, write_recording


@pytest.fixture
def store(settings):
    return EpisodeStore(settings.store_url)


@pytest.fixture
async def http(settings):
    transport = ASGITransport(create_app(settings))
    async with AsyncClient(transport=transport, base_url="http://localhost/v1") as client:
        yield client


async def reviews(http):
    items = (await http.get("/catalog/items?kind=episode")).json()["items"]
    return {item["id"]: (item["review"] or {}).get("reason") for item in items}


async def test_a_trim_supersedes_its_source_in_the_catalog(http, store):
    write_episode(store, "a", num_steps=20)
    assert await reviews(http) == {"a": None}
    body = {"first_step": 2, "stop_step": 20, "keep": True, "dry_run": True}
    said = (await http.post("/episodes/a/trim", json=body)).json()
    assert (said["id"], said["sha256"]) == ("a-trimmed-1", None)
    assert store.list() == ["a"]
    done = (await http.post("/episodes/a/trim", json=body | {"dry_run": False})).json()
    assert done["sha256"] == store.open("a-trimmed-1").content_sha256
    assert await reviews(http) == {"a": "superseded by a-trimmed-1", "a-trimmed-1": None}
    lineage = (await http.get("/catalog/lineage/episode/a-trimmed-1")).json()["nodes"]
    assert [(node["id"], node["relation"]) for node in lineage if node["id"] == "a"] == [
        ("a", "source")
    ]
    # Undone: the mark is void, also in the catalog.
    moved = await http.post("/trash", json={"items": [{"kind": "episode", "id": "a-trimmed-1"}]})
    assert moved.status_code == 200
    assert await reviews(http) == {"a": None}


async def test_all_that_an_item_was_edited_from_is_read_again(http, store, monkeypatch):
    monkeypatch.setattr(catalog_index, "ALWAYS_CHECKED", 0)
    write_episode(store, "a", num_steps=20)
    for name in ("a", "a-relabelled-1"):
        item = {"kind": "episode", "id": name}
        body = {"items": [item], "instruction": f"not {name}", "keep": name == "a"}
        assert (await http.post("/catalog/relabel", json=body)).json()["refused"] == []
        await reviews(http)
    last = "a-relabelled-1-relabelled-1"
    said = f"superseded by a-relabelled-1, {last}"
    assert await reviews(http) == {"a": said, last: None}


@pytest.mark.parametrize(
    ("path", "body", "status", "message"),
    [
        ("episodes/nobody/trim", {"first_step": 0, "stop_step": 5}, 404, "'nobody'"),
        ("episodes/a/trim", {"first_step": 5, "stop_step": 99}, 422, "within its 9 steps"),
        ("episodes/a/trim", {"first_step": 0, "stop_step": 5}, 422, "--outcome"),
        ("episodes/a/trim", {"first_step": -1, "stop_step": 5}, 422, "first_step"),
        ("notes/episode/a", {"start_ns": 0, "stop_ns": 0, "text": "  "}, 422, "text"),
        ("notes/episode/a", {"start_ns": 0, "stop_ns": 0, "text": "a\u202eb"}, 422, "U+202E"),
        ("notes/episode/a", {"start_ns": 9**20, "stop_ns": 9**20, "text": "x"}, 422, "start_ns"),
        ("notes/episode/a/remove", {"number": 7}, 404, "its notes are none"),
        ("notes/episode/nobody", {"start_ns": 0, "stop_ns": 0, "text": "x"}, 404, "'nobody'"),
    ],
)
async def test_refusals_say_why(http, store, path, body, status, message):
    write_episode(store, "a")
    answer = await http.post(f"/{path}", json=body)
    assert answer.status_code == status
    assert message in answer.json()["detail"]
    assert store.list() == ["a"]


async def test_relabels_are_each_on_their_own(http, store):
    write_episode(store, "a")
    write_recording(store, "take")
    items = [
        {"kind": kind, "id": name}
        for kind, name in [("episode", "a"), ("episode", "b"), ("recording", "take")]
    ]
    body = {"items": items, "instruction": "up", "outcome": "unknown"}
    answer = (await http.post("/catalog/relabel", json=body)).json()
    assert [one["id"] for one in answer["edited"]] == ["a-relabelled-1", "take-relabelled-1"]
    assert [one["id"] for one in answer["refused"]] == ["b"]
    assert store.open("a-relabelled-1").attributes.success is None


async def test_notes_come_in_the_order_of_their_starts(http, store):
    write_episode(store, "a")
    for start_ns in ("400000000", 0):
        body = {"start_ns": start_ns, "stop_ns": 4 * 10**8, "text": "line 1\nline 2"}
        answer = await http.post("/notes/episode/a", json=body | {"author": "p-7"})
    assert [(one["number"], one["start_ns"]) for one in answer.json()["notes"]] == [
        (2, 0),
        (1, 4 * 10**8),
    ]
    left = (await http.post("/notes/episode/a/remove", json={"number": 2})).json()["notes"]
    assert left == (await http.get("/notes/episode/a")).json()["notes"]
    assert [one["number"] for one in left] == [1]
