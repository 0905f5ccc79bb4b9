"""An operator signs in to a dashboard with keys, in a real browser."""

import re

import pytest
from playwright.sync_api import expect

from services.dashboard.app import create_app
from services.dashboard.settings import DashboardSettings

KEY = "a-key-of-some-length"
OPERATOR = {"name": "operator", "key": KEY, "scopes": ("operate",)}
READER = {"name": "reader", "key": "another-key-of-length", "scopes": ("station",)}


@pytest.fixture
def app():
    return create_app(DashboardSettings(station="desk 3", api_keys=(OPERATOR, READER)))


@pytest.fixture
def address(serve, app):
    return serve(app)


def sign_in(page, key):
    page.get_by_label("Key", exact=True).fill(key)
    page.get_by_role("button", name="Sign in").click()


def test_the_right_key_opens_the_page(page, address):
    page.goto(address)
    sign_in(page, KEY)
    expect(page.get_by_role("heading", name="Recorder")).to_be_visible()
    # Its data and its live link come by the session's cookie.
    expect(page.locator("#link")).to_have_text("live")
    page.reload()
    expect(page.get_by_role("heading", name="Recorder")).to_be_visible()


@pytest.mark.parametrize(
    ("key", "reason"),
    [("a-key-that-nobody-has", "unknown key"), (READER["key"], "lacks the scope 'operate'")],
)
def test_a_wrong_key_is_refused_on_the_page(page, address, key, reason):
    page.goto(address)
    sign_in(page, key)
    expect(page.get_by_role("alert")).to_contain_text(reason)
    sign_in(page, KEY)
    expect(page.get_by_role("heading", name="Recorder")).to_be_visible()


def test_a_name_that_is_not_served_is_refused_in_words(page, address):
    page.goto(re.sub("127.0.0.1", "desk.localhost", address))
    expect(page.get_by_role("alert")).to_contain_text("allowed_hosts")
    expect(page.get_by_role("button", name="Sign in")).to_be_hidden()


def test_signing_out_ends_the_session(page, address):
    page.goto(address)
    sign_in(page, KEY)
    page.get_by_role("button", name="Sign out").click()
    expect(page.get_by_label("Key", exact=True)).to_be_visible()
    page.goto(address)
    expect(page.get_by_label("Key", exact=True)).to_be_visible()


@pytest.mark.slow
def test_other_pages_of_a_browser_that_signs_out_go_to_the_sign_in(page, address):
    page.goto(address)
    sign_in(page, KEY)
    expect(page.locator("#link")).to_have_text("live")
    other = page.context.new_page()
    other.goto(address)
    other.get_by_role("button", name="Sign out").click()
    expect(page.get_by_label("Key", exact=True)).to_be_visible()


@pytest.mark.slow
def test_a_page_that_lost_session_and_link_goes_to_the_sign_in(page, address, app):
    """As after a restart: the link breaks, and the new one is refused for a reason no page sees."""
    links = []

    def connect(link):
        link.connect_to_server()
        links.append(link)

    page.route_web_socket("**/v1/live", connect)
    page.goto(address)
    sign_in(page, KEY)
    expect(page.locator("#link")).to_have_text("live")
    app.state.sessions._open.clear()
    links[-1].close(code=1001)
    expect(page.get_by_label("Key", exact=True)).to_be_visible()


@pytest.mark.slow
def test_a_button_of_a_session_that_ended_goes_to_the_sign_in(page, serve, serve_station, tmp_path):
    station = serve_station(tmp_path / "spool")
    app = create_app(DashboardSettings(api_keys=(OPERATOR,), acquisition_url=station))
    # The page hears nothing of the end of its link.
    page.route_web_socket(
        "**/v1/live", lambda link: link.connect_to_server().on_close(lambda code, reason: None)
    )
    page.goto(serve(app))
    sign_in(page, KEY)
    expect(page.locator("#recorder_state")).to_have_text("idle")
    page.locator("#operator").fill("p7")
    app.state.sessions._open.clear()
    page.get_by_role("button", name="Arm").click()
    expect(page.get_by_label("Key", exact=True)).to_be_visible()


def test_a_password_manager_finds_its_fields(page, address):
    page.goto(address)
    inputs = page.locator("form input:not([type=hidden])")
    fields = inputs.evaluate_all("inputs => inputs.map(i => i.autocomplete)")
    assert fields == ["username", "current-password"]


def test_without_keys_there_is_no_sign_out(page, serve):
    page.goto(serve(create_app(DashboardSettings())))
    expect(page.locator("#link")).to_have_text("live")
    expect(page.get_by_role("button", name="Sign out")).to_have_count(0)
