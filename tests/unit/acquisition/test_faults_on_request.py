"""Faults that a simulated station shows on request: what health says of them, and their end."""

import time
from types import SimpleNamespace

import httpx
import pytest

from services.acquisition import app as station_app
from services.acquisition.clock import StationClock
from services.acquisition.mock_station import build_mocks
from services.acquisition.mocks import FaultScript, SocketPort, pattern
from services.acquisition.mocks.faults import OurPacketEdits
from services.acquisition.mocks.gloves import TactileGloveSource
from services.acquisition.settings import AcquisitionSettings

STREAMS = {"tactile_left", "tactile_right", "wrist_left", "head"}
PATIENCE_S = 60


@pytest.fixture
async def station(tmp_path, monkeypatch, request):
    whole = pattern.pattern_streams()
    shown = getattr(request, "param", STREAMS)
    streams = [stream for stream in whole if stream.descriptor.name in shown]
    monkeypatch.setattr(pattern, "pattern_streams", lambda **_: streams)
    app = station_app.create_app(AcquisitionSettings(spool=tmp_path / "spool", mock=True))
    transport = httpx.ASGITransport(app=app)
    async with (
        app.router.lifespan_context(app),
        httpx.AsyncClient(transport=transport, base_url="http://localhost") as client,
    ):
        yield client


async def switch(station, fault, *, on):
    reply = await station.post(f"/v1/faults/{fault}", json={"on": on})
    assert reply.status_code == 200, reply.text
    return reply.json()


async def found(station, is_there):
    """The health once it is as wanted."""
    deadline_s = time.monotonic() + PATIENCE_S
    while True:
        health = (await station.get("/v1/health")).json()
        causes = {(cause["code"], code) for cause in health["causes"] for code in cause["findings"]}
        if is_there(causes, health):
            return health
        assert time.monotonic() < deadline_s, (causes, health["streams"])
        time.sleep(0.1)  # noqa: ASYNC251 - the station runs in threads of its own


def stream(health, name):
    return next(one for one in health["streams"] if one["stream"] == name)


async def test_a_glove_is_unplugged_and_plugged_in_again(station):
    health = await found(station, lambda _, one: stream(one, "tactile_right")["stale"] is None)
    assert health["faults"] == []
    assert await switch(station, "unplug", on=True) == ["unplug"]
    assert await switch(station, "unplug", on=True) == ["unplug"]
    health = await found(station, lambda causes, _: ("gone", "unplugged") in causes)
    assert stream(health, "tactile_left")["stale"] == "unplugged"
    # On a busy machine the other glove may be silent for a moment.
    assert stream(health, "tactile_right")["stale"] != "unplugged"
    assert health["faults"] == ["unplug"]
    (cause,) = [one for one in health["causes"] if one["code"] == "gone"]
    assert "cable" not in cause["advice"]
    assert await switch(station, "unplug", on=False) == []
    await found(station, lambda _, health: stream(health, "tactile_left")["stale"] is None)


async def test_a_zero_that_drifts_and_a_dead_taxel_are_found(station):
    await switch(station, "drift", on=True)
    assert await switch(station, "dead_taxel", on=True) == ["drift", "dead_taxel"]
    health = await found(
        station,
        lambda causes, _: {code for _, code in causes} >= {"baseline", "taxels_dead"},
    )
    assert len(stream(health, "tactile_left")["taxels"]["dead"]) == 1
    assert "dead" not in stream(health, "tactile_right")["taxels"]
    # 0.5 % of full scale: 328 counts.
    (zero,) = [f for f in stream(health, "tactile_left")["findings"] if f["code"] == "baseline"]
    assert "+32" in zero["message"]
    await switch(station, "drift", on=False)
    await found(station, lambda causes, _: "baseline" not in {code for _, code in causes})


async def test_a_slow_host_is_one_cause(station):
    await switch(station, "slow_host", on=True)
    health = await found(station, lambda causes, _: ("host", "latency") in causes)
    assert health["causes"][0]["message"].startswith("This computer is overloaded")
    assert await switch(station, "slow_host", on=False) == []


@pytest.mark.parametrize("station", [{"head"}], indirect=True)
async def test_what_is_not_there_cannot_fail(station):
    reply = await station.post("/v1/faults/unplug", json={"on": True})
    assert (reply.status_code, "no glove is simulated" in reply.text) == (409, True)
    assert (await station.post("/v1/faults/fire", json={"on": True})).status_code == 422


async def test_a_glove_that_cannot_show_a_fault_goes_on(station, monkeypatch):
    monkeypatch.setattr(TactileGloveSource, "edits", OurPacketEdits())
    for fault in ("drift", "dead_taxel"):
        reply = await station.post(f"/v1/faults/{fault}", json={"on": True})
        assert (reply.status_code, "cannot show it" in reply.text) == (409, True)
    assert (await station.get("/v1/health")).json()["faults"] == []


class Port:
    def __init__(self):
        self.done = []

    def plug(self):
        self.done.append("plug")

    def unplug(self):
        self.done.append("unplug")


def test_what_a_person_unplugs_no_script_plugs_in():
    streams = [s for s in pattern.pattern_streams() if s.descriptor.name == "tactile_left"]
    (pair,) = build_mocks(streams, faults=FaultScript(), seed=0, clock=StationClock())
    device = pair.device
    device.port = port = Port()
    for by, is_plugged in (("fault", False), ("script", False), ("script", True), ("fault", True)):
        device.set_plugged(by, is_plugged=is_plugged)
    assert port.done == ["unplug", "plug"]


def test_a_socket_is_unplugged_twice_at_once():
    port = SocketPort("probe")
    port.plug()
    port._device_end = SimpleNamespace(close=port.unplug)
    port.unplug()
    assert not port.send(b"x")


async def test_real_devices_are_left_alone(tmp_path):
    camera = {"kind": "camera", "stream": "camera_head", "port": 5000}
    app = station_app.create_app(AcquisitionSettings(spool=tmp_path / "spool", devices=(camera,)))
    transport = httpx.ASGITransport(app=app)
    async with httpx.AsyncClient(transport=transport, base_url="http://localhost") as client:
        reply = await client.post("/v1/faults/unplug", json={"on": True})
        assert (reply.status_code, "dextouch up --mock" in reply.text) == (409, True)
        assert "faults" not in (await client.get("/v1/health")).json()
        # Nobody is recorded there without having agreed.
        armed = {"task": "fold", "instruction": "fold it"}
        reply = await client.post("/v1/recorder/arm", json=armed)
        assert (reply.status_code, "--no-require-consent" in reply.text) == (422, True)
        assert (await client.get("/v1/recorder")).json()["needs_consent"]
