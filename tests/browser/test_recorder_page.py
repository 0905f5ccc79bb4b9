"""Takes recorded through the page, on a station with mock devices: every label is asked for."""

import pytest
from fastapi import FastAPI
from fastapi.responses import JSONResponse
from playwright.sync_api import expect

from dextouch.episodes.spool import SpoolReader
from services.dashboard.app import create_app as create_dashboard
from services.dashboard.settings import DashboardSettings


@pytest.fixture
def spool(tmp_path):
    return tmp_path / "spool"


@pytest.fixture
def address(serve, serve_station, spool):
    """A dashboard over a station with mock devices."""
    return serve(create_dashboard(DashboardSettings(acquisition_url=serve_station(spool))))


def state(page):
    return page.locator("#recorder_state")


def open_recorder(page, address):
    """The page once it knows the station; its live link."""
    with page.expect_websocket() as live:
        page.goto(address)
    expect(state(page)).to_have_text("idle")
    return live.value


def message(page):
    return page.locator("#recorder_message")


def press_until(page, key, text):
    """Press a recorder key; twice where it asks whether an incomplete take is meant."""
    page.keyboard.press(key)
    asks = message(page).filter(has_text="Once more within three seconds")
    expect(state(page).filter(has_text=text).or_(asks)).not_to_have_count(0)
    if state(page).text_content() != text:
        page.keyboard.press(key)
    expect(state(page)).to_have_text(text)


def record(page):
    """A take's way from arming to its check, by keys; the id it got."""
    page.keyboard.press("a")
    expect(state(page)).to_have_text("armed")
    page.keyboard.press("r")
    expect(state(page)).to_have_text("recording")
    expect(page.locator("#recorder_clock")).not_to_have_text("0:00.0")
    page.keyboard.press("s")
    expect(state(page)).to_have_text("checking")
    return page.locator("#recorder_note").text_content().split(" · ")[0]


def fill(page, **fields):
    for name, text in fields.items():
        if name == "instruction":
            page.locator("#instruction_choice").select_option("")
        page.locator(f"#{name}").fill(text)


def test_the_outcome_is_asked_at_every_take(page, address, spool):
    open_recorder(page, address)
    fill(page, instruction="Stack the bowls", operator="p7")
    page.get_by_label("Consent given").check()
    first = record(page)
    page.locator("#outcome").get_by_text("Success").click()
    press_until(page, "v", "saved")

    second = record(page)
    expect(page.locator("input[name=outcome]:checked")).to_have_count(0)
    expect(page.get_by_role("button", name="Save")).to_be_disabled()
    page.keyboard.press("v")
    expect(message(page)).to_contain_text("How did this take end?")
    page.keyboard.press("v")
    expect(state(page)).to_have_text("checking")
    assert not SpoolReader(spool / second).closed
    page.keyboard.press("n")
    press_until(page, "v", "saved")

    third = record(page)
    page.keyboard.press("u")
    press_until(page, "v", "saved")

    saved = [SpoolReader(spool / name) for name in (first, second, third)]
    assert all(take.closed for take in saved)
    labels = [take.attributes for take in saved]
    assert [label.success for label in labels] == [True, False, None]
    assert {(label.operator, label.consent) for label in labels} == {("p7", True)}


def test_an_outcome_ends_with_its_take(page, address, spool):
    open_recorder(page, address)
    fill(page, instruction="Stack the bowls")
    page.keyboard.press("Enter")
    thrown_away = record(page)
    page.keyboard.press("y")
    press_until(page, "g", "armed")
    assert not (spool / thrown_away).exists()
    record(page)
    expect(page.locator("input[name=outcome]:checked")).to_have_count(0)
    press_until(page, "d", "discarded")


def test_another_operator_is_asked_for_consent(page, address):
    open_recorder(page, address)
    fill(page, instruction="Stack the bowls", operator="p7")
    consent = page.get_by_label("Consent given")
    consent.check()
    page.keyboard.press("a")
    expect(state(page)).to_have_text("armed")
    expect(consent).to_be_checked()
    fill(page, operator="p8")
    expect(consent).not_to_be_checked()
    # What is armed is still p7: nothing is recorded under the wrong name.
    expect(page.get_by_role("button", name="Record R", exact=True)).to_be_disabled()
    page.keyboard.press("Escape")
    page.keyboard.press("r")
    expect(message(page)).to_contain_text("arm again")
    expect(state(page)).to_have_text("armed")


def ask_to_discard(page):
    """Press D until its question is seen; it is withdrawn after three seconds."""
    question = message(page).filter(has_text="Discard this take?")
    for _ in range(5):
        page.keyboard.press("d")
        try:
            expect(question).to_have_count(1, timeout=2500)
        except AssertionError:
            page.wait_for_timeout(3000)
        else:
            return
    raise AssertionError("the question was not seen")


@pytest.mark.slow
def test_keys_work_again_after_typing(page, address):
    live = open_recorder(page, address)
    fill(page, instruction="Stack the bowls")
    page.keyboard.press("Escape")
    page.keyboard.press("a")
    expect(state(page)).to_have_text("armed")
    page.get_by_label("Domain").focus()
    page.keyboard.press("Escape")
    page.locator("#instruction").focus()
    page.keyboard.press("Enter")
    page.keyboard.press("r")
    expect(state(page)).to_have_text("recording")
    expect(page.locator("#instruction")).to_have_value("Stack the bowls")
    # The question outlives the news that come five times a second.
    ask_to_discard(page)
    for _ in range(5):
        live.wait_for_event("framereceived")
    expect(message(page)).to_contain_text("Discard this take?")
    press_until(page, "d", "discarded")


@pytest.mark.slow
def test_a_page_that_is_loaded_anew_shows_what_is_armed(page, address):
    open_recorder(page, address)
    fill(page, instruction="Stack the bowls", operator="p7")
    page.keyboard.press("Enter")
    expect(state(page)).to_have_text("armed")
    page.reload()
    expect(state(page)).to_have_text("armed")
    expect(page.locator("#instruction")).to_have_value("Stack the bowls")
    expect(page.get_by_label("Operator")).to_have_value("p7")
    expect(page.get_by_label("Consent given")).not_to_be_checked()
    expect(page.get_by_role("button", name="Record R", exact=True)).to_be_enabled()


@pytest.mark.slow
def test_a_refused_take_is_shown_and_sent_again(page, serve, serve_station, spool):
    """Three times when it was saved, and three times more when the operator asks for it."""
    problem = {"type": "urn:dextouch:error:InvalidInputError", "title": "InvalidInput"}
    asked = []
    store = FastAPI()

    @store.post("/v1/recordings")
    def create():
        asked.append(1)
        facts = {"status": 422, "detail": f"unknown task, said {len(asked)} times"}
        return JSONResponse(problem | facts, 422, media_type="application/problem+json")

    station = serve_station(spool, episode_store_url=serve(store), upload_period_s=0.01)
    open_recorder(page, serve(create_dashboard(DashboardSettings(acquisition_url=station))))
    fill(page, instruction="Stack the bowls")
    page.keyboard.press("Escape")
    take = record(page)
    page.keyboard.press("u")
    press_until(page, "v", "saved")
    waiting = page.get_by_role("list", name="takes that the store refused")
    page.locator("#takes").scroll_into_view_if_needed()
    expect(waiting).to_contain_text(take)
    expect(waiting).to_contain_text("unknown task, said 3 times")
    waiting.get_by_role("button", name="Send again").click()
    expect(waiting).to_contain_text("unknown task, said 6 times")
    assert (spool / take / "recording.json").exists()
    last = page.locator("#last_take")
    expect(last).to_contain_text(f"{take} refused by the store")
    expect(last).to_contain_text("unknown task, said 6 times")


@pytest.mark.slow
def test_no_store_is_said(page, address):
    page.goto(address)
    page.locator("#takes").scroll_into_view_if_needed()
    expect(page.locator("#take_rows")).to_contain_text("without DEXTOUCH_DASHBOARD_EPISODE_STORE")
