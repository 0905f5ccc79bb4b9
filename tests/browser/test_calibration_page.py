"""Calibration practised from the page on a mock board: the results against the mock's own truth."""

import json
import re
import sys

import numpy as np
import pytest
from playwright.sync_api import expect
from scipy.spatial.transform import Rotation

from services.acquisition.app import create_app as create_station
from services.acquisition.mocks import pattern
from services.acquisition.mocks.gloves import GloveCalibration
from services.acquisition.settings import AcquisitionSettings
from services.alignment.app import create_app as create_alignment
from services.alignment.settings import AlignmentSettings
from services.dashboard.app import create_app as create_dashboard
from services.dashboard.settings import DashboardSettings
from tests.browser.stage import know_the_lens

LONG_MS = 240_000
SEED = 3
# Four reported standard deviations of 25 views, and what they move a pixel of the image.
MAX_FOCAL_SHARE, MAX_CENTRE_PX, MAX_MOVED_PX = 0.003, 1.2, 0.5
# Half of a count is what the glove's rounding may hide without noise.
MAX_TARE_COUNTS = 0.51
# Limit of a mount that the guide calls good, as in tests/accuracy/test_mount_guide.py.
MAX_MOUNT_DEG, MAX_MOUNT_MM = 0.15, 2.0
# Delays of the practice trackers' paths, after that of the head.
DELAYS_MS = {"wrist_left": 12.0, "wrist_right": 5.0}
BOARD = "chessboard:9x6:25mm"


@pytest.fixture
def folder(tmp_path):
    """Where calibrations of simulated devices are written."""
    return tmp_path / "calibration" / "practice"


@pytest.fixture
def address(serve, tmp_path, monkeypatch):
    """A dashboard over a mock station with few devices, of which a small machine keeps up."""
    whole = pattern.pattern_streams
    few = {"tactile_left", "head", "wrist_left"}
    monkeypatch.setattr(
        pattern,
        "pattern_streams",
        lambda round_s=pattern.ROUND_S, **given: [
            s for s in whole(round_s, **given) if s.descriptor.name in few
        ],
    )
    spool = tmp_path / "spool"
    station = serve(create_station(AcquisitionSettings(spool=spool, mock=True, seed=SEED)))
    alignment = AlignmentSettings(
        store_url=str(tmp_path / "store"),
        num_workers=1,
        station_url=station,
        station_spool=spool,
        calibration_folder=tmp_path / "calibration",
    )
    urls = {"acquisition_url": station, "alignment_url": serve(create_alignment(alignment))}
    return serve(create_dashboard(DashboardSettings(**urls)))


@pytest.fixture
def few_poses(monkeypatch):
    """A board with few places, for tests that need no lens."""
    monkeypatch.setattr(pattern, "NUM_POSES", 4)


def practise(page, address):
    """Open the page and start the practice devices by keyboard."""
    page.goto(f"{address}/calibration")
    expect(page.locator("#item_rows tr")).not_to_have_count(0)
    expect(page.locator("#item_rows")).not_to_contain_text("missing")
    expect(page.get_by_role("button", name="Guided run")).to_have_count(0)
    tab_to(page, "#practice_start")
    page.keyboard.press("Enter")
    expect(page.locator("#practice_stop")).to_be_focused(timeout=LONG_MS)
    expect(page.locator("#practice_words")).to_contain_text(BOARD)


def tab_to(page, selector):
    for _ in range(60):
        page.keyboard.press("Tab")
        if page.evaluate("(selector) => document.activeElement.matches(selector)", selector):
            return
    raise AssertionError(f"Tab does not reach {selector}")


def state(page):
    return page.locator("#run_state")


def project(K, distortion, rays):
    """OpenCV's documented model: pixels of rays [n, 2] (x/z, y/z)."""
    x, y = rays.T
    k1, k2, p1, p2, k3 = distortion
    r2 = x**2 + y**2
    radial = 1 + k1 * r2 + k2 * r2**2 + k3 * r2**3
    seen_x = x * radial + 2 * p1 * x * y + p2 * (r2 + 2 * x**2)
    seen_y = y * radial + p1 * (r2 + 2 * y**2) + 2 * p2 * x * y
    return np.stack([K[0, 0] * seen_x + K[0, 2], K[1, 1] * seen_y + K[1, 2]], axis=-1)


def moved_px(K, distortion):
    """Largest distance between where the found and the true camera see a ray.

    A shift of the centre and a turn of the camera are the same but for distortion, so the mean is
    left out: the pose of the camera on its tracker takes it up.
    """
    grid = np.stack(np.meshgrid(np.linspace(-0.5, 0.5, 21), np.linspace(-0.36, 0.36, 15)), -1)
    rays = grid.reshape(-1, 2)
    difference = project(K, distortion, rays) - project(pattern.K, (*pattern.DISTORTION, 0.0), rays)
    return float(np.linalg.norm(difference - difference.mean(axis=0), axis=1).max())


# Half a minute of views on an idle machine, minutes on a busy one.
@pytest.mark.slow
def test_a_lens_is_calibrated_from_the_page_by_keyboard(page, address, folder, capsys):
    practise(page, address)
    row = page.locator("tr[data-name=K_head]")
    expect(row).to_contain_text("simulated")
    tab_to(page, "tr[data-name=K_head] button")
    page.keyboard.press("Enter")
    expect(page.locator("#board")).to_be_focused()
    expect(page.locator("#board")).to_have_value(BOARD)
    page.keyboard.press("Enter")
    expect(page.locator("#view_overlay circle")).to_have_count(54, timeout=LONG_MS)
    expect(page.locator("#view_overlay polygon")).not_to_have_count(0, timeout=LONG_MS)
    expect(state(page)).to_have_text("done", timeout=LONG_MS)
    expect(row).to_contain_text("good")
    said = re.search(r"± ([0-9.]+) %, wanted ± 0.10 %", page.locator("#run_count").text_content())
    assert 0 < float(said[1]) <= 0.1
    expect(row.locator(".regions span[data-enough=true]")).to_have_count(9)

    found = {
        name: np.array(rows)
        for name, rows in json.loads((folder / "calibration.json").read_text()).items()
    }
    K, distortion = found["K_head"], found["distortion_head"][0]
    focal = np.abs(np.diag(K)[:2] / np.diag(pattern.K)[:2] - 1).max()
    centre_px = np.abs(K[:2, 2] - pattern.K[:2, 2]).max()
    moved = moved_px(K, distortion)
    with capsys.disabled():
        sys.stdout.write(
            f"\npractice camera: focal length off by {focal:.3%}, bound {MAX_FOCAL_SHARE:.1%} | "
            f"centre {centre_px:.2f} px, bound {MAX_CENTRE_PX} | pixels {moved:.2f} px, bound "
            f"{MAX_MOVED_PX}"
        )
    assert focal < MAX_FOCAL_SHARE
    assert centre_px < MAX_CENTRE_PX
    assert moved < MAX_MOVED_PX


@pytest.mark.usefixtures("few_poses")
@pytest.mark.slow
def test_the_zero_of_a_glove_is_measured_from_the_page_by_keyboard(page, address, folder, capsys):
    practise(page, address)
    expect(page.locator("tr[data-name=tactile_left_tare_counts]")).to_contain_text("simulated")
    tab_to(page, "tr[data-name=tactile_left_tare_counts] button")
    page.keyboard.press("Enter")
    page.keyboard.press("Enter")
    expect(page.locator("#run_next")).to_contain_text("Lay the left glove down")
    expect(page.locator("#answer_action")).to_be_focused()
    expect(page.locator("#answer_action")).to_have_text("Record 10 s")
    page.keyboard.press("Enter")
    expect(page.locator("#countdown_left")).to_have_text(re.compile("^[1-9] s$"))
    expect(page.locator("#run_next")).to_have_text("Recording")
    expect(page.locator("#run_next")).to_have_text("Next pressure", timeout=LONG_MS)
    expect(page.locator("#answer")).to_be_focused()
    page.get_by_role("button", name="No more pressures").press("Enter")
    expect(state(page)).to_have_text("done", timeout=LONG_MS)
    tare = np.array(
        json.loads((folder / "calibration.json").read_text())["tactile_left_tare_counts"]
    )
    error = np.abs(tare.ravel() - GloveCalibration.seeded("left", SEED).tare_counts)
    with capsys.disabled():
        sys.stdout.write(f"\npractice glove: zero off by {error.max():.2f} counts, bound 0.51")
    assert error.max() < MAX_TARE_COUNTS


@pytest.mark.usefixtures("few_poses")
@pytest.mark.slow
def test_a_run_is_ended_and_what_is_wrong_is_said(page, address, folder):
    practise(page, address)
    page.locator("tr[data-name=K_head] button").click()
    page.locator("#board").fill("<b>paper</b>")
    page.keyboard.press("Enter")
    expect(page.locator("#begin_note")).to_contain_text("unknown board '<b>paper</b>'")
    page.locator("#board").fill(BOARD)
    page.keyboard.press("Enter")
    expect(page.locator("#run_count_text")).to_contain_text("of 25 views", timeout=LONG_MS)
    page.reload()
    expect(state(page)).to_have_text("running")
    page.locator("#run_cancel").click()
    expect(state(page)).to_have_text("cancelled")
    expect(page.locator("#run_next")).to_contain_text("nothing was written")
    assert not (folder / "calibration.json").exists()


def mount_errors(folder):
    """Degrees and millimetres between the written mount and that of the practice camera."""
    found = json.loads((folder / "calibration.json").read_text())["T_tracker_head_camera_head"]
    difference = np.linalg.inv(pattern.T_TRACKER_CAMERA) @ np.array(found)
    angle_rad = Rotation.from_matrix(difference[:3, :3]).magnitude()
    return np.rad2deg(angle_rad), 1e3 * np.linalg.norm(difference[:3, 3])


def begin_mount(page):
    tab_to(page, "tr[data-name=T_tracker_head_camera_head] button")
    page.keyboard.press("Enter")
    expect(page.locator("#board")).to_be_focused()


# About half a minute of places on an idle machine.
@pytest.mark.slow
def test_a_mount_is_calibrated_from_the_page_by_keyboard(page, address, folder, capsys):
    practise(page, address)
    begin_mount(page)
    page.keyboard.press("Enter")
    expect(page.locator("#begin_note")).to_contain_text("'Camera head: lens'")
    know_the_lens(folder)
    page.keyboard.press("Enter")
    kept = page.locator("#run_count_text")
    expect(kept).to_contain_text(re.compile("[3-5] places kept"), timeout=LONG_MS)
    expect(page.locator("#view_signs")).to_contain_text("Board seen")
    expect(page.locator("#view_signs")).to_contain_text("Tracker seen")
    expect(page.locator("#gauges li")).to_have_count(7)
    expect(page.locator("#run_next")).not_to_be_empty()
    with page.expect_response("**/run/drop") as dropped:
        page.keyboard.press("d")
    assert dropped.value.ok
    # Ended in the middle, and continued after the page was opened anew.
    page.get_by_role("button", name="Pause").press("Enter")
    expect(state(page)).to_have_text("cancelled")
    expect(page.locator("#run_next")).to_contain_text("places are kept")
    assert "T_tracker_head_camera_head" not in (folder / "calibration.json").read_text()
    page.reload()
    begin_mount(page)
    expect(page.get_by_label(re.compile("Go on with the [0-9]+ places"))).to_be_checked()
    page.keyboard.press("Enter")
    expect(state(page)).to_have_text("done", timeout=LONG_MS)
    row = page.locator("tr[data-name=T_tracker_head_camera_head]")
    expect(row).to_contain_text("good")
    expect(page.locator("#gauges li[data-full=true]")).to_have_count(7)
    angle_deg, distance_mm = mount_errors(folder)
    with capsys.disabled():
        sys.stdout.write(
            f"\npractice mount: off by {angle_deg:.3f} degrees, bound {MAX_MOUNT_DEG} | "
            f"{distance_mm:.2f} mm, bound {MAX_MOUNT_MM}"
        )
    assert angle_deg < MAX_MOUNT_DEG
    assert distance_mm < MAX_MOUNT_MM


@pytest.mark.slow
def test_delays_of_all_trackers_are_measured_from_the_page_by_keyboard(page, address, folder):
    practise(page, address)
    know_the_lens(folder)
    tab_to(page, "tr[data-name=path_delays] button")
    page.keyboard.press("Enter")
    page.keyboard.press("Enter")
    action = page.locator("#answer_action")
    expect(action).to_have_text("Record 10 s")
    expect(action).to_be_focused()
    page.keyboard.press("Enter")
    expect(page.locator("#run_next")).to_contain_text("recording begins in")
    expect(page.locator("#run_next")).to_have_text("Recording")
    expect(page.locator("#countdown_left")).to_have_text(re.compile("^[1-9] s$"))
    expect(state(page)).to_have_text("done", timeout=LONG_MS)
    expect(page.locator("#result")).to_contain_text("Relative to head")
    expect(page.locator("#result")).to_contain_text("standard deviations")
    expect(page.locator("#result")).to_contain_text("camera_head has 10 images a second")
    # Three trackers: two delays, three pairs.
    expect(page.locator("#result tbody tr")).to_have_count(5)
    written = json.loads((folder / "calibration.json").read_text())
    for name, delay_ms in DELAYS_MS.items():
        shown = page.locator("#result tbody tr").filter(has_text=name).first.text_content()
        found_ms, sigma_ms = map(float, re.search(r"(-?[0-9.]+) ± ([0-9.]+) ms", shown).groups())
        assert found_ms == pytest.approx(delay_ms, abs=3 * sigma_ms + 0.5)
        assert written[f"{name}_latency_ns"][0][0] * 1e-6 == pytest.approx(found_ms, abs=0.01)


def test_practice_ends_where_it_began(page, address, monkeypatch):
    monkeypatch.setattr(pattern, "NUM_POSES", 4)
    practise(page, address)
    page.keyboard.press("Enter")
    expect(page.locator("#practice_start")).to_be_focused(timeout=LONG_MS)
    expect(page.get_by_role("button", name="Guided run")).to_have_count(0)
