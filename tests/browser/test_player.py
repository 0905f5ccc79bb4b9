"""The player shows, at any moment, the samples of that moment: read off its canvases and compared
with the arrays that were written."""

import importlib.util
import re
from pathlib import Path
from urllib.parse import urlsplit

import numpy as np
import pytest
from playwright.sync_api import expect

from dextouch.episodes import EpisodeStore
from services.dashboard.app import create_app as create_dashboard
from services.dashboard.settings import DashboardSettings
from services.episode_store.app import create_app as create_store
from services.episode_store.settings import EpisodeStoreSettings

# importlib mode has no test packages: load the items beside this file by path.
_SPEC = importlib.util.spec_from_file_location(
    "played_items", Path(__file__).with_name("played_items.py")
)
items = importlib.util.module_from_spec(_SPEC)
_SPEC.loader.exec_module(items)

RATES_HZ = {
    "camera_head": 30,
    "camera_wrist_left": 25,
    "camera_wrist_right": 30,
    "tactile_left": 60,
    "tactile_right": 60,
    "wrist_left": 100,
    "wrist_right": 100,
    "keypoints_left": 120,
    "action": 15,
}
CAMERAS = [name for name in RATES_HZ if name.startswith("camera")]
# What a page shows: state and stamp of every pane, and the index that its picture encodes.
READ = Path(__file__).with_name("read_player.js").read_text(encoding="utf-8")
SETTLED = """() => document.getElementById("clock").title && !document.querySelector(
  "#player [data-state=loading]:not([hidden]):not([hidden] *)")"""


@pytest.fixture(scope="module")
def played(tmp_path_factory):
    folder = tmp_path_factory.mktemp("store")
    store = EpisodeStore(folder)
    streams = items.write_episode(store)
    raw = items.write_recording(store)
    items.write_episode(store, "no-cameras", cameras=False)
    refused = [float(taxel in (7, 200)) for taxel in range(320)]
    items.write_episode(
        store,
        "one-hand",
        sides=("left",),
        instruction=items.HOSTILE,
        absent=("wrist_right", "keypoints_right"),
        calibration={
            "interpolated_fingers_left_s": [[2.0, 4.0, 3.0]],
            "tactile_left_refused_taxels": [refused],
        },
    )
    return folder, streams, raw


@pytest.fixture
def address(serve, played):
    folder, _, _ = played
    store = serve(create_store(EpisodeStoreSettings(store_url=str(folder))))
    return serve(create_dashboard(DashboardSettings(episode_store_url=store)))


@pytest.fixture
def watched(open_page, address):
    """A page whose requests and console are watched; both are judged when the test ends."""
    faults, hosts = [], set()
    page = open_page(viewport={"width": 1366, "height": 1400}, color_scheme="light")
    # Reading the canvases often, which only this test does, makes Chromium advise against it.
    page.on("console", lambda said: None if "readback" in said.text else faults.append(said.text))
    page.on("pageerror", lambda error: faults.append(str(error)))
    page.on("request", lambda request: hosts.add(urlsplit(request.url).netloc))
    yield page
    assert not faults
    assert hosts == {urlsplit(address).netloc}


def opened(page, url):
    page.goto(url)
    page.wait_for_function(SETTLED)
    return page.evaluate(READ)


def until(page, condition):
    page.wait_for_function(f"() => {condition}")


def until_clock(page, condition):
    until(page, f"parseFloat(document.getElementById('clock').title) {condition}")


def nanoseconds(text):
    whole, _, part = text.removesuffix(" s").partition(".")
    return int(whole) * 10**9 + int(part.ljust(9, "0"))


def expected_index(stamps, t_ns, rate_hz):
    """The last sample at or before a time, unless it is older than one and a half periods."""
    index = int(np.count_nonzero(stamps <= t_ns)) - 1
    if index < 0 or t_ns - int(stamps[index]) > 1.5e9 / rate_hz:
        return None
    return index


def check(shown, streams, *, zero_ns=0):
    t_ns = zero_ns + nanoseconds(shown["clock"])
    for name, rate_hz in RATES_HZ.items():
        if name not in streams or name not in shown["panes"]:
            continue
        pane, stamps = shown["panes"][name], streams[name].t_ns
        index = expected_index(stamps, t_ns, rate_hz)
        where = f"{name} at {t_ns}"
        if index is None:
            assert (pane["state"], pane["stamp"]) == ("none", None), where
            assert not pane.get("seen"), where
        else:
            assert (pane["state"], pane["stamp"]) == ("shown", str(stamps[index])), where
            if "bits" in pane:
                assert items.index_of(pane["bits"]) == index, where
    return t_ns


def click_timeline(page, share):
    before = page.locator("#clock").get_attribute("title")
    box = page.locator("#timeline .over").bounding_box()
    page.mouse.click(box["x"] + share * box["width"], box["y"] + 6)
    until(page, f"document.getElementById('clock').title !== '{before}'")
    page.wait_for_function(SETTLED)
    return page.evaluate(READ)


def test_ten_random_moments_are_those_that_were_written(watched, address, played):
    _, streams, _ = played
    rng = np.random.default_rng(2026)
    shown = opened(watched, f"{address}/episodes/episode/episode-1")
    times_ns = [check(click_timeline(watched, share), streams) for share in rng.random(10)]
    assert len(set(times_ns)) == 10
    assert {name for name in RATES_HZ if name not in shown["panes"]} == set()
    # Moments in links, to the nanosecond: a stamp, the nanosecond before it, and the end of a hold.
    stamps = streams["camera_head"].t_ns
    for t_ns in (int(stamps[200]), int(stamps[200]) - 1, int(stamps[119]) + 50_000_000):
        link = f"{address}/episodes/episode/episode-1?at={t_ns // 10**9}.{t_ns % 10**9:09d}"
        assert check(opened(watched, link), streams) == t_ns


@pytest.mark.slow
def test_a_gap_shows_no_sample_and_is_marked(watched, address, played):
    _, streams, _ = played
    shown = opened(watched, f"{address}/episodes/episode/episode-1?at=5.25")
    check(shown, streams)
    assert shown["panes"]["camera_head"]["state"] == "none"
    assert shown["panes"]["camera_wrist_left"]["state"] == "shown"
    expect(watched.locator("[data-camera=camera_head]")).to_contain_text("no sample")
    lane = watched.locator(".lane[data-stream=camera_head]")
    stamps = streams["camera_head"].t_ns
    first = int(np.argmax(np.diff(stamps)))
    expect(lane.locator(".gap")).to_have_attribute(
        "title",
        re.compile(
            f"from {stamps[first] / 1e9:.9f} to {stamps[first + 1] / 1e9:.9f} s".replace(".", r"\.")
        ),
    )
    # The next image is after the gap, the one before it ahead of the gap.
    watched.keyboard.press("ArrowRight")
    until(
        watched, f"document.querySelector('[data-camera]').dataset.stamp === '{stamps[first + 1]}'"
    )
    watched.keyboard.press("ArrowLeft")
    until(watched, f"document.querySelector('[data-camera]').dataset.stamp === '{stamps[first]}'")


@pytest.mark.slow
def test_recordings_beyond_the_whole_numbers_of_a_browser(watched, address, played):
    _, _, raw = played
    for share in (0.1, 0.77):
        opened(watched, f"{address}/episodes/recording/take-1")
        shown = click_timeline(watched, share)
        t_ns = items.START_HOST_NS + nanoseconds(shown["clock"])
        index = expected_index(raw["camera_head"].t_ns, t_ns, 30)
        pane = shown["panes"]["camera_head"]
        assert pane["stamp"] == str(raw["camera_head"].t_ns[index])
        assert items.index_of(pane["bits"]) == index
        touch = expected_index(raw["tactile_left"].t_ns, t_ns, 60)
        assert shown["panes"]["tactile_left"]["stamp"] == str(raw["tactile_left"].t_ns[touch])
        largest = raw["tactile_left"].values[touch]
        # Cells of the two unused scan rows are no taxels.
        text = watched.locator(".touch_pane").text_content()
        assert int(re.search(r"largest (\d+) counts", text)[1]) == largest[:320].max()


@pytest.mark.slow
def test_scrubbing_never_shows_an_image_with_another_ones_time(watched, address, played):
    _, streams, _ = played
    opened(watched, f"{address}/episodes/episode/episode-1?at=9")
    watched.evaluate(
        f"""() => {{
          const read = {READ};
          window.records = [];
          const note = () => {{
            window.records.push(read());
            if (window.records.length < 400) requestAnimationFrame(note);
          }};
          note();
        }}"""
    )
    box = watched.locator("#timeline .over").bounding_box()
    watched.mouse.move(box["x"] + 0.05 * box["width"], box["y"] + 6)
    watched.mouse.down()
    for share in np.random.default_rng(7).random(40):
        watched.mouse.move(box["x"] + share * box["width"], box["y"] + 6)
    watched.mouse.up()
    watched.wait_for_function(SETTLED)
    records = watched.evaluate("window.records")
    pictures = set()
    for record in records:
        t_ns = nanoseconds(record["clock"])
        for name in (*CAMERAS, "tactile_left", "tactile_right"):
            pane, stamps = record["panes"][name], streams[name].t_ns
            if pane["stamp"] is None:
                continue
            index = int(np.flatnonzero(stamps == int(pane["stamp"]))[0])
            assert items.index_of(pane["bits"]) == index
            pictures.add((name, index))
            if pane["state"] == "shown":
                assert index == expected_index(stamps, t_ns, RATES_HZ[name])
            if "time" in pane:
                assert abs(nanoseconds(pane["time"]) - int(pane["stamp"])) <= 50_000
    assert len(pictures) > 5
    check(watched.evaluate(READ), streams)


@pytest.mark.slow
def test_playing_moves_all_panes_together(watched, address, played):
    _, streams, _ = played
    opened(watched, f"{address}/episodes/episode/episode-1?at=8")
    watched.locator("#speed").select_option("2")
    watched.locator("#speed").blur()
    watched.keyboard.press(" ")
    expect(watched.locator("#play_text")).to_have_text("Pause")
    until_clock(watched, "> 9.5")
    watched.keyboard.press(" ")
    expect(watched.locator("#play_text")).to_have_text("Play")
    watched.wait_for_function(SETTLED)
    check(watched.evaluate(READ), streams)
    watched.keyboard.press("End")
    until_clock(watched, "> 19.9")
    watched.keyboard.press("Home")
    until_clock(watched, "< 0.1")
    watched.keyboard.press("Shift+ArrowRight")
    until_clock(watched, "> 0.9")


@pytest.mark.slow
def test_a_link_shows_the_same_elsewhere(watched, open_page, address, played):
    _, streams, _ = played
    page = watched
    opened(page, f"{address}/episodes/episode/episode-1")
    page.get_by_role("checkbox", name="camera_wrist_left").uncheck()
    page.locator("#signal_stream").select_option("wrist_left")
    page.locator("#signal_value").fill("0")
    page.get_by_role("button", name="Plot").click()
    page.get_by_label("Remove tactile_right").click()
    page.get_by_label("Compare with raw").check()
    click_timeline(page, 0.613)
    page.keyboard.press("+")
    page.keyboard.press("+")
    until(page, "new URLSearchParams(location.search).has('zoom')")
    until(
        page,
        "new URLSearchParams(location.search).get('at') + ' s'"
        " === document.getElementById('clock').title",
    )
    page.wait_for_function(SETTLED)
    other = open_page(viewport={"width": 1000, "height": 900}, color_scheme="light")
    there = opened(other, page.url)
    here = page.evaluate(READ)
    assert there == here
    assert "camera_wrist_left" not in there["panes"]
    check(there, streams)
    for one in (page, other):
        names = one.locator(".plot .name").all_text_contents()
        assert names == [
            "tactile_left",
            "action: wrist left x",
            "action: wrist right x",
            "wrist_left: x",
        ]
        expect(one.locator("#raw_note")).to_contain_text("take-1")
        expect(one.locator(".plot[data-signal=tactile_left]")).to_contain_text("raw counts")
        expect(one.locator(".plot[data-signal='wrist_left.0']")).to_contain_text(
            "not in the recording"
        )
    ranges = [one.locator("#zoom_note").text_content() for one in (page, other)]
    assert ranges[0] == ranges[1] != ""


@pytest.mark.slow
def test_an_item_without_cameras(watched, address, played):
    shown = opened(watched, f"{address}/episodes/episode/no-cameras?at=3")
    assert not any(name.startswith("camera") for name in shown["panes"])
    expect(watched.locator("#cameras")).to_be_hidden()
    assert shown["panes"]["tactile_left"]["state"] == "shown"
    watched.keyboard.press("ArrowRight")
    until_clock(watched, "> 3")


@pytest.mark.slow
def test_one_hand_and_hostile_text(watched, address, played):
    shown = opened(watched, f"{address}/episodes/episode/one-hand?at=3")
    assert "tactile_right" not in shown["panes"]
    assert shown["panes"]["tactile_left"]["state"] == "shown"
    expect(watched.locator("#instruction")).to_contain_text("<script>")
    expect(watched.locator("#facts")).to_contain_text("onerror")
    assert "broken" not in watched.title()
    assert watched.locator("main img").count() == 0


@pytest.mark.slow
def test_what_was_not_measured_is_marked(watched, address, played):
    opened(watched, f"{address}/episodes/episode/one-hand?at=3")
    lane = watched.locator(".lane[data-stream=action]")
    title = "ring_left: interpolated from 2 to 4 s"
    expect(lane.locator(".interpolated")).to_have_attribute("title", title)
    expect(lane).to_contain_text("1 interpolated")
    expect(watched.locator("#facts")).to_contain_text("wrist_right, keypoints_right")


@pytest.mark.slow
def test_facts_and_exports(watched, address, played):
    opened(watched, f"{address}/episodes/episode/episode-1")
    facts = watched.locator("#facts")
    expect(facts).to_contain_text("p17")
    expect(facts).to_contain_text("3.50")
    trace = facts.get_by_role("link", name=items.TRACE_ID)
    expect(trace).to_have_attribute("href", f"/episodes?text={items.TRACE_ID}")
    expect(facts.get_by_role("link", name="take-1")).to_have_attribute(
        "href", "/episodes/recording/take-1"
    )
    expect(facts).to_contain_text("dextouch export --format mcap episode-1 --to episode-1.mcap")
    facts.get_by_role("link", name="take-1").click()
    expect(watched.locator("#item_id")).to_have_text("take-1")
    expect(watched.locator("#facts")).to_contain_text("--kind recording take-1")


def test_an_unknown_item_is_explained(page, address):
    page.goto(f"{address}/episodes/episode/nothing-here")
    expect(page.get_by_role("alert")).to_contain_text("nothing-here")
