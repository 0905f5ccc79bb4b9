"""Routes of other services that browsers reach through the dashboard."""

import httpx
import pytest

from services.dashboard.pages import _own_path

KEY = "a-key-of-some-length"


async def test_a_route_on_the_list_is_forwarded_with_its_query(client, services):
    answer = await client.get("/v1/episode_store/episodes?limit=3&offset=0")
    assert answer.status_code == 200
    assert answer.json()["episodes"][0]["episode_id"] == "take-0001"
    assert services.asked[-1] == "/v1/episodes"


@pytest.mark.parametrize(
    ("method", "path"),
    [
        ("POST", "/v1/episode_store/recordings"),
        ("DELETE", "/v1/episode_store/episodes/take-0001"),
        ("GET", "/v1/episode_store/metrics"),
        ("GET", "/v1/episode_store/episodes/../../metrics"),
        ("GET", "/v1/twin/worlds"),
    ],
)
async def test_other_routes_are_not(client, services, method, path):
    answer = await client.request(method, path)
    assert answer.status_code in {404, 405}
    assert not services.asked


@pytest.mark.parametrize(
    "path",
    [
        "episode_store/catalog/items",
        "episode_store/catalog/groups",
        "episode_store/catalog/hours/day",
        "episode_store/uploads",
        "acquisition/uploads",
    ],
)
async def test_what_the_lists_read_is_forwarded(client, services, path):
    # The fakes lack these routes: what counts is where the request goes.
    await client.get(f"/v1/{path}?limit=1")
    assert services.asked == [f"/v1/{path.partition('/')[2]}"]


async def test_reviews_are_forwarded(client, services):
    body = {"items": [{"kind": "episode", "id": "a"}], "verdict": "accepted"}
    answer = await client.post("/v1/episode_store/catalog/reviews", json=body)
    assert services.asked == ["/v1/catalog/reviews"]
    assert answer.status_code == 503
    too_large = {"items": [{"kind": "episode", "id": "a" * 300_000}]}
    answer = await client.post("/v1/episode_store/catalog/reviews", json=too_large)
    assert answer.status_code == 413


async def test_downloads_are_forwarded_and_their_refusals_passed_on(client, services):
    body = {"items": [{"kind": "episode", "id": "a"}]}
    answer = await client.post("/v1/episode_store/downloads", json=body)
    assert services.asked == ["/v1/downloads"]
    assert answer.status_code == 503
    assert "POST /v1/downloads answered 404" in answer.json()["detail"]
    too_large = {"items": [{"kind": "episode", "id": "a" * 2**20}]}
    answer = await client.post("/v1/episode_store/downloads", json=too_large)
    assert answer.status_code == 413


async def test_clicks_are_forwarded(client, services):
    body = {"objects": {"cup": {"state": "hidden"}}}
    await client.post("/v1/episode_store/episodes/take-1/clicks", json=body)
    assert services.asked == ["/v1/episodes/take-1/clicks"]
    answer = await client.post(
        "/v1/episode_store/episodes/take-1/clicks", json={"objects": {"cup": "x" * 20_000}}
    )
    assert answer.status_code == 413


async def test_names_in_paths_stay_one_part(client, services):
    await client.get("/v1/episode_store/episodes/a%3Fb%23c")
    assert services.asked[-1] == "/v1/episodes/a%3Fb%23c"


@pytest.mark.parametrize(
    "path",
    [
        # Would issue a key of a station, which needs another scope than a note.
        "episode_store/notes/%2e%2e/enrolments",
        "episode_store/notes/episode/%2e",
        "uploads/%2e%2e/retry",
    ],
)
async def test_names_in_paths_lead_nowhere_else(client, services, path):
    answer = await client.post(f"/v1/{path}", json={})
    assert answer.status_code == 404
    assert "expected the name of an item" in answer.json()["detail"]
    assert services.asked == []


@pytest.mark.parametrize(
    ("path", "headers"),
    [
        ("episodes", {"if-none-match": b"\xe9"}),
        # Each bad byte becomes nine letters.
        ("catalog/items?text=" + "%ff" * 10_000, {}),
    ],
)
async def test_what_cannot_be_passed_on_is_refused(client, services, path, headers):
    answer = await client.get(f"/v1/episode_store/{path}", headers=headers)
    assert answer.status_code == 422
    assert "episode_store: GET /v1/" in answer.json()["detail"]
    assert len(answer.json()["detail"]) < 300
    assert services.asked == []


async def test_refusals_are_passed_on(client):
    answer = await client.get("/v1/episode_store/playback/episode/take-0001")
    assert answer.status_code == 503
    assert "episode_store" in answer.json()["detail"]
    missing = await client.get("/v1/alignment/alignments")
    assert missing.status_code == 404
    assert "DEXTOUCH_DASHBOARD_ALIGNMENT_URL" in missing.json()["detail"]


async def test_forwarding_needs_a_session(make_app, services):
    key = {"name": "operator", "key": KEY, "scopes": ("operate",)}
    transport = httpx.ASGITransport(app=make_app(api_keys=(key,)))
    async with httpx.AsyncClient(transport=transport, base_url="http://127.0.0.1") as client:
        assert (await client.get("/v1/episode_store/episodes")).status_code == 401
        assert not services.asked
        answer = await client.post("/sign_in", data={"key": KEY, "wanted": "/?at=3"})
        assert answer.headers["location"] == "/?at=3"
        assert (await client.get("/v1/episode_store/episodes?limit=1")).status_code == 200


@pytest.mark.parametrize(
    "text", ["http://evil.example", "//evil.example", "/\\evil.example", "", "/a\r\nb: c", "/é"]
)
def test_sign_in_goes_to_paths_of_this_site_only(text):
    assert _own_path(text) == "/"
    assert _own_path("/episodes/x?at=1") == "/episodes/x?at=1"
