"""The station page of somebody who records all day: its first screen, causes, keys and faults."""

import pytest
from playwright.sync_api import expect

from services.dashboard.app import create_app as create_dashboard
from services.dashboard.settings import DashboardSettings
from tests.browser.fake_station import FOLLOWING, TAKE, FakeStation

NEUTRAL = "rgba(0, 0, 0, 0)"
# The light theme's.
WARNING = "rgb(125, 83, 0)"
OVERLOADED = {
    "code": "host",
    "subject": "",
    "level": "ERROR",
    "message": "This computer is overloaded: its threads wake 180 ms late",
    "advice": "Close other programs.",
    "lasted_s": 9.0,
    "streams": ["tactile_left", "head", "camera_head"],
}


@pytest.fixture
def station():
    return FakeStation()


@pytest.fixture
def opened(open_page, serve, station):
    """The station's page at 1366 x 768."""
    page = open_page(viewport={"width": 1366, "height": 768}, color_scheme="light")
    settings = DashboardSettings(acquisition_url=serve(station.app), live_timeout_s=10)
    page.goto(serve(create_dashboard(settings)))
    expect(page.locator("#recorder_state")).to_have_text(station.state)
    return page


# Boxes of the pictures, at a moment at which all of them are there.
PICTURES = """(state) => {
  const all = (selector) => [...document.querySelectorAll(selector)];
  const images = all("#camera_row img");
  const isThere = document.getElementById("recorder_state").textContent === state
    && images.length === 3 && images.every((one) => one.complete && one.naturalWidth > 0)
    && ["left", "right"].every((side) =>
      document.getElementById(`hand_${side}_text`).textContent.includes("contact"));
  const boxes = (nodes) => nodes.map((node) => node.getBoundingClientRect().toJSON());
  return isThere && {
    pictures: boxes([...images, ...all(".hand"), ...all("#pose_canvas")]),
    fields: boxes(all("#prompt > label").filter((one) => one.checkVisibility())),
    follow: all("#hand_left_follow").map((one) => getComputedStyle(one).color + one.textContent),
    who: document.getElementById("count_of").textContent,
  };
}"""


@pytest.mark.parametrize("state", ["armed", "recording"])
def test_what_is_recorded_fills_the_first_screen(station, opened, state):
    station.state = state
    shown = opened.wait_for_function(PICTURES, arg=state, timeout=120_000).json_value()
    assert len(shown["pictures"]) == 6
    for place in shown["pictures"]:
        assert place["bottom"] <= 768, place
        assert place["width"] > 90, place
    # Of the first screen, they have the larger part.
    assert min(place["top"] for place in shown["pictures"]) < 384
    assert max(place["bottom"] for place in shown["fields"]) < min(
        place["top"] for place in shown["pictures"]
    )
    middles = [(place["top"] + place["bottom"]) / 2 for place in shown["fields"]]
    assert max(middles) - min(middles) < 8
    # That the robot cannot follow is said in the colour of a warning.
    assert shown["follow"] == [f"{WARNING}{FOLLOWING['message']}"]
    assert "p07, consent given" in shown["who"]


def test_one_cause_is_shown_once(station, opened):
    page, station.causes = opened, [OVERLOADED]
    links = page.locator("#device_rows a.level")
    expect(links).to_have_text(["cause 1"] * 3)
    expect(page.locator("#device_rows span.level")).to_have_count(7)
    grounds = "rows => rows.map((row) => getComputedStyle(row.cells[1]).backgroundColor)"
    assert set(page.locator("#device_rows tr.explained").evaluate_all(grounds)) == {NEUTRAL}
    links.first.click()
    expect(page.locator(".cause:target")).to_contain_text(OVERLOADED["message"])
    station.state = "checking"
    page.locator("#recorder_problems summary").click()
    expect(page.locator("#recorder_note")).to_have_text(f"{TAKE} · 6 findings")
    expect(page.locator("#recorder_problem_list li").first).to_have_text(
        "tactile_left: 0.6 s without a sample · 55.1 Hz"
    )
    expect(page.locator("#recorder_problem_list li")).to_have_count(3)


def test_who_is_recorded_is_asked_once_a_session(station, opened):
    page, station.needs_consent = opened, True
    expect(page.locator("#operator[required]")).to_have_count(1)
    page.keyboard.press("a")
    expect(page.locator("#operator")).to_be_focused()
    page.keyboard.type("p07")
    page.keyboard.press("Enter")
    expect(page.locator("#consent")).to_be_focused()
    assert station.asked == []
    page.keyboard.press("Space")
    page.keyboard.press("a")
    page.wait_for_function("() => document.activeElement === document.body")
    page.reload()
    expect(page.locator("#operator")).to_have_value("p07")
    expect(page.locator("#consent")).to_be_checked()
    assert [(action, body["consent"]) for action, body in station.asked] == [("arm", True)]
    # Twice within three seconds; a busy machine may take longer.
    for _ in range(20):
        page.keyboard.press("w")
        page.wait_for_timeout(400)
        if page.locator("#operator").input_value() == "":
            break
    assert ("session", {}) in station.asked
    expect(page.locator("#operator")).to_have_value("")
    expect(page.locator("#consent")).not_to_be_checked()


def test_every_field_has_a_key(opened):
    page = opened
    fields = {"t": "task_choice", "i": "instruction_choice", "h": "domain", "c": "consent"}
    for key, field in fields.items() | {"e": "arm_again", "l": "follow_sound"}.items():
        page.keyboard.press(key)
        expect(page.locator(f"#{field}")).to_be_focused()
    page.keyboard.press("m")
    expect(page.locator("#sounds")).to_have_text("Sounds: on")
    page.keyboard.press("o")
    page.keyboard.type("tom")
    expect(page.locator("#operator")).to_have_value("tom")


def test_the_last_take_leads_to_its_player(opened):
    link = opened.locator("#last_take a")
    expect(link).to_have_text(TAKE)
    expect(link).to_have_attribute("href", f"/episodes/recording/{TAKE}")


def test_faults_are_tried_on_simulated_devices_alone(station, opened):
    page = opened
    expect(page.locator("#faults button")).to_have_text(
        ["Unplug", "Drift", "Dead taxel", "Slow host"]
    )
    page.keyboard.press("f")
    expect(page.get_by_role("button", name="Unplug", pressed=True)).to_be_visible()
    assert station.faults == ["unplug"]
    page.get_by_role("button", name="Slow host").click()
    expect(page.locator("#faults [aria-pressed=true]")).to_have_count(2)
    page.keyboard.press("f")
    expect(page.locator("#faults [aria-pressed=true]")).to_have_text(["Slow host"])
    station.faults = None
    expect(page.locator("#faults")).to_be_hidden()
    asked = []
    page.on("request", lambda request: asked.append(request.url))
    page.keyboard.press("f")
    page.wait_for_timeout(300)
    assert not [url for url in asked if "faults" in url]


def test_an_enlarged_panel_is_large_where_something_is_armed(station, opened):
    page, station.state = opened, "armed"
    expect(page.locator("#recorder_state")).to_have_text("armed")
    poses = page.locator("#poses")
    small = poses.bounding_box()["width"]
    poses.hover()
    page.get_by_role("button", name="Enlarge Hands in space").click()
    large = poses.bounding_box()
    assert large["width"] > 2 * small
    assert page.locator("#pose_canvas").bounding_box()["height"] > 450
    page.get_by_role("button", name="Enlarge Hands in space").click()
    assert poses.bounding_box()["width"] == small
    # Without cameras, whoever hid them, the others have their place.
    page.locator("#cameras").hover()
    page.get_by_role("button", name="Hide Cameras").click()
    assert poses.bounding_box()["width"] > 1.5 * small
    expect(page.locator(".panels_away")).to_have_text("Hidden panels: Cameras")
    # What the page hides itself is not listed.
    page.evaluate("document.getElementById('cameras').hidden = true")
    expect(page.locator(".panels_away")).to_be_hidden()
