"""Every screen with content, at two widths, light and dark: no overflow, no error on the console,
no text of low contrast, no request to another host. `make screens` also saves a picture of each."""

import os
from contextlib import ExitStack
from pathlib import Path
from urllib.parse import urlsplit

import pytest
from playwright.sync_api import expect

from tests.browser.stage import (
    KEY,
    STREAMS,
    know_the_lens,
    open_rollout,
    record_a_take,
    serve_alignment,
    serve_dashboard,
    serve_rating,
    serve_stations,
    serve_store,
    serve_worlds_and_studies,
)
from tests.browser.walking import SETTLED

WIDTHS_PX = {1366: 768, 1920: 1080}
# So that what is further down is in view too, and sent.
TALL_PX = 1700
SCHEMES = ("light", "dark")
CHECK = Path(__file__).with_name("read_screen.js").read_text()
# File of axe-core, if it is to judge the pages.
AXE = os.environ.get("DEXTOUCH_AXE")
AXE_RUN = """async () => (await axe.run({ resultTypes: ["violations"] })).violations
  .filter(({ impact }) => ["serious", "critical"].includes(impact))
  .map(({ id, nodes }) => `axe ${id}: ${nodes.map(({ target }) => target).join(" | ")}`)"""
# Folder that pictures are saved in, if any.
PICTURES = os.environ.get("DEXTOUCH_SCREENS")
# Two frames after the last change, the page shows it.
DRAWN = "() => new Promise((done) => requestAnimationFrame(() => requestAnimationFrame(done)))"


class Screens:
    """Judges what a page shows, in all widths and schemes, and saves pictures of it."""

    def __init__(self, page):
        self.page = page
        self.faults = []
        self.hosts = set()
        self._name = "start"
        page.on("console", self._said)
        page.on("pageerror", lambda error: self._fault(str(error)))
        page.on("request", self._requested)

    def _fault(self, text):
        self.faults.append(f"{self._name}: {text}")

    def _said(self, line):
        # Refusals that the page answers in words are errors for Chromium's console.
        if line.type == "error" and "Failed to load resource" not in line.text:
            self._fault(f"console: {line.text}")

    def _requested(self, request):
        place = urlsplit(request.url)
        if place.scheme not in ("data", "blob") and place.netloc not in self.hosts:
            self._fault(f"request to {place.netloc}")

    def may_ask(self, *urls):
        self.hosts |= {urlsplit(url).netloc for url in urls}

    def look(self, name, *, is_tall=False):
        self._name = name
        for width_px, usual_px in WIDTHS_PX.items():
            height_px = TALL_PX if is_tall else usual_px
            self.page.set_viewport_size({"width": width_px, "height": height_px})
            for scheme in SCHEMES:
                self.page.emulate_media(color_scheme=scheme)
                self.page.evaluate(DRAWN)
                found = self.page.evaluate(CHECK)
                if AXE:
                    self.page.evaluate(Path(AXE).read_text())
                    found += self.page.evaluate(AXE_RUN)
                self.faults += [f"{name}, {width_px} px, {scheme}: {one}" for one in found]
                if PICTURES:
                    path = Path(PICTURES) / f"{name}_{width_px}_{scheme}.png"
                    self.page.wait_for_timeout(200)
                    # A dialog and the deck of the player belong to the window; documents are long.
                    windows = "dialog[open], .deck:not([hidden]), .document"
                    of_window = self.page.locator(windows).count() > 0
                    self.page.screenshot(path=path, full_page=not of_window)


@pytest.fixture
def screens(open_page):
    if PICTURES:
        Path(PICTURES).mkdir(parents=True, exist_ok=True)
    found = Screens(open_page(viewport={"width": 1366, "height": 768}))
    yield found
    assert not found.faults, "\n".join(found.faults)


def sign_in(page, address):
    page.goto(address)
    page.get_by_label("Key", exact=True).fill(KEY)
    page.keyboard.press("Enter")
    expect(page.get_by_role("button", name="Sign out")).to_be_visible()


@pytest.fixture
def stations(serve, station_process, tmp_path):
    """Settings of a dashboard of two stations that run, and one that does not."""
    return serve_stations(station_process) | serve_store(serve, tmp_path)


def look_at_entrance(screens, address):
    page = screens.page
    page.goto(address)
    page.get_by_label("Key", exact=True).fill("a wrong key")
    page.keyboard.press("Enter")
    expect(page.get_by_role("alert")).to_contain_text("unknown key")
    screens.look("sign_in")
    sign_in(page, address)
    page.goto(f"{address}/?station=none")
    expect(page.get_by_role("alert")).to_contain_text("desk_1, desk_2, desk_3")
    screens.look("unknown_station")


def look_at_silent_station(screens, address):
    page = screens.page
    page.goto(f"{address}/?station=desk_3")
    expect(page.locator("#causes")).to_contain_text("This station does not answer.")
    # A click that lasts longer than the time between two updates.
    page.locator("#causes summary").hover()
    page.mouse.down()
    page.wait_for_timeout(500)
    page.mouse.up()
    expect(page.locator("#causes details[open]")).to_contain_text("no answer to GET /v1/health")
    screens.look("station_unreachable", is_tall=True)


@pytest.mark.slow
def test_entrance_and_stations(screens, serve, stations, tmp_path):
    page, address = screens.page, serve_dashboard(serve, tmp_path, stations)
    screens.may_ask(address)
    look_at_entrance(screens, address)
    page.goto(f"{address}/?station=desk_1")
    expect(page.locator("#hand_left_text")).to_contain_text("contact")
    expect(page.locator("#take_rows tr")).to_have_count(12)
    screens.look("station", is_tall=True)
    page.keyboard.press("?")
    screens.look("station_keys")
    page.keyboard.press("Escape")
    record_a_take(stations["acquisition_url"])
    expect(page.locator("#verdict")).to_be_visible()
    screens.look("station_checking", is_tall=True)
    look_at_silent_station(screens, address)
    page.goto(f"{address}/fleet")
    expect(page.locator(".tile img")).to_have_count(2)
    expect(page.locator("[data-station=desk_3]")).to_contain_text("Check that its computer is on")
    screens.look("fleet")
    page.goto(f"{address}/health?station=desk_2")
    expect(page.locator("#plot_rate canvas")).to_be_visible()
    screens.look("health")
    page.get_by_role("link", name="Help").click()
    expect(page.get_by_role("heading", name="Health", exact=True)).to_be_in_viewport()
    screens.look("help")
    # Through pages that are of no station, the links stay with the one that was chosen.
    for name in ("Hours", "Episodes", "Station"):
        page.get_by_role("navigation", name="screens").get_by_role("link", name=name).click()
    expect(page).to_have_url(f"{address}/?station=desk_2")


@pytest.mark.slow
def test_stored_items(screens, serve, tmp_path):
    page = screens.page
    address = serve_dashboard(serve, tmp_path, serve_store(serve, tmp_path))
    screens.may_ask(address)
    sign_in(page, address)
    page.goto(f"{address}/episodes")
    expect(page.locator("#rows tr")).to_have_count(34)
    screens.look("episodes")
    page.locator("#rows tr").nth(3).click()
    page.keyboard.press("l")
    expect(page.get_by_role("dialog")).to_contain_text("Made from")
    screens.look("episodes_lineage")
    page.goto(f"{address}/episodes?view=trash")
    expect(page.locator("#rows tr")).to_have_count(1)
    screens.look("episodes_trash")
    for kind, name in (("episode", "episode-1"), ("recording", "take-1")):
        page.goto(f"{address}/episodes/{kind}/{name}?at=3.0")
        page.wait_for_function(SETTLED)
        screens.look(f"player_{kind}")
    page.goto(f"{address}/objects")
    page.locator("#image[data-state=shown]").wait_for()
    page.keyboard.press("h")
    expect(page.locator("#message")).to_contain_text("Saved")
    screens.look("objects")
    page.goto(f"{address}/review")
    expect(page.locator("#rows tr").first).to_be_visible()
    screens.look("review")
    page.keyboard.press("r")
    expect(page.get_by_role("dialog")).to_be_visible()
    screens.look("review_reject")
    page.goto(f"{address}/hours")
    expect(page.locator("#task_rows tr").first).to_be_visible()
    screens.look("hours")


def look_at_calibration(screens, address, folder):
    page = screens.page
    page.goto(f"{address}/calibration")
    expect(page.locator("#item_rows tr").first).to_be_visible()
    screens.look("calibration")
    know_the_lens(folder)
    page.locator("#practice_start").click()
    expect(page.locator("#practice_stop")).to_be_visible(timeout=120_000)
    page.locator("tr[data-name=T_tracker_head_camera_head] button").click()
    screens.look("calibration_begin")
    page.keyboard.press("Enter")
    expect(page.locator("#gauges li")).to_have_count(7)
    screens.look("calibration_mount")
    page.locator("#run_cancel").click()
    expect(page.locator("#run_state")).to_have_text("cancelled")
    page.locator("#practice_stop").click()
    expect(page.locator("#practice_start")).to_be_visible()


@pytest.mark.slow
def test_services_and_worlds(screens, serve, station_process, tmp_path):
    page = screens.page
    station = station_process("desk_2", *STREAMS["desk_2"]).url
    settings = serve_store(serve, tmp_path) | serve_alignment(serve, tmp_path, station)
    settings |= serve_worlds_and_studies(serve, tmp_path) | serve_rating(serve, tmp_path)
    address = serve_dashboard(serve, tmp_path, settings | {"acquisition_url": station})
    screens.may_ask(address, settings["rating_url"])
    sign_in(page, address)
    look_at_calibration(screens, address, tmp_path / "calibration" / "practice")
    with ExitStack() as stack:
        open_rollout(stack, settings["world_model_url"])
        page.goto(f"{address}/rollouts")
        page.get_by_role("button", name="Watch").click()
        expect(page.locator("#watched")).to_have_attribute("data-step", "4")
        screens.look("rollouts")
    page.goto(f"{address}/studies")
    page.locator("#study_rows a").wait_for()
    screens.look("studies")
    page.locator("#study_rows a").click()
    expect(page.locator("#rollouts tbody tr").first).to_be_visible()
    screens.look("study")
    page.goto(f"{address}/system")
    expect(page.locator("#audit_rows tr").first).to_be_visible()
    expect(page.locator("[data-service='episode store']")).to_contain_text("ready")
    screens.look("system")
    page.get_by_role("link", name="Rating").click()
    expect(page.get_by_label("Your name")).to_be_visible()
    screens.look("rating_start")
    page.get_by_label("Your name").fill("ada")
    page.get_by_role("button", name="Start").click()
    expect(page.locator("canvas")).to_have_attribute("height", "384")
    screens.look("rating")
