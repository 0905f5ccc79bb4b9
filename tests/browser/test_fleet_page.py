"""The wall of stations: one that stops is STALE within a second, and shows no picture."""

import re
import sys
import time

import pytest
from playwright.sync_api import expect

from services.dashboard.app import create_app as create_dashboard
from services.dashboard.settings import DashboardSettings

STREAMS = ("tactile_left", "camera_head")
WATCH = """() => {
  const page = document.documentElement;
  delete page.dataset.staleAt;
  const look = () => {
    const tile = document.querySelector("li[data-station=desk_2]");
    const stale = tile.dataset.level === "STALE" && !tile.querySelector("img");
    if (stale) page.dataset.staleAt = Date.now();
    else requestAnimationFrame(look);
  };
  look();
}"""
NUM_ROUNDS = 5


@pytest.fixture
def stations(station_process):
    return {name: station_process(name, *STREAMS) for name in ("desk_1", "desk_2")}


@pytest.fixture
def wall(page, serve, stations):
    urls = {name: one.url for name, one in stations.items()}
    address = serve(create_dashboard(DashboardSettings(stations=urls)))
    page.goto(f"{address}/fleet")
    expect(page.locator(".tile img")).to_have_count(2)
    return page


def names(page):
    return page.locator(".tile").evaluate_all("tiles => tiles.map((tile) => tile.dataset.station)")


def test_a_station_that_stops_is_stale_and_first(wall, stations):
    delays_s = []
    tile = wall.locator("li[data-station=desk_2]")
    for _ in range(NUM_ROUNDS):
        expect(tile).not_to_have_attribute("data-level", "STALE")
        expect(tile.locator("img")).to_have_count(1)
        wall.evaluate(WATCH)
        stopped_s = time.time()
        stations["desk_2"].stop()
        html = wall.locator("html")
        expect(html).to_have_attribute("data-stale-at", re.compile(r"\d+"))
        delays_s.append(int(html.get_attribute("data-stale-at")) / 1000 - stopped_s)
        if delays_s[-1] < 1.0:
            break
        stations["desk_2"].go_on()
    shown = ", ".join(f"{delay_s:.2f}" for delay_s in delays_s)
    sys.stdout.write(f"STALE {shown} s after SIGSTOP\n")
    assert min(delays_s) < 1.0, delays_s
    # The other one may be in trouble of its own on a machine under load.
    if wall.locator("li[data-station=desk_1]").get_attribute("data-level") != "ERROR":
        assert names(wall)[0] == "desk_2"
    stations["desk_2"].go_on()
    expect(tile).not_to_have_attribute("data-level", "STALE")


@pytest.mark.slow
def test_a_tile_opens_its_station(wall):
    wall.locator("li[data-station=desk_2] a").click()
    expect(wall.locator("h1")).to_contain_text("desk_2")
    expect(wall.locator("#recorder_state")).to_have_text("idle")
    expect(wall.locator("#hand_left_text")).to_contain_text("contact")
    image = wall.locator("#camera_row img")
    expect(image).to_have_attribute("src", re.compile("station=desk_2"))
    wall.get_by_role("link", name="Station", exact=True).click()
    expect(wall.locator("h1")).to_contain_text("desk_2")


@pytest.mark.slow
def test_an_action_reaches_the_station_of_the_page(wall, stations):
    wall.locator("li[data-station=desk_2] a").click()
    expect(wall.locator("#recorder_state")).to_have_text("idle")
    wall.keyboard.press("a")
    expect(wall.locator("#recorder_state")).to_have_text("armed")
    wall.get_by_role("link", name="Fleet").click()
    expect(wall.locator("li[data-station=desk_2] .task")).not_to_have_text("no task")
    expect(wall.locator("li[data-station=desk_1] .task")).to_have_text("no task")
