"""Ten takes of an operator by keyboard alone: the two that went wrong are found in Review."""

import pytest
from playwright.sync_api import expect

from services.acquisition.app import create_app as create_station
from services.acquisition.mocks import pattern
from services.acquisition.settings import AcquisitionSettings
from services.dashboard.app import create_app as create_dashboard
from services.dashboard.settings import DashboardSettings
from services.episode_store.app import create_app as create_store
from services.episode_store.settings import EpisodeStoreSettings
from tests.browser.test_operator_walk import press
from tests.browser.walking import go, wait_for_clock

STREAMS = {"tactile_left", "head"}
NUM_TAKES, WITHOUT_GLOVE, WITH_A_HOLE = 10, 3, 6


@pytest.fixture
def address(serve, tmp_path, monkeypatch):
    """A dashboard over a store and a station with a glove and a tracker, both simulated."""
    whole = [s for s in pattern.pattern_streams() if s.descriptor.name in STREAMS]
    monkeypatch.setattr(pattern, "pattern_streams", lambda **_: whole)
    store = serve(create_store(EpisodeStoreSettings(store_url=str(tmp_path / "store"))))
    station = AcquisitionSettings(
        spool=tmp_path / "spool", mock=True, episode_store_url=store, upload_period_s=0.1
    )
    urls = {"acquisition_url": serve(create_station(station)), "episode_store_url": store}
    return serve(create_dashboard(DashboardSettings(live_timeout_s=10, **urls)))


def name_the_operator(page):
    page.keyboard.press("o")
    page.keyboard.type("p7")
    page.keyboard.press("Escape")
    page.keyboard.press("c")
    page.keyboard.press("Space")
    expect(page.locator("#count_of")).to_contain_text("p7, consent given")


def pull_the_plug(page, *, is_out):
    page.keyboard.press("f")
    expect(page.locator("#faults [aria-pressed=true]")).to_have_text(["Unplug"] * is_out)
    heard = "no glove is heard" if is_out else "contact"
    expect(page.locator("#hand_left_text")).to_contain_text(heard)


def record(page, number):
    """A take that is saved; its id."""
    press(page, "a", "armed")
    press(page, "r", "recording")
    wait_for_clock(page, 1.5)
    if number == WITH_A_HOLE:
        pull_the_plug(page, is_out=True)
        pull_the_plug(page, is_out=False)
    press(page, "s", "checking")
    expect(page.locator("#verdict_word")).to_be_visible()
    take = page.locator("#recorder_note").text_content().split(" · ")[0]
    if number in (WITHOUT_GLOVE, WITH_A_HOLE):
        expect(page.locator("#verdict_word")).to_have_text("Incomplete")
        expect(page.locator("#verdict")).to_contain_text("tactile_left")
    page.keyboard.press("u")
    press(page, "v", "saved")
    return take


@pytest.mark.slow
def test_ten_takes_by_keyboard_and_two_that_went_wrong(open_page, address):
    page = open_page(viewport={"width": 1366, "height": 768})
    page.goto(address)
    expect(page.locator("#recorder_state")).to_have_text("idle")
    name_the_operator(page)
    takes = []
    for number in range(NUM_TAKES):
        if number == WITHOUT_GLOVE:
            pull_the_plug(page, is_out=True)
        takes.append(record(page, number))
        if number == WITHOUT_GLOVE:
            pull_the_plug(page, is_out=False)
    expect(page.locator("#num_saved")).to_have_text(str(NUM_TAKES))
    last = page.locator("#last_take a[href]")
    expect(last).to_have_text(takes[-1])
    expect(last).to_have_attribute("href", f"/episodes/recording/{takes[-1]}")
    go(page, "Review")
    for number in (WITHOUT_GLOVE, WITH_A_HOLE):
        row = page.locator("#rows tr").filter(has_text=takes[number])
        expect(row).to_contain_text("incomplete: ")
