"""The player on small screens, names of actions, worst seconds, and panels that stay as left."""

import importlib.util
from pathlib import Path

import numpy as np
import pytest
from playwright.sync_api import expect

from dextouch.episodes import EpisodeStore
from services.dashboard.app import create_app as create_dashboard
from services.dashboard.settings import DashboardSettings
from services.episode_store.app import create_app as create_store
from services.episode_store.settings import EpisodeStoreSettings
from tests.browser.walking import SETTLED

_SPEC = importlib.util.spec_from_file_location(
    "played_items", Path(__file__).with_name("played_items.py")
)
items = importlib.util.module_from_spec(_SPEC)
_SPEC.loader.exec_module(items)
KEYS = {"a": "the-key-of-one-person", "b": "the-key-of-another"}
QUALITY = {
    "origin_after_start_ns": 250_000_007.0,
    "camera_head_num_gaps": 1.0,
    "wrist_left_peak_speed_m_s": 0.21,
    "retargeting_left_tip_error_p95_mm": 4.25,
    "static_share": 0.5,
}


@pytest.fixture(scope="module")
def played(tmp_path_factory):
    folder = tmp_path_factory.mktemp("store")
    return folder, items.write_episode(EpisodeStore(folder), quality=QUALITY)


@pytest.fixture
def serve_people(serve, played):
    """A dashboard of two stations, and the keys of two people."""
    store = serve(create_store(EpisodeStoreSettings(store_url=str(played[0]))))
    keys = [{"name": name, "key": KEYS[name], "scopes": ("operate",)} for name in KEYS]
    stations = dict.fromkeys(("desk_1", "desk_2"), "http://127.0.0.1:9")
    settings = DashboardSettings(episode_store_url=store, api_keys=keys, stations=stations)
    return serve(create_dashboard(settings))


@pytest.fixture
def address(serve, played):
    store = serve(create_store(EpisodeStoreSettings(store_url=str(played[0]))))
    return serve(create_dashboard(DashboardSettings(episode_store_url=store)))


def opened(page, address, query=""):
    page.goto(f"{address}/episodes/episode/episode-1{query}")
    page.wait_for_function(SETTLED)


@pytest.mark.slow
def test_the_timeline_is_one_line_on_small_screens(open_page, address):
    page = open_page(viewport={"width": 1366, "height": 768})
    opened(page, address)
    lanes = page.locator("#timeline .lanes .lane:visible")
    expect(lanes).to_have_count(1)
    # All marks of the streams are on the one line: two cameras' and a wrist's gap.
    expect(lanes).to_contain_text("streams")
    assert lanes.locator(".gap").count() == page.locator(".lane:not([data-stream='']) .gap").count()
    page.get_by_role("button", name="Streams").click()
    expect(lanes).to_have_count(11)
    page.reload()
    page.wait_for_function(SETTLED)
    expect(lanes).to_have_count(11)


@pytest.mark.slow
def test_actions_have_names_and_units(page, address):
    opened(page, address)
    expect(page.locator(".plot[data-signal='action.9'] .name")).to_have_text(
        "action: wrist right x"
    )
    expect(page.locator(".plot[data-signal='action.9'] .plot_note")).to_have_text("m")
    page.locator("#signal_stream").select_option("action")
    page.locator("#signal_value").fill("left thumb mcp")
    page.get_by_role("button", name="Plot").click()
    expect(page.locator(".plot[data-signal='action.20'] .plot_note")).to_have_text("rad")
    bars = page.locator(".action_view")
    width = bars.bounding_box()["width"]
    bars.hover(position={"x": 20.5 / 67 * width, "y": 60})
    expect(page.locator("#action .readout")).to_contain_text("left thumb mcp: ")


def selected(page):
    text = page.locator("#selection").text_content()
    return [float(part) for part in text.removesuffix(" s").split(" \N{EN DASH} ")]


def gone_to(page, facts, figure):
    """The selection that the worst second of a figure makes."""
    before = page.locator("#selection").text_content()
    facts.get_by_role("button", name=f"worst second of {figure}").click()
    expect(page.locator("#selection")).not_to_have_text(before)
    return selected(page)


@pytest.mark.slow
def test_figures_lead_to_their_worst_second(page, address, played):
    _, streams = played
    opened(page, address)
    facts = page.locator("#facts")
    expect(facts).to_contain_text("Retargeting: 1 figure")
    expect(facts).to_contain_text("left tip error, 95th percentile")
    facts.get_by_role("button", name="worst second of camera head: gaps").click()
    stamps = streams["camera_head"].t_ns / 1e9
    first = int(np.argmax(np.diff(stamps)))
    expect(page.locator("#selection")).not_to_have_text("nothing selected")
    assert np.allclose(selected(page), stamps[first : first + 2], atol=1e-3)
    expect(page.locator("#clock")).to_have_attribute("title", f"{stamps[first]:.9f} s")
    # The wrist's x is 0.2 sin t: it is fastest where t is a multiple of pi.
    start_s, stop_s = gone_to(page, facts, "wrist left peak speed")
    assert any(start_s - 0.1 <= k * np.pi <= stop_s + 0.1 for k in range(7))
    start_s, stop_s = gone_to(page, facts, "left tip error, 95th percentile")
    assert stop_s - start_s == pytest.approx(1.0)
    expect(facts.get_by_role("button", name="worst second of static share")).to_have_count(0)


def sign_in(page, address, name):
    page.goto(address)
    page.get_by_label("Key", exact=True).fill(KEYS[name])
    page.keyboard.press("Enter")
    expect(page.get_by_role("button", name="Sign out")).to_be_visible()


@pytest.mark.slow
def test_panels_stay_as_each_person_left_them_at_each_station(page, serve_people):
    address = serve_people
    sign_in(page, address, "a")
    opened(page, address, "?station=desk_2")
    page.get_by_role("region", name="Action").hover()
    page.get_by_role("button", name="Hide Action").click()
    expect(page.get_by_role("region", name="Action")).to_be_hidden()
    page.get_by_role("region", name="Cameras").hover()
    page.get_by_role("button", name="Enlarge Cameras").click()
    page.reload()
    page.wait_for_function(SETTLED)
    expect(page.get_by_role("region", name="Action")).to_be_hidden()
    width = page.locator("#player").bounding_box()["width"]
    assert page.locator("#cameras").bounding_box()["width"] == pytest.approx(width, abs=2)
    # Another station and another person have their own.
    opened(page, address)
    expect(page.get_by_role("region", name="Action")).to_be_visible()
    page.get_by_role("button", name="Sign out").click()
    sign_in(page, address, "b")
    opened(page, address, "?station=desk_2")
    expect(page.get_by_role("region", name="Action")).to_be_visible()
    page.get_by_role("button", name="Sign out").click()
    sign_in(page, address, "a")
    opened(page, address, "?station=desk_2")
    page.get_by_role("button", name="Show Action").click()
    expect(page.get_by_role("region", name="Action")).to_be_visible()
