"""Station keys on the page System: an administrator enrols a station, and revokes its key."""

import re

import httpx
import pytest
from playwright.sync_api import expect

from services.cli.main import main
from services.dashboard.app import create_app as create_dashboard
from services.dashboard.settings import DashboardSettings
from services.episode_store.app import create_app as create_store
from services.episode_store.settings import EpisodeStoreSettings

UPSTREAM = "key-of-the-dashboard"
ADA = {"name": "ada", "key": "ada-key-of-some-length", "scopes": ("operate", "enrol")}
KIM = {"name": "kim", "key": "kim-key-of-some-length", "scopes": ("operate",)}


@pytest.fixture
def store_url(serve, tmp_path):
    key = {"name": "dashboard", "key": UPSTREAM, "scopes": ("store_read", "enrol")}
    folder = str(tmp_path / "store")
    return serve(create_store(EpisodeStoreSettings(store_url=folder, api_keys=(key,))))


@pytest.fixture
def sign_in(serve, store_url, page, tmp_path):
    """The page System for someone who signed in."""
    settings = {"api_keys": (ADA, KIM), "audit_folder": tmp_path / "audit", "station": "desk"}
    settings |= {"episode_store_url": store_url, "upstream_key": UPSTREAM}
    address = serve(create_dashboard(DashboardSettings.model_validate(settings)))

    def enter(key):
        page.goto(f"{address}/system")
        page.locator("[name=key]").fill(key["key"])
        page.keyboard.press("Enter")
        expect(page.get_by_role("button", name="Enrol a station")).to_be_enabled()

    return enter


def ask_for_a_token(page, station):
    page.get_by_role("button", name="Enrol a station").click()
    page.get_by_label("Station", exact=True).fill(station)
    page.get_by_role("button", name="Get a token").click()


@pytest.mark.slow
def test_a_station_is_enrolled_and_revoked(page, sign_in, store_url, tmp_path):
    problems = []
    page.on("pageerror", lambda error: problems.append(str(error)))
    sign_in(ADA)
    expect(page.locator("#no_stations")).to_have_text("No station is enrolled.")
    ask_for_a_token(page, "desk_7")
    command = page.locator("#enrol_command")
    shown = re.compile(rf"^dextouch station enrol {re.escape(store_url)} [\w-]{{43}}$")
    expect(command).to_have_text(shown)
    words = command.text_content().split()[1:]
    row = page.locator("[data-station=desk_7]")
    expect(row).to_contain_text("waiting")
    assert main([*words, "--output", str(tmp_path / "enrolment.json")]) == 0
    expect(row).to_contain_text("enrolled")
    expect(row).to_contain_text("127.0.0.1")
    # The token is of no more use, and gone.
    expect(page.locator("#stations_note")).to_have_text("desk_7 is enrolled.")
    expect(page.locator("#enrol_shown")).to_be_hidden()
    assert words[-1] not in page.content()
    ask_for_a_token(page, "desk_7")
    expect(page.locator("#stations_note")).to_contain_text("revoke it")
    row.get_by_role("button", name="Revoke").click()
    row.get_by_role("button", name="Revoke now").click()
    expect(row).to_contain_text("revoked")
    audit = page.locator("#audit_rows")
    for action in ("enrol station", "use enrolment token", "revoke station"):
        expect(audit.locator("tr").filter(has_text=action).first).to_contain_text("desk_7")
    assert problems == []


def test_operators_see_the_stations_but_enrol_none(page, sign_in, store_url):
    sign_in(KIM)
    ask_for_a_token(page, "desk_7")
    note = page.locator("#stations_note")
    expect(note).to_have_text(re.compile("key 'kim' lacks the scope 'enrol'"))
    listed = httpx.get(
        f"{store_url}/v1/enrolments", headers={"authorization": f"Bearer {UPSTREAM}"}
    )
    assert listed.json()["enrolments"] == []
