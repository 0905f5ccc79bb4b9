"""The shortcut to the route of chunks answers as the route itself does, refusals included."""

import json

import numpy as np
import pytest
from httpx import ASGITransport, AsyncClient
from pydantic import SecretStr

from dextouch.serving.keys import ApiKey
from dextouch.worlds import WorldServiceSettings, create_world_app
from dextouch.worlds.routes import ChunkShortcut
from tests.unit.worlds.fakes import SumWorld, actions

START = {"world": "sum", "task": "stand_bottle", "seed": 3, "instruction": "stand it"}
FLOAT64 = {"content-type": "application/octet-stream; dtype=float64"}
FLOAT32 = {"content-type": "application/octet-stream; dtype=float32"}
JSON_PLEASE = {"accept": "application/json"}
QUERIES = ("", "steps=last", "cameras=&tactile=false")


class Counted(ChunkShortcut):
    """Counts the requests that it answers, and can be switched off."""

    is_on = True
    num_taken = 0

    def __call__(self, scope):
        found = super().__call__(scope) if self.is_on else None
        self.num_taken += found is not None
        return found


@pytest.fixture
async def served(monkeypatch):
    """An application whose shortcut has seen all queries, and its client."""
    monkeypatch.setattr("dextouch.worlds.app.ChunkShortcut", Counted)
    app = create_world_app({"sum": SumWorld()}, WorldServiceSettings(max_body_bytes=2**20))
    transport = ASGITransport(app, raise_app_exceptions=False)
    async with (
        app.router.lifespan_context(app),
        AsyncClient(transport=transport, base_url="http://localhost") as client,
    ):
        path = f"/v1/rollouts/{await begin(client)}/chunks"
        for chunk, query in enumerate(QUERIES):
            await client.post(f"{path}/{chunk}?{query}", content=body(4), headers=FLOAT64)
        assert app.state.shortcut.num_taken == 0
        yield app.state.shortcut, client


async def begin(client) -> str:
    response = await client.post("/v1/rollouts?cameras=", json=START)
    assert response.status_code == 201, response.text
    return id_of(response)


def id_of(response) -> str:
    start = response.content.index(b"\xa2id\xd9 ") + 5
    return response.content[start : start + 32].decode()


def body(num_steps, value=0.0, dtype="<f8") -> bytes:
    return actions(num_steps, value).astype(dtype).tobytes()


def shown(response):
    """What must be equal both ways: all but the ids of request and trace, and times."""
    headers = dict(response.headers)
    headers.pop("x-request-id")
    timings = [part.split(";")[0] for part in headers.pop("server-timing").split(", ")]
    content = response.content
    if headers["content-type"] == "application/problem+json":
        content = {**response.json(), "request_id": None, "trace_id": None}
        headers.pop("content-length")
    return response.status_code, headers, timings, content


async def both_ways(shortcut, send):
    """The response by the shortcut, and by the route."""
    before = shortcut.num_taken
    fast = await send()
    assert shortcut.num_taken == before + 1
    shortcut.is_on = False
    slow = await send()
    shortcut.is_on = True
    return fast, slow


async def test_chunks_are_the_same_byte_for_byte(served):
    shortcut, client = served
    ids = await begin(client), await begin(client)
    for chunk, (query, headers, dtype) in enumerate(
        [(query, FLOAT64, "<f8") for query in QUERIES] + [("steps=last", FLOAT32, "<f4")]
    ):
        turn = iter(ids)

        async def send(chunk=chunk, query=query, headers=headers, dtype=dtype, turn=turn):
            path = f"/v1/rollouts/{next(turn)}/chunks/{chunk}?{query}"
            return await client.post(path, content=body(4, 0.5, dtype), headers=headers)

        fast, slow = await both_ways(shortcut, send)
        assert fast.status_code == 200
        assert fast.content.replace(ids[0].encode(), ids[1].encode()) == slow.content
        assert shown(fast)[:3] == shown(slow)[:3]


async def test_a_repeated_chunk_is_replayed(served):
    shortcut, client = served
    path = f"/v1/rollouts/{await begin(client)}/chunks/0?steps=last"
    first = await client.post(path, content=body(4), headers=FLOAT64)

    async def send():
        return await client.post(path, content=body(4), headers=FLOAT64)

    for again in await both_ways(shortcut, send):
        assert again.headers["dextouch-replayed"] == "true"
        assert again.content == first.content


@pytest.mark.parametrize(
    ("chunk", "sent", "status"),
    [
        (0, body(6), 422),
        (0, body(20), 413),
        (0, body(4)[:-1], 422),
        (0, b"", 422),
        (0, np.full((4, 67), np.nan).tobytes(), 422),
        (0, body(4, 1e6), 422),
        (0, body(4, 2e6), 500),
        (0, b"x" * (2**20 + 1), 413),
        (7, body(4), 409),
    ],
)
async def test_refusals_are_the_same(served, chunk, sent, status):
    shortcut, client = served
    rollout_id = await begin(client)
    path = f"/v1/rollouts/{rollout_id}/chunks/{chunk}?steps=last"

    async def send():
        return await client.post(path, content=sent, headers=FLOAT64 | {"x-request-id": "mine"})

    if len(sent) > 2**20:
        # Refused by the guard, which comes first.
        refused = await send()
        assert (refused.status_code, refused.json()["request_id"]) == (413, "mine")
        return
    fast, slow = await both_ways(shortcut, send)
    assert fast.status_code == status
    assert fast.json()["request_id"] == "mine"
    if status != 500:
        assert shown(fast) == shown(slow)
    good = await client.post(
        f"/v1/rollouts/{rollout_id}/chunks/0", content=body(4), headers=FLOAT64
    )
    assert good.status_code == 200


async def test_unknown_rollouts_are_the_same(served):
    shortcut, client = served

    async def send():
        path = "/v1/rollouts/%00%ff*/chunks/0?steps=last"
        return await client.post(path, content=body(4), headers=FLOAT64)

    fast, slow = await both_ways(shortcut, send)
    assert fast.status_code == 404
    assert shown(fast) == shown(slow)


@pytest.mark.parametrize(
    ("method", "path", "sent", "headers", "status"),
    [
        ("POST", "chunks/0?steps=all", body(4), FLOAT64, 200),
        ("POST", "chunks/0?steps=some", body(4), FLOAT64, 422),
        ("POST", "chunks/+0?steps=last", body(4), FLOAT64, 200),
        ("POST", "chunks/first?steps=last", body(4), FLOAT64, 422),
        ("POST", "chunks/0?steps=last", body(4), FLOAT64 | JSON_PLEASE, 200),
        ("POST", "chunks/0?steps=last", json.dumps({"actions": [[0]]}), JSON_PLEASE, 415),
        ("PUT", "chunks/0?steps=last", body(4), FLOAT64, 405),
        ("POST", "fork?steps=last", "{}", {"content-type": "application/json"}, 201),
    ],
)
async def test_all_else_is_left_to_the_routes(served, method, path, sent, headers, status):
    shortcut, client = served
    url = f"/v1/rollouts/{await begin(client)}/{path}"
    before = shortcut.num_taken
    response = await client.request(method, url, content=sent, headers=headers)
    assert (response.status_code, shortcut.num_taken) == (status, before)


async def test_requests_are_counted_under_the_route(served):
    shortcut, client = served
    path = f"/v1/rollouts/{await begin(client)}/chunks/0?steps=last"
    await client.post(path, content=body(4), headers=FLOAT64)
    assert shortcut.num_taken == 1
    label = 'method="POST",route="/v1/rollouts/{rollout_id}/chunks/{chunk}",status="200"'
    # Three chunks taught it its queries.
    assert f"dextouch_http_requests_total{{{label}}} 4.0" in (await client.get("/metrics")).text


async def test_keys_and_senders_are_checked_as_ever():
    keys = [
        ApiKey(name=scope, key=SecretStr(f"key-of-some-{scope}"), scopes=(scope,))
        for scope in ("rollout", "rate")
    ]
    app = create_world_app({"sum": SumWorld()}, WorldServiceSettings(api_keys=tuple(keys)))
    transport = ASGITransport(app)
    mine, other = ({"authorization": f"Bearer key-of-some-{name}"} for name in ("rollout", "rate"))
    async with AsyncClient(transport=transport, base_url="http://localhost") as client:
        client.headers.update(mine)
        path = f"/v1/rollouts/{await begin(client)}/chunks"
        taught = await client.post(f"{path}/0?steps=last", content=body(4), headers=FLOAT64)
        assert taught.status_code == 200
        next_chunk = {"url": f"{path}/1?steps=last", "content": body(4)}
        refused = await client.post(**next_chunk, headers=FLOAT64 | other)
        assert (refused.status_code, "rollout" in refused.json()["detail"]) == (403, True)
        del client.headers["authorization"]
        assert (await client.post(**next_chunk, headers=FLOAT64)).status_code == 401
        good = await client.post(**next_chunk, headers=FLOAT64 | mine)
        assert good.status_code == 200


async def test_pages_of_other_sites_are_refused(served):
    shortcut, client = served
    path = f"/v1/rollouts/{await begin(client)}/chunks/0?steps=last"
    before = shortcut.num_taken
    for foreign in ({"origin": "https://evil.example"}, {"host": "evil.example"}):
        response = await client.post(path, content=body(4), headers=FLOAT64 | foreign)
        assert response.status_code in {403, 421}
    assert shortcut.num_taken == before
