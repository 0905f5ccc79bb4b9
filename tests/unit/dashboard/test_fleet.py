"""The wall shows every station, trouble first, and none that stopped answering as alive."""

import asyncio
import json

import httpx
import numpy as np
import pytest
from dashboard_fakes import broken_upstream
from fastapi import FastAPI, Response

from dextouch.errors import InvalidInputError, NotFoundError
from dextouch.schemas import StationOverview
from dextouch.streams import pack
from services.dashboard.app import create_app
from services.dashboard.feeds import Feeds
from services.dashboard.fleet import Fleet
from services.dashboard.settings import DashboardSettings
from services.dashboard.upstream import Upstream
from tests.unit.other_gloves import largest_layout

LEFT = np.arange(320, dtype=np.float32)
CAMERA = {"name": "camera_head", "image_index": 7, "age_s": 0.1, "height_px": 4, "width_px": 4}


class FakeStation:
    """A station that says what a test wants, and may stop to answer."""

    def __init__(self, level, **fields):
        self.fields = {"level": level, "cause": f"why {level}", "recorder": "idle"} | fields
        self.hangs = asyncio.Event()
        self.asked = []
        app = FastAPI()
        app.get("/v1/live/overview")(self._overview)
        app.get("/v1/recorder")(self._recorder)
        transport = httpx.ASGITransport(app=app)
        client = httpx.AsyncClient(transport=transport, base_url="http://fake")
        self.upstream = Upstream("acquisition", client)

    async def _overview(self):
        self.asked.append("overview")
        if self.hangs.is_set():
            await asyncio.sleep(3600)
        arrays = {"tactile_left": LEFT}
        return Response(pack({**self.fields, "station": "its own name"}, arrays))

    async def _recorder(self):
        self.asked.append("recorder")
        return {"state": "idle", "actions": []}


def fleet_of(stations, **settings):
    chosen = DashboardSettings(**settings)
    feeds = {name: Feeds({"acquisition": one}, chosen) for name, one in stations.items()}
    return Fleet(feeds, chosen)


async def tiles(fleet):
    text, *pressures = await fleet.topic.newest()
    return json.loads(text)["data"], pressures


async def test_trouble_comes_first():
    levels = {"a": "OK", "b": "WARN", "c": "ERROR", "d": "OK"}
    stations = {name: FakeStation(level).upstream for name, level in levels.items()}
    # Enough time for all on a busy machine.
    fleet = fleet_of(stations | {"e": broken_upstream("acquisition")}, fleet_period_s=10)
    shown, pressures = await tiles(fleet)
    assert [(tile["name"], tile["level"]) for tile in shown] == [
        ("c", "ERROR"),
        ("e", "STALE"),
        ("b", "WARN"),
        ("a", "OK"),
        ("d", "OK"),
    ]
    assert (shown[1]["cause"], shown[1]["recorder"]) == ("This station does not answer.", "unknown")
    assert "http://fake" in shown[1]["advice"]
    assert [message[:2] for message in pressures] == [bytes([3, index]) for index in range(5)]
    hands = [np.frombuffer(message[4:], "<f4").reshape(2, 320) for message in pressures]
    np.testing.assert_array_equal(hands[0], [LEFT, np.zeros(320)])
    assert not hands[1].any()


async def test_a_tile_shows_the_take():
    fields = {"recorder": "recording", "task": "stack_bowls", "duration_s": 4.5}
    station = FakeStation("OK", cameras=[CAMERA | {"age_s": 9.0}, CAMERA], **fields)
    ((tile,), _) = await tiles(fleet_of({"a": station.upstream}))
    assert {name: tile[name] for name in fields} == fields
    assert (tile["camera"]["age_s"], tile["gloves"]) == (0.1, ["left"])


async def test_a_glove_of_the_largest_layout_is_drawn_by_it():
    layout = largest_layout()
    overview = StationOverview(
        station="a",
        level="OK",
        cause="",
        advice="Plug it in.",
        recorder="idle",
        layouts={"left": layout},
    )
    station = FakeStation("OK", **overview.model_dump(mode="json", exclude={"level"}))
    ((tile,), _) = await tiles(fleet_of({"a": station.upstream}))
    assert tile["layouts"] == {"left": json.loads(layout.model_dump_json())}
    assert tile["advice"] == "Plug it in."


async def test_a_station_that_hangs_is_stale_and_holds_up_no_other():
    hung, well = FakeStation("OK"), FakeStation("OK")
    stations = {"hung": hung.upstream, "well": well.upstream}
    fleet = fleet_of(stations, live_timeout_s=0.3, fleet_period_s=0.05)
    shown, _ = await tiles(fleet)
    assert [tile["level"] for tile in shown] == ["OK", "OK"]
    hung.hangs.set()
    asked = len(well.asked)
    async with asyncio.timeout(30):
        while (shown := (await tiles(fleet))[0])[0]["level"] != "STALE":  # noqa: ASYNC110 - by the wall itself
            await asyncio.sleep(0.01)
    assert (shown[0]["name"], shown[0]["camera"], shown[0]["gloves"]) == ("hung", None, [])
    assert shown[1]["level"] == "OK"
    assert len(well.asked) > asked
    # One question at a time, however long it takes.
    assert len(hung.asked) == 2


async def test_an_overview_of_another_form_is_named():
    station = FakeStation("FINE")
    ((tile,), _) = await tiles(fleet_of({"a": station.upstream}))
    assert tile["level"] == "STALE"
    assert "unexpected overview (level: " in tile["cause"]


def test_stations_are_chosen_by_name():
    settings = DashboardSettings(
        station="one", acquisition_url="http://a:1/", stations={"two": "http://b:2"}
    )
    assert settings.station_urls() == {"one": "http://a:1", "two": "http://b:2"}
    fleet = fleet_of({"one": FakeStation("OK").upstream, "two": FakeStation("OK").upstream})
    assert fleet.of(None) is fleet.of("one")
    assert fleet.of("two") is not fleet.of("one")
    with pytest.raises(NotFoundError, match="it shows one, two"):
        fleet.of("three")


def test_addresses_of_services_are_checked_at_the_start():
    with pytest.raises(InvalidInputError, match=r"twin: got 'h:80', expected http"):
        create_app(DashboardSettings(twin_url="h:80"))


async def test_pages_of_a_station_that_is_none_are_refused():
    settings = DashboardSettings(station="one", acquisition_url="http://127.0.0.1:9")
    transport = httpx.ASGITransport(app=create_app(settings))
    async with httpx.AsyncClient(transport=transport, base_url="http://localhost") as client:
        assert (await client.get("/?station=two")).status_code == 404
        assert (await client.get("/v1/overview?station=two")).status_code == 404
        page = (await client.get("/?station=one")).text
        # One station needs no wall.
        assert 'href="/?station=one"' in page
        assert 'href="/fleet"' not in page
