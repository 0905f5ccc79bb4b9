"""What a newcomer does to practise calibration: only what the page Calibration says, to the end."""

import re

import pytest
from playwright.sync_api import expect

from tests.browser.walking import go, up

pytestmark = [pytest.mark.slow, pytest.mark.system]

LONG_MS = 300_000
DONE = re.compile("done|failed|cancelled")


def guided(page, title):
    """Begin the guided run of a row, as it is offered."""
    row = page.locator("#item_rows tr").filter(has_text=title)
    row.get_by_role("button", name="Guided run").click()
    page.get_by_role("button", name="Begin", exact=True).click()
    # Until then the hidden panel still has the state of the run before.
    expect(page.locator("#begin")).to_be_hidden()
    return row


def finish(page, row):
    expect(page.locator("#run_state")).to_have_text(DONE, timeout=LONG_MS)
    assert page.locator("#run_state").text_content() == "done", page.locator("#run").text_content()
    if row is not None:
        expect(row).to_contain_text("good")
    page.get_by_role("button", name="Close").click()


def record_until_measured(page):
    """Shake again as often as the page asks for it: a busy computer delays packets."""
    for words in ("Record 10 s", *["Record 10 s again"] * 4):
        page.get_by_role("button", name=words, exact=True).click()
        expect(page.get_by_role("button", name="Record 10 s")).to_have_count(0)
        expect(page.locator("#run_state")).not_to_have_text("running", timeout=LONG_MS)
        if page.locator("#run_state").text_content() != "asking":
            return


def test_a_newcomer_calibrates_the_practice_station(page, tmp_path):
    page.set_viewport_size({"width": 1366, "height": 768})
    with up(tmp_path, "--without", "twin,world_model,studies") as urls:
        page.goto(urls["dashboard"])
        go(page, "Calibration")
        expect(page.locator("#item_rows tr")).not_to_have_count(0)
        expect(page.locator("#item_rows")).not_to_contain_text("missing")
        page.get_by_role("button", name="Start practice devices").click()
        expect(page.locator("#practice_stop")).to_be_visible(timeout=LONG_MS)
        for title in ("Camera head: lens", "Camera head on its tracker"):
            finish(page, guided(page, title))
        zero = guided(page, "Glove left: zero")
        page.get_by_role("button", name="Record 10 s").click()
        page.get_by_role("button", name="No more pressures").click(timeout=LONG_MS)
        finish(page, zero)
        guided(page, "Path delays")
        record_until_measured(page)
        finish(page, None)
        for stream in ("wrist left", "wrist right"):
            row = page.locator("#item_rows tr").filter(has_text=f"Latency of {stream}")
            expect(row).to_contain_text("good")
