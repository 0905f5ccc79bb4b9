"""Items of both kinds in one list, their reviews and findings, and hours by field."""

from datetime import UTC, datetime

import pytest
from httpx import ASGITransport, AsyncClient

from dextouch.episodes import EpisodeStore
from dextouch.schemas import Review
from dextouch.serving.keys import ApiKey
from services.episode_store.app import create_app
from tests.unit.episode_store.episodes import write_episode, write_recording, write_take

NOON = datetime(2026, 5, 4, 12, tzinfo=UTC)


@pytest.fixture
def store(settings):
    return EpisodeStore(settings.store_url)


@pytest.fixture
async def http(settings):
    transport = ASGITransport(create_app(settings))
    async with AsyncClient(transport=transport, base_url="http://localhost") as client:
        yield client


async def listed(http, **query):
    answer = await http.get("/v1/catalog/items", params=query)
    assert answer.status_code == 200, answer.text
    return answer.json()


async def names(http, **query):
    return [f"{row['kind']}/{row['id']}" for row in (await listed(http, **query))["items"]]


async def review(http, *items, **body):
    body = {"verdict": "rejected"} | body
    body["items"] = [dict(zip(("kind", "id"), item.split("/"), strict=True)) for item in items]
    answer = await http.post("/v1/catalog/reviews", json=body)
    assert answer.status_code == 200, answer.text
    return answer.json()


@pytest.fixture
def items(store):
    write_take(store, "take-1", operator="ada", consent=True, success=True, started_at=NOON)
    write_recording(store, "take-2", operator="bo", success=None)
    write_episode(store, "twin-1")
    lineage = [{"kind": "episode", "id": "twin-1"}, {"kind": "recording", "id": "take-1"}]
    write_episode(store, "dream-1", origin="imagined", success=None, lineage=lineage)


TAKES = ["episode/dream-1", "recording/take-1", "recording/take-2", "episode/twin-1"]


@pytest.mark.long
@pytest.mark.parametrize(
    ("query", "expected"),
    [
        ({}, TAKES),
        ({"descending": True}, TAKES[::-1]),
        ({"kind": "recording"}, ["recording/take-1", "recording/take-2"]),
        ({"kind": "episode"}, ["episode/dream-1", "episode/take-1-aligned", "episode/twin-1"]),
        ({"origin": "recorded"}, ["recording/take-1", "recording/take-2"]),
        ({"origin": "twin"}, ["episode/twin-1"]),
        ({"operator": "bo"}, ["recording/take-2"]),
        # A take is found by the id of its episode, too.
        ({"text": "1-ALIGNED"}, ["recording/take-1"]),
        ({"flagged": True}, ["recording/take-2"]),
        ({"flagged": False}, [one for one in TAKES if one != "recording/take-2"]),
        ({"id": ["take-2", "twin-1", "no"]}, ["recording/take-2", "episode/twin-1"]),
        ({"created_after": "2026-05-04T12:00:00Z"}, ["recording/take-1"]),
    ],
)
async def test_items_are_filtered(http, items, query, expected):
    assert await names(http, **query) == expected


async def test_a_take_shows_its_recording_and_its_episode(http, items):
    (take,) = (await listed(http, text="take-1", operator="ada"))["items"]
    assert (take["operator"], take["consent"], take["episodes"]) == (
        "ada",
        True,
        ["take-1-aligned"],
    )
    aligned = take["aligned"]
    assert (aligned["kind"], aligned["id"]) == ("episode", "take-1-aligned")
    assert (aligned["recordings"], aligned["consent"]) == (["take-1"], True)
    assert take["duration_s"] == pytest.approx(18 / 30)
    assert aligned["duration_s"] == pytest.approx(9 / 15)
    rows = (await listed(http, kind="episode"))["items"]
    assert {row["id"]: row["consent"] for row in rows}["twin-1"] is None


async def test_pages_of_takes_join(http, items):
    first = await listed(http, limit=3, sort="task")
    assert first["num_matching"] == 4
    second = await listed(http, limit=3, sort="task", after=first["next_after"])
    got = [f"{row['kind']}/{row['id']}" for page in (first, second) for row in page["items"]]
    assert got == TAKES


async def test_reviews_are_kept_and_taken_back(http, store, items):
    told = await review(
        http, "episode/take-1-aligned", "episode/no", reason="slipped", reviewer="ada"
    )
    assert told["reviewed"] == [{"kind": "episode", "id": "take-1-aligned"}]
    assert [one["id"] for one in told["refused"]] == ["no"]
    kept = store.review("take-1-aligned")
    assert (kept.verdict, kept.reason, kept.reviewer) == ("rejected", "slipped", "ada")
    assert abs((datetime.now(UTC) - kept.reviewed_at).total_seconds()) < 60
    assert await names(http, review="rejected") == ["recording/take-1"]
    (take,) = (await listed(http, review="rejected"))["items"]
    assert take["review"]["reason"] == "slipped"
    await review(http, "episode/take-1-aligned", verdict="accepted")
    assert await names(http, review="accepted") == ["recording/take-1"]
    await review(http, "episode/take-1-aligned", verdict=None)
    assert store.review("take-1-aligned") is None
    assert await names(http, review="not_reviewed") == TAKES


async def test_a_rejected_recording_rejects_what_was_made_from_it(http, items):
    await review(http, "recording/take-1")
    rejected = ["episode/dream-1", "episode/take-1-aligned"]
    assert await names(http, kind="episode", review="rejected") == rejected


@pytest.mark.parametrize(
    "body",
    [
        {"verdict": "liked"},
        {"items": []},
        {"reason": "a" * 501},
        {"items": [{"kind": "episode", "id": "../a"}]},
        {"verdict": "accepted", "more": 1},
    ],
)
async def test_bad_reviews_are_refused(http, items, body):
    whole = {"items": [{"kind": "episode", "id": "twin-1"}], "verdict": "accepted"}
    answer = await http.post("/v1/catalog/reviews", json=whole | body)
    assert answer.status_code == 422


async def test_reviewing_needs_its_own_scope(settings, store):
    write_episode(store, "a")
    key = ApiKey(name="station", key="a-key-of-some-length", scopes=("store_read", "store_write"))
    app = create_app(settings.model_copy(update={"api_keys": (key,)}))
    headers = {"authorization": "Bearer a-key-of-some-length"}
    async with AsyncClient(
        transport=ASGITransport(app), base_url="http://localhost", headers=headers
    ) as client:
        body = {"items": [{"kind": "episode", "id": "a"}], "verdict": "rejected"}
        assert (await client.post("/v1/catalog/reviews", json=body)).status_code == 403
        assert (await client.get("/v1/catalog/items")).status_code == 200
        assert (await client.get("/v1/catalog/groups")).status_code == 200
    assert store.review("a") is None


@pytest.mark.long
async def test_outliers_of_a_task_are_flagged_until_they_are_rejected(http, store):
    for number in range(9):
        write_take(store, f"take-{number}", num_steps=60 + number % 3, success=True)
    write_take(store, "long", num_steps=300, success=True)
    write_take(store, "alone", task="juggle", num_steps=300, success=True)
    unreliable = [{"stream": "head", "num_samples": 9, "warnings": ["skew"]}]
    write_take(store, "clock", num_steps=61, success=True, clocks=unreliable)
    assert await names(http, flagged=True) == ["recording/clock", "recording/long"]
    # 300 steps are 20 s, the others 4 s: far more than any doubt about a clock.
    order = {"sort": "findings", "descending": True, "flagged": True}
    assert await names(http, **order) == ["recording/long", "recording/clock"]
    (long,) = (await listed(http, id="long"))["items"]
    (finding,) = long["findings"]
    assert (finding["code"], finding["figure"]) == ("outlier", "duration_s")
    assert (finding["value"], finding["median"]) == (20.0, pytest.approx(61 / 15))
    groups = (await http.get("/v1/catalog/groups")).json()["groups"]
    facts = [(one["task"], one["num_items"], one["is_compared"]) for one in groups]
    assert facts == [("juggle", 1, False), ("stand_bottle", 11, True)]
    await review(http, "episode/long-aligned")
    assert await names(http, flagged=True) == ["recording/clock"]


async def test_hours_by_field_and_review(http, store):
    late = "2026-05-03T22:30:00+00:00"
    write_episode(store, "a", num_steps=45, operator="ada", created_at=late)
    write_episode(store, "b", num_steps=30, operator="bo", created_at=NOON, task="fold")
    write_episode(store, "c", num_steps=15, created_at=NOON)
    for name, verdict in (("b", "rejected"), ("c", "accepted")):
        store.set_review(name, Review(verdict=verdict, reviewed_at=NOON))

    async def rows(field, **query):
        answer = await http.get(f"/v1/catalog/hours/{field}", params=query)
        assert answer.status_code == 200, answer.text
        fields = ("accepted_h", "rejected_h", "not_reviewed_h")
        found = answer.json()["rows"]
        hours = [[round(3600 * row[name], 6) for name in fields] for row in found]
        return [
            (row["value"], row["num_episodes"], *own) for row, own in zip(found, hours, strict=True)
        ]

    fold, stand = ("fold", 1, 0, 2, 0), ("stand_bottle", 2, 1, 0, 3)
    assert await rows("task") == [fold, stand]
    assert await rows("task", task="fold") == [fold]
    assert await rows("operator") == [("ada", 1, 0, 0, 3), ("bo", 1, 0, 2, 0), (None, 1, 1, 0, 0)]
    assert await rows("station") == [(None, 3, 1, 2, 3)]
    days = [("2026-05-03", 1, 0, 0, 3), ("2026-05-04", 2, 1, 2, 0)]
    assert await rows("day") == days
    # In Helsinki it is half past one of the next day.
    assert await rows("day", utc_offset_min=180) == [("2026-05-04", 3, 1, 2, 3)]
    for path in ("consent", "task?utc_offset_min=900", "task?colour=red"):
        assert (await http.get(f"/v1/catalog/hours/{path}")).status_code == 422
