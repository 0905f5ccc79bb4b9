"""A page of another origin, open in an operator's browser, cannot touch a station or a dashboard.

Another port is another origin of the same site, another name of this host another site.
"""

import httpx
import pytest
from fastapi import FastAPI
from fastapi.responses import HTMLResponse
from playwright.sync_api import expect

from services.dashboard.app import create_app as create_dashboard
from services.dashboard.settings import DashboardSettings

PROMPT = {"task": "stack_bowls", "instruction": "stack the bowls"}
FETCH = """async ([url, type]) => {
  const headers = type ? { "Content-Type": type } : {};
  await fetch(url, { method: "POST", mode: "no-cors", headers, body: type ? "{}" : undefined });
}"""
FORM = """([url, enctype]) => {
  const form = document.createElement("form");
  Object.assign(form, { method: "post", action: url, enctype, target: "answer" });
  document.body.append(form);
  form.submit();
}"""
LIVE = """url => new Promise(done => {
  const heard = [];
  const socket = new WebSocket(url);
  socket.onopen = () => { heard.push("open"); socket.send('{"view": ["station"]}'); };
  socket.onmessage = event => { heard.push(event.data); socket.close(); };
  socket.onclose = () => done(heard);
})"""
TYPES = ["application/x-www-form-urlencoded", "multipart/form-data", "text/plain"]


@pytest.fixture(params=["127.0.0.1", "localhost"])
def foreign(page, serve, request):
    """A page of another origin than every service."""
    app = FastAPI()
    app.get("/")(lambda: HTMLResponse("<h1>elsewhere</h1><iframe name=answer></iframe>"))
    page.goto(serve(app).replace("127.0.0.1", request.param))
    return page


@pytest.fixture
def station(serve_station, tmp_path):
    """A station in the middle of a take."""
    url = serve_station(tmp_path / "spool")
    for action, body in (("arm", PROMPT), ("record", {"recording_id": "precious"})):
        httpx.post(f"{url}/v1/recorder/{action}", json=body, timeout=30).raise_for_status()
    return url


def state(station):
    """Of the recorder, and its take."""
    status = httpx.get(f"{station}/v1/recorder", timeout=30).json()
    return status["state"], status["recording_id"]


def test_a_take_survives_foreign_pages(foreign, station, tmp_path):
    for type_ in [None, "text/plain", "application/x-www-form-urlencoded"]:
        foreign.evaluate(FETCH, [f"{station}/v1/recorder/discard", type_])
        assert state(station) == ("recording", "precious"), type_
    for enctype in TYPES:
        with foreign.expect_response(f"{station}/v1/recorder/discard") as answer:
            foreign.evaluate(FORM, [f"{station}/v1/recorder/discard", enctype])
        assert answer.value.status == 403
        assert state(station) == ("recording", "precious"), enctype
    assert (tmp_path / "spool" / "precious" / "recording.json").exists()


def test_a_dashboard_hears_its_own_page_only(foreign, station, serve, open_page):
    address = serve(create_dashboard(DashboardSettings(acquisition_url=station)))
    live = address.replace("http://", "ws://") + "/v1/live"
    assert foreign.evaluate(LIVE, live) == []
    foreign.evaluate(FETCH, [f"{address}/v1/recorder/discard", "text/plain"])
    assert state(station) == ("recording", "precious")
    with foreign.expect_response(f"{address}/v1/recorder/discard") as answer:
        foreign.evaluate(FORM, [f"{address}/v1/recorder/discard", "text/plain"])
    assert answer.value.status == 403
    assert state(station) == ("recording", "precious")
    own = open_page()
    own.goto(address)
    expect(own.locator("#link")).to_have_text("live")
    expect(own.locator("#recorder_state")).to_have_text("recording")


def test_a_foreign_name_for_this_host_is_refused(page, station):
    """DNS rebinding: the page's own name, which then points here, makes it the same origin."""
    rebound = station.replace("127.0.0.1", "rebound.localhost")
    page.goto(f"{rebound}/v1/recorder")
    statuses = page.evaluate(
        """async () => [
          (await fetch("/v1/recorder")).status,
          (await fetch("/v1/recorder/discard", { method: "POST" })).status,
        ]"""
    )
    assert all(400 <= status < 500 for status in statuses), statuses
    assert state(station) == ("recording", "precious")
