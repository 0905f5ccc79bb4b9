"""What walks through the dashboard share: a running `dextouch up`, keys, and moments of the player
compared with a plain Zarr reader."""

import contextlib
import json
import os
import signal
import subprocess
import sys
import time

import numpy as np
import zarr
from playwright.sync_api import expect

from dextouch.tactile.layout import DEXTOUCH_V1, colour

DEXTOUCH = (sys.executable, "-m", "services.cli.main")
START_LIMIT_S = 300
# 15 s on an idle machine; the rest is for those that are busy with other tests.
ALIGNED_LIMIT_S = 60
SETTLED = """() => document.getElementById("clock").title && !document.querySelector(
  "#player [data-state=loading]:not([hidden]):not([hidden] *)")"""
READ = """([rows, columns]) => {
  const camera = document.querySelector("[data-camera=camera_head]");
  const picture = camera.querySelector("canvas");
  const image = picture.getContext("2d").getImageData(0, 0, picture.width, picture.height);
  const touch = document.querySelector("[data-stream=tactile_right]");
  const canvas = touch.querySelector("canvas");
  const { data, width, height } = canvas.getContext("2d")
    .getImageData(0, 0, canvas.width, canvas.height);
  // A margin of one cell around the map, which is centred.
  const cell = Math.min(width / (columns + 2), height / (rows + 2));
  const [left, top] = [(width - columns * cell) / 2, (height - rows * cell) / 2];
  const reds = [];
  for (let row = 0; row < rows; row += 1) for (let column = 0; column < columns; column += 1) {
    const [x, y] = [left + (column + 0.5) * cell, top + (row + 0.5) * cell].map(Math.floor);
    reds.push(data[4 * (y * width + x)]);
  }
  return {
    image: [...image.data], size: [picture.height, picture.width],
    image_stamp: camera.dataset.stamp, reds, touch_stamp: touch.dataset.stamp,
    touch: touch.textContent,
  };
}"""


def environment(**variables):
    """That of this process, in which `dextouch` keeps its data in the current folder."""
    kept = {name: value for name, value in os.environ.items() if name != "DEXTOUCH_DATA"}
    # Mocks play in real time: on a busy machine they have gaps that ordinary limits refuse.
    limits = {"DEXTOUCH_ALIGNMENT_OPTIONS__MAX_GAP_MS": "10000"}
    return kept | limits | {"PYTHONPATH": os.pathsep.join(sys.path)} | variables


@contextlib.contextmanager
def up(folder, *words, **variables):
    """The addresses of `dextouch up …` in this folder, as a process of its own."""
    log_path, written = folder / "up.log", folder / "urls.json"
    with log_path.open("w") as log:
        running = subprocess.Popen(
            [*DEXTOUCH, "up", *words, "--json", str(written)],
            cwd=folder,
            env=environment(**variables),
            stdout=log,
            stderr=log,
        )
        try:
            deadline_s = time.monotonic() + START_LIMIT_S
            while not (written.exists() and written.read_text().endswith("\n")):
                assert running.poll() is None, log_path.read_text()
                assert time.monotonic() < deadline_s, log_path.read_text()
                time.sleep(0.05)
            yield json.loads(written.read_text())
        finally:
            running.send_signal(signal.SIGINT)
            with contextlib.suppress(subprocess.TimeoutExpired):
                running.wait(30)
            running.kill()
            running.wait()
    assert running.returncode == 0, log_path.read_text()


def go(page, title):
    """Another screen, by its link in the navigation."""
    page.get_by_role("navigation", name="screens").get_by_role("link", name=title).click()


def state(page):
    return page.locator("#recorder_state")


def wait_for_clock(page, num_seconds):
    """Until a take is this long."""
    reached = "(s) => Number(document.getElementById('recorder_clock').textContent.slice(2)) >= s"
    page.wait_for_function(reached, arg=num_seconds)


def aligned_row(page, take):
    """The take's row in Episodes, once it has moved on by itself to its last state."""
    row = page.locator("#rows tr").filter(has_text=take)
    expect(row).to_be_visible()
    expect(row).to_contain_text("recording → episode", timeout=1000 * ALIGNED_LIMIT_S)
    expect(row.locator(".steps .done")).to_have_count(4)
    return row


def play(page):
    """Play what a player has open; the id of the episode."""
    page.wait_for_url("**/episodes/episode/*")
    page.wait_for_function(SETTLED)
    page.keyboard.press("Space")
    page.wait_for_function("() => parseFloat(document.getElementById('clock').title) > 1")
    return page.evaluate("() => location.pathname").rpartition("/")[2]


def check_moments(page, store, episode_id, shares):
    """The player at these shares of an episode, one nanosecond before and at samples."""
    episode = zarr.open_group(store / "episodes" / episode_id, mode="r")
    stamps = episode["camera_head_t_ref_ns"][:]
    size = list(DEXTOUCH_V1.hand_canvas(np.zeros(320, "f4"), side="right").shape)
    address = page.evaluate("() => location.origin")
    for number, share in enumerate(shares):
        t_ns = int(stamps[int(share * len(stamps))]) - number % 2
        at = f"{t_ns // 10**9}.{t_ns % 10**9:09d}"
        page.goto(f"{address}/episodes/episode/{episode_id}?at={at}")
        page.wait_for_function(SETTLED)
        _check_moment(page.evaluate(READ, size), episode, t_ns)


def _sample_at(episode, stream, t_ns):
    stamps = episode[f"{stream}_t_ref_ns"][:]
    index = int(np.searchsorted(stamps, t_ns, side="right")) - 1
    return index, str(stamps[index])


def _check_moment(shown, episode, t_ns):
    """Image, taxels and stamps are those that the reader finds for this time."""
    index, stamp = _sample_at(episode, "camera_head", t_ns)
    assert shown["image_stamp"] == stamp
    image = np.array(shown["image"]).reshape(*shown["size"], 4)[..., :3]
    errors = np.abs(episode["camera_head"][:].astype(int) - image).mean(axis=(1, 2, 3))
    # JPEG changes an image a little; one that moved on changes more.
    assert errors[index] < 6
    assert errors[index] <= errors.min() + 0.2
    assert errors[index] < errors.max() / 2

    index, stamp = _sample_at(episode, "tactile_right", t_ns)
    assert shown["touch_stamp"] == stamp
    pressures_kpa = np.asarray(episode["tactile_right"][index]).ravel()
    touching_kpa = pressures_kpa[pressures_kpa >= 2.0]
    assert len(touching_kpa) > 0
    said = f"{len(touching_kpa)} taxels in contact, peak {touching_kpa.max():.0f} kPa"
    assert said in shown["touch"]
    reds = DEXTOUCH_V1.hand_canvas(colour(pressures_kpa)[:, 0].astype("f4"), side="right").ravel()
    pressed = DEXTOUCH_V1.hand_canvas(pressures_kpa, side="right").ravel() >= 2.0
    assert np.abs(np.array(shown["reds"]) - reds)[pressed].max() <= 3
