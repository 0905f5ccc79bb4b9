"""Time to the first picture of the player and from a click on its timeline to all pictures.

Prints medians and 95th percentiles of this machine:
`pytest -s -m slow tests/browser/test_player_latency.py`.
"""

import sys
import time

import numpy as np
import pytest

from dextouch.episodes import EpisodeStore
from dextouch.schemas import EpisodeAttributes
from dextouch.streams import StreamDescriptor
from services.dashboard.app import create_app as create_dashboard
from services.dashboard.settings import DashboardSettings
from services.episode_store.app import create_app as create_store
from services.episode_store.settings import EpisodeStoreSettings

pytestmark = pytest.mark.slow
NUM_LOADS = 5
NUM_CLICKS = 40
DURATION_S = 30
CAMERAS = ("camera_head", "camera_wrist_left", "camera_wrist_right")
IDENTITY = [[float(i == j) for j in range(4)] for i in range(4)]
POSES = ("T_world_wrist_left", "T_world_wrist_right", "T_world_camera_head")
# Broken, not slow: the machine may be busy with other work.
BOUND_S = 20
SHOWN = """(() => {
  const panes = [...document.querySelectorAll("[data-camera], .touch_pane")];
  return panes.length === 5 && panes.every((pane) => pane.dataset.state === "shown");
})()"""
# Milliseconds from the next press on the timeline until every pane shows the new moment.
WATCH = f"""() => {{
  window.latency = null;
  const before = document.getElementById("clock").title;
  document.addEventListener("pointerdown", () => {{
    const began = performance.now();
    const look = () => {{
      const isNew = document.getElementById("clock").title !== before;
      if (isNew && {SHOWN}) window.latency = performance.now() - began;
      else requestAnimationFrame(look);
    }};
    look();
  }}, {{ once: true, capture: true }});
}}"""


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """Half a minute of three cameras of 640 × 480 (H.264, 30 Hz) and of touch (60 Hz)."""
    folder = tmp_path_factory.mktemp("store")
    rng = np.random.default_rng(0)
    scene = rng.integers(0, 255, (31, 41, 3)).repeat(16, axis=0).repeat(16, axis=1).astype("u1")
    attributes = EpisodeAttributes.model_validate(
        {
            "episode_id": "scrubbed",
            "task": "stand_bottle",
            "instruction": "stand it up",
            "domain": "human",
            "origin": "recorded",
            "anchor": dict.fromkeys(POSES, IDENTITY),
            "K_head": [[500, 0, 320], [0, 500, 240], [0, 0, 1]],
        }
    )
    with EpisodeStore(folder).writer(attributes=attributes) as writer:
        for name, kind, shape, dtype, unit, rate_hz in (
            *((camera, "image", (480, 640, 3), "uint8", "h264", 30) for camera in CAMERAS),
            *(
                (f"tactile_{side}", "tactile", (320,), "float32", "kPa", 60)
                for side in ("left", "right")
            ),
        ):
            described = {"name": name, "kind": kind, "shape": shape, "dtype": dtype, "unit": unit}
            described |= {"nominal_rate_hz": rate_hz}
            writer.add_stream(StreamDescriptor.model_validate(described))
            t_ns = np.rint(np.arange(DURATION_S * rate_hz) * 1e9 / rate_hz).astype(np.int64)
            for first in range(0, len(t_ns), 60):
                part = np.arange(first, min(first + 60, len(t_ns)))
                if kind == "image":
                    values = np.stack(
                        [scene[k % 16 :, k % 16 :][:480, :640] for k in part.tolist()]
                    )
                else:
                    values = rng.gamma(2.0, 2.0, (len(part), 320)).astype("f4")
                writer.append(name, values=values, t_ref_ns=t_ns[part])
    return folder


def figures(times_ms):
    median, p95 = np.percentile(times_ms, [50, 95])
    return f"median {median:6.0f} ms, p95 {p95:6.0f} ms ({len(times_ms)} times)"


def test_latency(page, serve, folder, capsys):
    store = serve(create_store(EpisodeStoreSettings(store_url=str(folder))))
    address = serve(create_dashboard(DashboardSettings(episode_store_url=store)))
    refused = []
    page.on("response", lambda answer: refused.append(answer.url) if answer.status >= 400 else None)
    first_ms, scrub_ms = [], []
    for _ in range(NUM_LOADS):
        began = time.perf_counter()
        page.goto(f"{address}/episodes/episode/scrubbed?at=11.3")
        page.wait_for_function(f"() => {SHOWN}", polling="raf")
        first_ms.append(1000 * (time.perf_counter() - began))
    box = page.locator("#timeline .over").bounding_box()
    for share in np.random.default_rng(1).random(NUM_CLICKS):
        page.evaluate(WATCH)
        page.mouse.click(box["x"] + share * box["width"], box["y"] + 6)
        page.wait_for_function("() => window.latency !== null")
        scrub_ms.append(page.evaluate("() => window.latency"))
    with capsys.disabled():
        sys.stdout.write(f"\nplayer, first picture of all panes: {figures(first_ms)}")
        sys.stdout.write(f"\nplayer, click on the timeline to all panes: {figures(scrub_ms)}\n")
    assert not refused
    assert np.median(first_ms) < 1000 * BOUND_S
    assert np.median(scrub_ms) < 1000 * BOUND_S
