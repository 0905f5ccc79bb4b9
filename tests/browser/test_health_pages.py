"""Health on the pages: root causes above streams, and the history of a scripted station."""

import itertools
import re
from types import SimpleNamespace

import numpy as np
import pytest
from fastapi import FastAPI
from playwright.sync_api import expect

from dextouch.schemas import TakePrompt
from dextouch.serving import create_service_app
from services.acquisition.clock import VirtualClock
from services.acquisition.health import history
from services.acquisition.mock_station import MockStation
from services.acquisition.mocks.faults import DeviceFaults, FaultScript
from services.acquisition.mocks.pattern import pattern_calibration, pattern_streams
from services.acquisition.routes import station_router
from services.acquisition.settings import AcquisitionSettings
from services.acquisition.uploader import Uploader
from services.dashboard.app import create_app as create_dashboard
from services.dashboard.settings import DashboardSettings
from tests.browser.fake_station import DEVICES

ADVICE = "Close other programs, or set the cameras to smaller or fewer images."
OVERLOADED = "This computer is overloaded: processors 98 % busy, 5 devices late"
SECONDS_SINCE = itertools.count(12)
LATE = ("tactile_left", "tactile_right", "head", "camera_head", "camera_wrist_left")
# The colours of the sheet, which rows and small plots must both have.
COLOURS = {"OK": "rgb(28, 110, 67)", "ERROR": "rgb(163, 29, 44)"}
ROWS = """() => [...document.querySelectorAll("#device_rows tr[data-level]")].map((row) => ({
  level: row.dataset.level,
  stroke: getComputedStyle(row.querySelector(".spark")).stroke,
  badge: getComputedStyle(row.querySelector(".level")).color,
  overflows: [...row.cells].some((cell) => cell.scrollWidth > cell.clientWidth + 1),
}))"""


def loaded_health():
    """Ten streams of seven devices at a computer that is too slow for five of them."""
    gap = {"code": "gap", "level": "ERROR", "message": "0.61 s without a sample"}
    gap |= {"advice": "Check cable and hub.", "lasted_s": 12.0}
    streams = [
        {
            "stream": name,
            "device": device,
            "level": "ERROR" if name in LATE else "OK",
            "reasons": [],
            "findings": [gap] if name in LATE else [],
            "rate_hz": 59.9,
            "nominal_rate_hz": 60.0,
            "age_s": 0.01,
            "received": 998,
            "lost": 2,
            "skew_ppm": 12.0,
            "clock_residual_ms": 0.3,
        }
        for device, names in DEVICES.items()
        for name in names
    ]
    cause = {"code": "host", "subject": "", "level": "ERROR", "message": OVERLOADED}
    cause |= {
        "advice": ADVICE,
        "lasted_s": float(next(SECONDS_SINCE)),
        "streams": LATE,
        "findings": ["gap"],
    }
    figures = {"host_cpu_ratio": 0.98, "host_wake_p90_seconds": 0.004, "disk_free_bytes": 5e10}
    health = {"station": "desk", "level": "ERROR", "causes": [cause], "figures": figures}
    return health | {"streams": streams, "devices": []}


@pytest.fixture
def loaded(serve):
    """A dashboard over a station at a loaded computer."""
    station = FastAPI()
    station.get("/v1/health")(loaded_health)
    station.get("/v1/recorder")(lambda: {"state": "idle", "actions": ["arm"]})
    return serve(create_dashboard(DashboardSettings(acquisition_url=serve(station))))


@pytest.mark.slow
def test_a_loaded_computer_is_one_line_above_ten_rows(open_page, loaded):
    page = open_page(viewport={"width": 1366, "height": 768}, color_scheme="light")
    page.goto(loaded)
    expect(page.locator("#device_rows tr[data-level]")).to_have_count(10)
    expect(page.locator(".cause")).to_have_count(1)
    cause = page.locator("details.cause")
    expect(cause.locator("strong")).to_have_text(OVERLOADED)
    expect(cause).to_contain_text(re.compile(r"for \d\d\.0 s · 5 streams"))
    expect(page.get_by_text(ADVICE)).to_have_count(1)
    expect(page.get_by_text("Check cable and hub.")).to_have_count(0)
    expect(page.locator("#summary")).to_have_text("1 cause · 5 of 10 streams OK")
    expect(page.locator("#host")).to_contain_text("CPU 98 % · wakes 4.0 ms late · 50 GB free")
    expect(page.locator(".device_head")).to_have_text("robot 4 streams")

    # At once, because rows are drawn anew with every answer.
    rows = page.evaluate(ROWS)
    assert len(rows) == 10
    # With one cause and a device of four streams, too: the lower part of a screen.
    height = page.locator("#devices").evaluate("panel => panel.getBoundingClientRect().height")
    assert height <= 460
    assert [row["stroke"] for row in rows] == [row["badge"] for row in rows]
    assert [row["badge"] for row in rows] == [COLOURS[row["level"]] for row in rows]
    assert not any(row["overflows"] for row in rows)

    expect(cause.locator("li").first).to_be_hidden()
    cause.locator("summary").click()
    first = re.search(r"for \d\d\.0 s", cause.text_content()).group()
    expect(cause.locator("li")).to_have_count(5)
    # It stays open although the panel is drawn again with every answer.
    expect(cause).not_to_contain_text(first)
    expect(cause.locator("li").first).to_have_text("tactile_left: 0.61 s without a sample")
    expect(cause.locator("li").first).to_be_visible()


SECONDS, STALL_S = 24.0, (10.0, 14.0)
NOW_UNIX_S = 1_800_000_000.0
PROMPT = TakePrompt(task="stack_bowls", instruction="stack the bowls")


@pytest.fixture
def scripted(serve, tmp_path, monkeypatch):
    """A dashboard over a station that has run a script, and when it began by the wall clock."""
    streams = [s for s in pattern_streams(SECONDS) if s.descriptor.name in {"head", "wrist_left"}]
    script = FaultScript(devices={"pose_tracker_head": DeviceFaults(stalls_s=(STALL_S,))})
    clock, calibration = VirtualClock(), pattern_calibration()
    mock = MockStation(streams, script, 5, clock, spool_root=tmp_path, calibration=calibration)
    settings = AcquisitionSettings(spool=tmp_path, mock=True)
    routes = station_router(mock.station, Uploader(tmp_path, None, period_s=1.0))
    with mock:
        take = mock.run_take(PROMPT, recording_id="take-1")
    monkeypatch.setattr(history, "time", SimpleNamespace(time=lambda: NOW_UNIX_S))
    app = create_service_app(name="acquisition", settings=settings, routers=[routes])
    began_s = NOW_UNIX_S - (clock.now_ns() - take.ledger.start_host_ns) * 1e-9
    return serve(create_dashboard(DashboardSettings(acquisition_url=serve(app)))), began_s


def plotted(page, name):
    """Columns of a plot; None where a value is unknown."""
    columns = page.evaluate("name => document.getElementById(name).plot.data", name)
    return [np.array(column, dtype=np.float64) for column in columns]


@pytest.mark.slow
def test_plots_show_the_script_at_its_times(open_page, scripted):
    address, began_s = scripted
    page = open_page(viewport={"width": 1366, "height": 900}, timezone_id="UTC")
    page.goto(f"{address}/health?stream=head&range=120")
    expect(page.locator("#events tr")).not_to_have_count(0)
    expect(page.locator("#stream")).to_have_value("head")
    t_s, rate_hz = plotted(page, "plot_rate")
    t_s = t_s - began_s
    inside = (t_s > 1.5) & (t_s < SECONDS)
    stalled = (t_s > STALL_S[0] + 1.1) & (t_s < STALL_S[1])
    steady = inside & ((t_s < STALL_S[0]) | (t_s > STALL_S[1] + 1.1))
    assert stalled.sum() >= 2
    assert rate_hz[stalled].max() < 2
    assert np.abs(rate_hz[steady] - 100).max() < 2
    _, _, longest_ms = plotted(page, "plot_interval")
    # 4 s, and what a period at both ends adds.
    assert np.nanmax(longest_ms) == pytest.approx(4000, abs=30)
    assert t_s[np.nanargmax(longest_ms)] == pytest.approx(STALL_S[1], abs=1.1)
    silent = page.locator("#events tr").filter(has_text="silent").last
    expect(silent).to_contain_text("STALE")
    hours, minutes, seconds = map(int, silent.locator("td").first.text_content().split(":"))
    # Silent for 0.2 s, which is looked for every 0.1 s; the time is shown in whole seconds.
    seen_s = (3600 * hours + 60 * minutes + seconds - began_s) % 86_400
    assert seen_s == pytest.approx(STALL_S[0] + 0.25, abs=1.1)


def strip_colour(page, row, t_s):
    """Colour and opacity in a row of the overview at a time."""
    return page.evaluate(
        """([row, t_s]) => {
            const plot = document.getElementById("overview").plot;
            const [x, y] = [plot.valToPos(t_s, "x", true), plot.valToPos(row + 0.5, "y", true)];
            return [...plot.ctx.getImageData(Math.round(x), Math.round(y), 1, 1).data];
        }""",
        [row, t_s],
    )


@pytest.mark.slow
def test_takes_and_silences_are_marked_on_the_axis(open_page, scripted):
    address, began_s = scripted
    page = open_page(viewport={"width": 1366, "height": 900}, color_scheme="light")
    page.goto(f"{address}/health?range=120")
    expect(page.locator("#events tr")).not_to_have_count(0)
    # Later answers have no new rows; what was marked stays.
    with page.expect_response("**/health/history?*"), page.expect_response("**/health/events?*"):
        pass
    take = {t: strip_colour(page, 0, began_s + t) for t in (-2, 5, 20)}
    assert take[-2][3] == 0
    # The accent colour, of much more red than blue.
    assert all(take[t][3] > 150 and take[t][0] - take[t][2] > 80 for t in (5, 20)), take
    names = page.evaluate(
        "() => [...document.getElementById('stream').options].map((o) => o.value)"
    )
    row = 2 + names.index("head")
    assert strip_colour(page, row, began_s + 5) != strip_colour(page, row, began_s + 12.5)
    other = 2 + names.index("wrist_left")
    assert strip_colour(page, other, began_s + 5) == strip_colour(page, other, began_s + 12.5)


@pytest.mark.slow
def test_one_cursor_and_a_view_that_the_address_keeps(open_page, scripted):
    address, _ = scripted
    page = open_page(viewport={"width": 1366, "height": 900}, timezone_id="UTC")
    page.goto(f"{address}/health?range=120")
    expect(page.locator("#events tr")).not_to_have_count(0)
    page.get_by_label("stream whose plots are shown").select_option("wrist_left")
    page.get_by_role("button", name="5 min", exact=True).click()
    assert "stream=wrist_left&range=300" in page.url
    page.get_by_role("button", name="2 min").click()

    place = page.locator("#plot_rate .u-over").bounding_box()
    y = place["y"] + place["height"] / 2
    page.mouse.move(place["x"] + 0.9 * place["width"], y)
    texts = [
        page.locator(f"#{name} .u-legend .u-value").first
        for name in ("plot_rate", "plot_clock", "plot_host")
    ]
    expect(texts[0]).to_have_text(re.compile(r"\d\d:\d\d:\d\d"))
    shown = {text.text_content() for text in texts}
    assert len(shown) == 1

    page.mouse.move(place["x"] + 0.85 * place["width"], y)
    page.mouse.down()
    page.mouse.move(place["x"] + 0.95 * place["width"], y, steps=4)
    page.mouse.up()
    # A tenth of the half minute that a station of this age shows.
    page.wait_for_url(lambda url: "end=" in url)
    assert "range=3&" in page.url
    page.reload()
    expect(page.locator("#span")).to_have_text(re.compile(r"\d\d:\d\d:\d\d . \d\d:\d\d:\d\d"))
    expect(page.locator("#stream")).to_have_value("wrist_left")
    page.get_by_role("button", name="15 min").click()
    expect(page.locator("#span")).to_have_text("live")
    shown = "(({ min, max }) => max - min)(document.getElementById('plot_rate').plot.scales.x)"
    assert page.evaluate(shown) == pytest.approx(30, abs=1)
