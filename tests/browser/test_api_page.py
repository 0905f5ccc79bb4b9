"""The page of a service's OpenAPI document in Chromium: whole, offline, within its policy."""

import pytest
from playwright.sync_api import expect

from dextouch.serving.keys import ApiKey
from dextouch.worlds import WorldServiceSettings, create_world_app
from services.dashboard.app import create_app as create_dashboard
from services.dashboard.settings import DashboardSettings
from tests.unit.worlds.fakes import SumWorld

KEY = ApiKey(name="policy", key="a-key-of-some-length", scopes=("rollout",))


@pytest.fixture
def told(open_page):
    """A page, what its console says, and the addresses that it asks."""
    page, said, asked = open_page(), [], []
    page.on("console", lambda message: said.append(message.text))
    page.on("pageerror", lambda error: said.append(str(error)))
    page.on("request", lambda request: asked.append(request.url))
    return page, said, asked


def test_it_shows_every_operation_and_sends_one(serve, told):
    app = create_world_app({"sum": SumWorld()}, WorldServiceSettings(api_keys=(KEY,)))
    url, (page, said, asked) = serve(app), told
    page.goto(f"{url}/docs")
    operations = page.locator(".opblock")
    num_documented = sum(len(methods) for methods in app.openapi()["paths"].values())
    expect(operations).to_have_count(num_documented)
    expect(page).to_have_title("worlds: API")
    page.locator(".opblock", has_text="send_chunk").first.locator(".opblock-summary").click()
    expect(page.get_by_text("Advance by the numbered action chunk")).to_be_visible()
    expect(
        page.locator("#operations-rollouts-send_chunk").get_by_text("Unprocessable")
    ).to_be_visible()
    # A request of the page, with the key that a person enters.
    page.get_by_role("button", name="Authorize").first.click()
    page.locator(".auth-container input").fill(KEY.key.get_secret_value())
    page.locator(".auth-btn-wrapper .authorize").click()
    page.get_by_role("button", name="Close").click()
    worlds = page.locator("#operations-rollouts-list_worlds")
    worlds.locator(".opblock-summary").click()
    worlds.get_by_role("button", name="Try it out").click()
    worlds.get_by_role("button", name="Execute").click()
    expect(worlds.locator(".live-responses-table")).to_contain_text('"name": "sum"')
    assert not said
    assert all(one.startswith((url, "data:")) for one in asked)


def test_the_system_page_leads_there(serve, told, tmp_path):
    page, said, _ = told
    url = serve(create_dashboard(DashboardSettings(audit_folder=tmp_path), {}))
    page.goto(f"{url}/system")
    page.get_by_role("link", name="HTTP interface").click()
    expect(page.locator("#operations-system-get_system")).to_be_visible()
    # The system page tells of services that are not there.
    assert not any("Content Security Policy" in one for one in said)
