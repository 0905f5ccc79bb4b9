"""Routes of the dashboard: the page, its data, its buttons, and who is refused."""

import asyncio
import html
import json
import re

import httpx
import numpy as np
import pytest
from pydantic import ValidationError

from dextouch.tactile import DEXTOUCH_V1
from services.dashboard.settings import DashboardSettings

KEY = "a-key-of-some-length"


@pytest.mark.parametrize(
    ("screen", "module"),
    [
        ("/", "/static/station.js"),
        ("/episodes", "/static/catalog/episodes.js"),
        ("/objects", "/static/marking/objects.js"),
        ("/review", "/static/catalog/review.js"),
        ("/hours", "/static/catalog/hours.js"),
    ],
)
async def test_page_is_safe_and_complete(client, screen, module):
    answer = await client.get(screen)
    assert answer.status_code == 200
    assert "default-src 'none'" in answer.headers["content-security-policy"]
    assert "<script>" not in answer.text
    assert "style=" not in answer.text
    for path in (module, "/static/style.css", "/static/icon.svg"):
        assert path in answer.text
        assert (await client.get(path)).status_code == 200


async def test_goals_cannot_become_markup(make_app):
    goals = {'"><img src=x>': 2.5}
    transport = httpx.ASGITransport(app=make_app(goal_hours=goals))
    async with httpx.AsyncClient(transport=transport, base_url="http://localhost") as client:
        text = (await client.get("/hours")).text
    assert "<img src=x>" not in text
    (written,) = re.findall(r'data-goals="([^"]*)"', text)
    assert json.loads(html.unescape(written)) == goals


@pytest.mark.parametrize("goal", [0, -1, "NaN", "Infinity"])
def test_goals_are_hours(goal):
    with pytest.raises(ValidationError, match="goal_hours"):
        DashboardSettings(goal_hours={"fold": goal})


async def test_station_name_cannot_become_markup(make_app):
    transport = httpx.ASGITransport(app=make_app(station="<img src=x>"))
    async with httpx.AsyncClient(transport=transport, base_url="http://localhost") as client:
        text = (await client.get("/")).text
    assert "<img src=x>" not in text
    assert "&lt;img src=x&gt;" in text


@pytest.mark.parametrize("side", ["left", "right"])
async def test_heatmap_is_that_of_the_report(client, side):
    layout = (await client.get("/v1/heatmap")).json()
    taxels = np.arange(320, dtype=np.float32)
    drawn = np.full(layout["rows"] * layout["columns"], np.nan, dtype=np.float32)
    drawn[layout["cells"][side]] = taxels
    np.testing.assert_array_equal(drawn.reshape(28, 26), DEXTOUCH_V1.hand_canvas(taxels, side=side))


async def test_overview(client):
    overview = (await client.get("/v1/overview")).json()
    assert overview["station"]["level"] == "OK"
    assert [service["name"] for service in overview["services"]] == ["acquisition", "episode_store"]
    assert overview["takes"][0]["name"] == "take-0001"


async def test_recorder(client):
    body = {"task": "stack_bowls", "instruction": "stack the bowls"}
    assert (await client.post("/v1/recorder/arm", json=body)).json()["state"] == "armed"
    refused = await client.post("/v1/recorder/explode", json={})
    assert refused.status_code == 422
    assert "valid: arm" in refused.json()["detail"]


async def test_who_is_recorded_reaches_the_station(client, services):
    prompt = {"task": "stack_bowls", "instruction": "stack", "operator": "p7", "consent": True}
    await client.post("/v1/recorder/arm", json=prompt)
    assert services.asked[-1] == prompt


async def test_nothing_is_saved_without_an_outcome(client, services):
    answer = await client.post("/v1/recorder/save", json={"recording_id": "take-7"})
    assert answer.status_code == 422
    assert "expected success: true, false or null" in answer.json()["detail"]
    assert "/v1/recorder/save" not in services.asked
    for success in (True, False, None):
        await client.post("/v1/recorder/save", json={"success": success})
        assert services.asked[-1] == {"success": success}


@pytest.mark.parametrize("outcome", ["NaN", "1e400", r'"\ud800"'])
async def test_what_is_no_json_reaches_no_station(client, services, outcome):
    sent = {"content": f'{{"success": {outcome}}}', "headers": {"content-type": "application/json"}}
    answer = await client.post("/v1/recorder/save", **sent)
    assert answer.status_code == 422
    assert "acquisition: POST /v1/recorder/save" in answer.json()["detail"]
    assert services.asked == []


async def test_recorder_conflict_is_passed_on(client):
    answer = await client.post("/v1/recorder/record", json={})
    assert answer.status_code == 409
    assert answer.json()["detail"] == "record: got state idle, expected armed"


@pytest.mark.parametrize("name", ["%07", "..", "a%3Fb", "a%23", "%F0%9F%93%B7", "x" * 65, "%20"])
async def test_names_that_no_camera_has_are_refused(client, services, name):
    answer = await client.get(f"/v1/cameras/{name}.jpg")
    assert answer.status_code == 422
    assert "path.name" in answer.json()["detail"]
    assert not services.asked


@pytest.mark.parametrize(
    ("headers", "status"),
    [
        ({"origin": "http://evil.example"}, 403),
        ({"origin": "null"}, 403),
        ({"host": "evil.example"}, 421),
    ],
)
async def test_foreign_sites_are_refused(client, headers, status):
    answer = await client.post("/v1/recorder/arm", json={}, headers=headers)
    assert answer.status_code == status


async def test_keys_need_a_sign_in(make_app):
    key = {"name": "operator", "key": KEY, "scopes": ("operate",)}
    transport = httpx.ASGITransport(app=make_app(api_keys=(key,)))
    async with httpx.AsyncClient(transport=transport, base_url="http://127.0.0.1") as client:
        assert (await client.get("/v1/overview")).status_code == 401
        assert 'name="key"' in (await client.get("/")).text
        wrong = await client.post("/sign_in", data={"key": "another-key-of-length"})
        assert wrong.status_code == 401
        assert KEY not in wrong.text
        right = await client.post("/sign_in", data={"key": KEY})
        assert right.status_code == 303
        cookie = right.headers["set-cookie"].lower()
        assert "httponly" in cookie
        assert "samesite=strict" in cookie
        assert (await client.get("/v1/overview")).status_code == 200


class Socket:
    """The browser's end of one websocket, spoken as plain ASGI."""

    def __init__(self, app, headers):
        self._to_app, self._from_app = asyncio.Queue(), asyncio.Queue()
        scope = {
            "type": "websocket",
            "path": "/v1/live",
            "raw_path": b"/v1/live",
            "root_path": "",
            "scheme": "ws",
            "query_string": b"",
            "headers": [(name.encode(), value.encode()) for name, value in headers.items()],
            "client": ("127.0.0.1", 1),
            "server": ("127.0.0.1", 80),
            "subprotocols": [],
            "state": {},
            "app": app,
        }
        self._to_app.put_nowait({"type": "websocket.connect"})
        self._task = asyncio.create_task(app(scope, self._to_app.get, self._from_app.put))

    def look_at(self, *topics):
        text = json.dumps({"view": topics})
        self._to_app.put_nowait({"type": "websocket.receive", "text": text})

    async def receive(self):
        return await asyncio.wait_for(self._from_app.get(), 60)

    async def leave(self):
        self._to_app.put_nowait({"type": "websocket.disconnect", "code": 1001})
        await asyncio.wait_for(self._task, 60)


async def test_live_sends_what_is_in_view(make_app, services):
    app = make_app()
    async with app.router.lifespan_context(app):
        socket = Socket(app, {"host": "localhost", "origin": "http://localhost"})
        assert (await socket.receive())["type"] == "websocket.accept"
        socket.look_at("taxels")
        first = await socket.receive()
        assert len(first["bytes"]) == 4 + 4 * 320
        assert "/v1/episodes" not in services.asked
        socket.look_at("takes")
        while True:
            message = await socket.receive()
            if message.get("text"):
                break
        assert json.loads(message["text"])["topic"] == "takes"
        await socket.leave()
    assert asyncio.all_tasks() == {asyncio.current_task()}


async def test_live_refuses_foreign_sites(make_app):
    app = make_app()
    socket = Socket(app, {"host": "localhost", "origin": "http://evil.example"})
    assert (await socket.receive())["type"] == "websocket.close"


@pytest.mark.long
@pytest.mark.parametrize("looks", [True, False])
@pytest.mark.parametrize("ends_by", ["signing out", "time"])
async def test_live_ends_with_its_session(make_app, looks, ends_by):
    app = make_app(api_keys=({"name": "operator", "key": KEY, "scopes": ("operate",)},))
    async with (
        app.router.lifespan_context(app),
        httpx.AsyncClient(
            transport=httpx.ASGITransport(app), base_url="http://localhost"
        ) as client,
    ):
        await client.post("/sign_in", data={"key": KEY})
        cookie = "; ".join(f"{name}={value}" for name, value in client.cookies.items())
        socket = Socket(app, {"host": "localhost", "cookie": cookie})
        assert (await socket.receive())["type"] == "websocket.accept"
        if looks:
            socket.look_at("taxels")
            await socket.receive()
        if ends_by == "time":
            app.state.sessions.clock_s = lambda: float("inf")
        else:
            await client.post("/sign_out", headers={"content-length": "0"})
        while (message := await socket.receive())["type"] == "websocket.send":
            assert looks
        assert message["type"] == "websocket.close"
        assert message["code"] == 1008
        assert "not signed in" in message["reason"]
        await socket.leave()
    assert asyncio.all_tasks() == {asyncio.current_task()}


async def test_live_survives_nonsense(make_app):
    app = make_app()
    async with app.router.lifespan_context(app):
        socket = Socket(app, {"host": "localhost"})
        await socket.receive()
        for text in ("", "[]", '{"view": 3}', '{"view": [1, {}]}', "x" * 5000, '["takes"]'):
            socket._to_app.put_nowait({"type": "websocket.receive", "text": text})
        socket._to_app.put_nowait({"type": "websocket.receive", "bytes": b'{"view": ["takes"]}'})
        socket.look_at("takes")
        assert json.loads((await socket.receive())["text"])["topic"] == "takes"
        await socket.leave()
