"""An operator's takes on a station that runs as a real process: signed in, by keys alone, from
arming to review and hours, and the player's samples against a plain Zarr reader."""

import json
import sys
import time
from urllib.parse import urlsplit

import pytest
from playwright.sync_api import expect

from services.alignment.retargeting import hand_retargeter
from tests.browser.walking import aligned_row, check_moments, go, play, state, up, wait_for_clock

pytestmark = pytest.mark.system

KEY = "a-key-of-some-length"
OPERATOR = {"name": "desk", "key": KEY, "scopes": ["operate"]}
ANY_PORTS = [
    word
    for name in ("dashboard", "episode-store", "alignment", "acquisition")
    for word in (f"--{name}-port", "0")
]


@pytest.fixture
def station(tmp_path):
    """The dashboard's address. The solver is compiled here, before a worker has to do it."""
    hand_retargeter.warm_up()
    keys = {"DEXTOUCH_DASHBOARD_API_KEYS": json.dumps([OPERATOR])}
    with up(tmp_path, "--without", "twin,world_model,studies", *ANY_PORTS, **keys) as urls:
        yield urls["dashboard"]


@pytest.fixture
def watched(open_page, station):
    """A page whose console and requests are judged when the test ends."""
    faults, hosts = [], set()
    page = open_page(viewport={"width": 1366, "height": 768})
    # Reading the canvases often, which only tests do, makes Chromium advise against it.
    page.on("console", lambda said: None if "readback" in said.text else faults.append(said.text))
    page.on("pageerror", lambda error: faults.append(str(error)))
    page.on("request", lambda request: hosts.add(urlsplit(request.url).netloc))
    yield page
    assert not faults
    assert hosts == {urlsplit(station).netloc}


def press(page, key, until):
    """Press a key of the recorder; once more where it asks whether it is meant."""
    asks = page.locator("#recorder_message").filter(has_text="Once more within three seconds")
    page.keyboard.press(key)
    expect(state(page).filter(has_text=until).or_(asks)).not_to_have_count(0)
    if state(page).text_content() != until:
        page.keyboard.press(key)
    expect(state(page)).to_have_text(until)


def record(page, *, num_seconds):
    """Record a take that is armed; it ends without an outcome."""
    press(page, "r", "recording")
    wait_for_clock(page, num_seconds)
    press(page, "s", "checking")
    expect(page.locator("input[name=outcome]:checked")).to_have_count(0)
    return page.locator("#recorder_note").text_content().split(" · ")[0]


def tab_to(page, selector):
    for _ in range(60):
        page.keyboard.press("Tab")
        if page.evaluate("(selector) => document.activeElement.matches(selector)", selector):
            return
    raise AssertionError(f"Tab does not reach {selector}")


def sign_in(page, address):
    page.goto(address)
    # Chromium moves the focus there a moment after the page is loaded.
    expect(page.get_by_label("Key")).to_be_focused()
    page.keyboard.type(KEY)
    page.keyboard.press("Enter")
    expect(state(page)).to_have_text("idle")


def save_a_take(page):
    tab_to(page, "#operator")
    page.keyboard.type("p7")
    tab_to(page, "#consent")
    page.keyboard.press("Space")
    page.keyboard.press("Escape")
    press(page, "a", "armed")
    take = record(page, num_seconds=4)
    page.keyboard.press("u")
    press(page, "v", "saved")
    return take


def play_from_its_row(page, take):
    """Open an aligned take by keys; the id of its episode, and how long after saving it plays."""
    saved_s = time.monotonic()
    go(page, "Episodes")
    aligned_row(page, take)
    page.keyboard.press("ArrowDown")
    page.keyboard.press("Enter")
    episode_id = play(page)
    assert episode_id.startswith(take)
    sys.stdout.write(f"played {time.monotonic() - saved_s:.1f} s after it was saved\n")
    return episode_id


def discard_takes(page):
    go(page, "Station")
    expect(state(page)).to_have_text("saved")
    press(page, "a", "armed")
    discarded = record(page, num_seconds=1)
    page.keyboard.press("y")
    press(page, "d", "discarded")
    press(page, "a", "armed")
    again = record(page, num_seconds=1)
    page.keyboard.press("n")
    press(page, "g", "armed")
    last = record(page, num_seconds=1)
    press(page, "d", "discarded")
    return {discarded, again, last}


def reject(page, take):
    go(page, "Review")
    expect(page.locator("#rows .item_name")).to_have_text([take])
    page.keyboard.press("r")
    page.keyboard.press("4")
    page.keyboard.press("Enter")
    expect(page.locator("#empty")).to_be_visible()


@pytest.mark.slow
def test_takes_of_an_operator(watched, station, tmp_path):
    page = watched
    sign_in(page, station)
    take = save_a_take(page)
    episode_id = play_from_its_row(page, take)
    check_moments(page, tmp_path / "data/store", episode_id, (0.1, 0.5, 0.95))

    discarded = discard_takes(page)
    assert len(discarded) == 3
    assert not discarded & {path.name for path in (tmp_path / "data/spool").iterdir()}

    reject(page, take)
    go(page, "Hours")
    # Four seconds are 0.1 min.
    row = page.locator("#operator_rows tr").filter(has_text="p7")
    assert row.locator("td").nth(3).text_content() == "0.1 min"
    assert row.locator("td").nth(5).text_content() == "1"

    page.get_by_role("button", name="Sign out").click()
    expect(page.get_by_label("Key", exact=True)).to_be_visible()
    page.goto(f"{station}/episodes")
    expect(page.get_by_label("Key", exact=True)).to_be_visible()
