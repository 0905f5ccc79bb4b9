"""An operator's first take on a station that runs as a real process: signed in, by keys alone,
from arming to the review, and the samples that the player shows against a plain Zarr reader."""

import contextlib
import json
import os
import signal
import subprocess
import sys
import time
from urllib.parse import urlsplit

import numpy as np
import pytest
import zarr
from playwright.sync_api import expect

from dextouch.tactile.heatmap import colour, hand_canvas
from services.alignment.retargeting import hand_retargeter

KEY = "a-key-of-some-length"
OPERATOR = {"name": "desk", "key": KEY, "scopes": ["operate"]}
START_LIMIT_S = 300
# Of an idle machine: the rest is for those that are busy with other tests.
ALIGNED_LIMIT_S = 60
PRESS_TWICE = "Once more within three seconds"
SETTLED = """() => document.getElementById("clock").title && !document.querySelector(
  "#player [data-state=loading]:not([hidden]):not([hidden] *)")"""
READ = """(shape) => {
  const camera = document.querySelector("[data-camera=camera_head]");
  const picture = camera.querySelector("canvas");
  const image = picture.getContext("2d").getImageData(0, 0, picture.width, picture.height);
  const touch = document.querySelector("[data-stream=tactile_right]");
  const canvas = touch.querySelector("canvas");
  const [rows, columns] = shape;
  // A margin of one cell around the map, which is centred.
  const cell = Math.min(canvas.width / (columns + 2), canvas.height / (rows + 2));
  const [left, top] = [(canvas.width - columns * cell) / 2, (canvas.height - rows * cell) / 2];
  const map = canvas.getContext("2d").getImageData(0, 0, canvas.width, canvas.height);
  const colours = [];
  for (let row = 0; row < rows; row += 1) for (let column = 0; column < columns; column += 1) {
    const [x, y] = [left + (column + 0.5) * cell, top + (row + 0.5) * cell].map(Math.floor);
    colours.push([...map.data.slice(4 * (y * map.width + x), 4 * (y * map.width + x) + 3)]);
  }
  return {
    image: [...image.data], size: [picture.height, picture.width], image_stamp: camera.dataset.stamp,
    colours, touch_stamp: touch.dataset.stamp, contact: touch.textContent,
  };
}"""


@contextlib.contextmanager
def up(folder, **variables):
    """The addresses of `dextouch up` in an empty folder, as a process of its own."""
    ports = "dashboard episode_store alignment acquisition".split()
    words = [word for name in ports for word in (f"--{name.replace('_', '-')}-port", "0")]
    with (folder / "log").open("w") as log:
        running = subprocess.Popen(
            [
                *(sys.executable, "-m", "services.cli.main", "up"),
                *("--without", "twin,world_model,studies", "--json", "urls.json", *words),
            ],
            cwd=folder,
            env={name: v for name, v in os.environ.items() if name != "DEXTOUCH_DATA"} | variables,
            stdout=log,
            stderr=log,
        )
        try:
            written, deadline_s = folder / "urls.json", time.monotonic() + START_LIMIT_S
            while not (written.exists() and written.read_text().endswith("\n")):
                assert running.poll() is None, (folder / "log").read_text()
                assert time.monotonic() < deadline_s
                time.sleep(0.05)
            yield json.loads(written.read_text())
        finally:
            running.send_signal(signal.SIGINT)
            with contextlib.suppress(subprocess.TimeoutExpired):
                running.wait(30)
            running.kill()
            running.wait()
    assert running.returncode == 0, (folder / "log").read_text()


@pytest.fixture
def station(tmp_path):
    """Compiled here: a worker of the service does it too, but after everybody else's work."""
    hand_retargeter.warm_up()
    variables = {
        "DEXTOUCH_DASHBOARD_API_KEYS": json.dumps([OPERATOR]),
        # Mocks play in real time: on a busy machine they have gaps that ordinary limits refuse.
        "DEXTOUCH_ALIGNMENT_OPTIONS__MAX_GAP_MS": "10000",
        "PYTHONPATH": os.pathsep.join(sys.path),
    }
    with up(tmp_path, **variables) as urls:
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


def state(page):
    return page.locator("#recorder_state")


def press(page, key, until):
    """Press a key of the recorder; once more where it asks whether it is meant."""
    asks = page.locator("#recorder_message").filter(has_text=PRESS_TWICE)
    page.keyboard.press(key)
    expect(state(page).filter(has_text=until).or_(asks)).not_to_have_count(0)
    if state(page).text_content() != until:
        page.keyboard.press(key)
    expect(state(page)).to_have_text(until)


def record(page, *, num_seconds):
    """Record a take that is armed; no outcome is chosen when it ends."""
    press(page, "r", "recording")
    reached = "(s) => Number(document.getElementById('recorder_clock').textContent.slice(2)) >= s"
    page.wait_for_function(reached, arg=num_seconds)
    press(page, "s", "checking")
    expect(page.locator("input[name=outcome]:checked")).to_have_count(0)
    return page.locator("#recorder_note").text_content().split(" · ")[0]


def tab_to(page, selector):
    for _ in range(60):
        page.keyboard.press("Tab")
        if page.evaluate("(selector) => document.activeElement.matches(selector)", selector):
            return
    raise AssertionError(f"Tab does not reach {selector}")


def go(page, title):
    """Another screen, by its link in the navigation."""
    page.get_by_role("navigation", name="screens").get_by_role("link", name=title).click()


def taxels_in_contact(pressures_kpa):
    touching = pressures_kpa[pressures_kpa >= 2.0]
    return f"{len(touching)} taxels in contact, peak {touching.max():.0f} kPa"


def check_moment(shown, episode, t_ns):
    """Image, taxels and stamps are those that a plain Zarr reader finds for this time."""
    stamps = episode["camera_head_t_ref_ns"][:]
    index = int(np.searchsorted(stamps, t_ns, side="right")) - 1
    assert shown["image_stamp"] == str(stamps[index])
    image = np.array(shown["image"]).reshape(*shown["size"], 4)[..., :3]
    images = episode["camera_head"][:].astype(int)
    errors = np.abs(images - image).mean(axis=(1, 2, 3))
    assert errors[index] < 6
    # The ball of the mock camera moves: no image at another place of its round is as near.
    assert errors[index] < errors[(index + 30) % len(images)] / 2

    stamps = episode["tactile_right_t_ref_ns"][:]
    index = int(np.searchsorted(stamps, t_ns, side="right")) - 1
    assert shown["touch_stamp"] == str(stamps[index])
    pressures_kpa = np.asarray(episode["tactile_right"][index]).ravel()
    assert taxels_in_contact(pressures_kpa) in shown["contact"]
    expected = hand_canvas(colour(pressures_kpa)[:, 0].astype("f4"), side="right").ravel()
    seen = np.array(shown["colours"])[:, 0]
    pressed = hand_canvas(pressures_kpa, side="right").ravel() > 2.0
    assert pressed.sum() > 20
    assert np.abs(seen - expected)[pressed].max() <= 3


def check_player(page, station, store, episode_id):
    """Three moments: at a sample, between samples, and near the end."""
    episode = zarr.open_group(store / "episodes" / episode_id, mode="r")
    stamps = episode["camera_head_t_ref_ns"][:]
    size = list(hand_canvas(np.zeros(320, "f4"), side="right").shape)
    for t_ns in (int(stamps[10]), int(stamps[len(stamps) // 2]) + 7_000_001, int(stamps[-10])):
        at = f"{t_ns // 10**9}.{t_ns % 10**9:09d}"
        page.goto(f"{station}/episodes/episode/{episode_id}?at={at}")
        page.wait_for_function(SETTLED)
        check_moment(page.evaluate(READ, size), episode, t_ns)


def test_a_day_at_the_station(watched, station, tmp_path):
    page = watched
    page.goto(station)
    page.keyboard.type(KEY)
    page.keyboard.press("Enter")
    expect(state(page)).to_have_text("idle")

    tab_to(page, "#operator")
    page.keyboard.type("p7")
    tab_to(page, "#consent")
    page.keyboard.press("Space")
    page.keyboard.press("Escape")
    press(page, "a", "armed")
    take = record(page, num_seconds=4)
    page.keyboard.press("u")
    press(page, "v", "saved")
    saved_s = time.monotonic()

    go(page, "Episodes")
    row = page.locator("#rows tr").filter(has_text=take)
    expect(row).to_be_visible()
    expect(row).to_contain_text("recording → episode", timeout=1000 * ALIGNED_LIMIT_S)
    expect(row.locator(".steps .done")).to_have_count(4)
    print(f"aligned {time.monotonic() - saved_s:.1f} s after it was saved")
    page.keyboard.press("ArrowDown")
    page.keyboard.press("Enter")
    page.wait_for_url("**/episodes/episode/*")
    page.wait_for_function(SETTLED)
    print(f"playable {time.monotonic() - saved_s:.1f} s after it was saved")
    episode_id = urlsplit(page.url).path.rpartition("/")[2]
    assert episode_id.startswith(take)
    page.keyboard.press("Space")
    page.wait_for_function("() => parseFloat(document.getElementById('clock').title) > 1")
    check_player(page, station, tmp_path / "data" / "store", episode_id)

    go(page, "Station")
    expect(state(page)).to_have_text("saved")
    press(page, "a", "armed")
    thrown_away = record(page, num_seconds=1)
    page.keyboard.press("y")
    press(page, "d", "discarded")
    press(page, "a", "armed")
    again = record(page, num_seconds=1)
    page.keyboard.press("n")
    press(page, "g", "armed")
    record(page, num_seconds=1)
    press(page, "d", "discarded")
    assert not {thrown_away, again} & {path.name for path in (tmp_path / "data/spool").iterdir()}

    go(page, "Review")
    expect(page.locator("#rows .item_name")).to_have_text([take])
    page.keyboard.press("r")
    page.keyboard.press("4")
    page.keyboard.press("Enter")
    expect(page.locator("#empty")).to_be_visible()
    go(page, "Hours")
    # 4 s are 0.1 min: rejected, and in no total.
    expect(page.locator("#operator_rows tr")).to_have_text(["p7––0.1 min0.1 min1"])

    page.get_by_role("button", name="Sign out").click()
    expect(page.get_by_label("Key")).to_be_visible()
    page.goto(f"{station}/episodes")
    expect(page.get_by_label("Key")).to_be_visible()
