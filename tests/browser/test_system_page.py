"""The system page over a real store and a real alignment service, worked as an operator does."""

import re
import threading

import httpx
import pytest
from playwright.sync_api import expect

from dextouch import __version__
from dextouch.episodes import EpisodeStore
from dextouch.schemas import RecordingStatus
from services.acquisition.app import create_app as create_station
from services.acquisition.settings import AcquisitionSettings
from services.alignment import job_runner
from services.alignment.app import create_app as create_alignment
from services.alignment.settings import AlignmentSettings
from services.dashboard.app import create_app as create_dashboard
from services.dashboard.settings import DashboardSettings
from services.episode_store.app import create_app as create_store
from services.episode_store.settings import EpisodeStoreSettings
from tests.unit.alignment.recordings import write_recording
from tests.unit.alignment.test_service import FakeWorker

HOSTILE = '<img src=x onerror="document.title=1">'
KEY = "a-key-of-some-length"
TAKES = [f"take-{number}" for number in range(8)]


@pytest.fixture
def folder(tmp_path):
    return tmp_path / "store"


@pytest.fixture
def worker(monkeypatch):
    """Aligns really, in a thread, once the test lets it."""
    kind = type("Worker", (FakeWorker,), {"held": threading.Event()})
    monkeypatch.setattr(job_runner, "AlignmentWorker", kind)
    yield kind
    kind.held.set()


@pytest.fixture
def urls(serve, folder, worker):
    store = EpisodeStore(folder)
    for name in TAKES:
        write_recording(store, recording_id=name)
    settings = AlignmentSettings(store_url=str(folder), align_new=False, num_workers=1)
    return {
        "episode_store_url": serve(create_store(EpisodeStoreSettings(store_url=str(folder)))),
        "alignment_url": serve(create_alignment(settings)),
        # Nobody listens there.
        "twin_url": "http://127.0.0.1:9",
    }


@pytest.fixture
def serve_dashboard(serve, urls, tmp_path):
    def start(**settings):
        settings = {"audit_folder": tmp_path / "audit", "station": "desk"} | urls | settings
        return serve(create_dashboard(DashboardSettings.model_validate(settings)))

    return start


def services_are_shown(page, urls):
    store = page.locator("[data-service='episode store']")
    expect(store).to_contain_text("ready")
    expect(store).to_contain_text(urls["episode_store_url"])
    expect(store).to_contain_text(re.compile(r"\d [MG]B \*"))
    expect(page.locator("#own_version")).to_have_text(f"dashboard {__version__}")
    expect(page.locator("[data-service=twin]")).to_contain_text("twin: no answer to GET /healthz")
    expect(page.locator("#shared_process")).to_be_visible()
    expect(page.locator("#disk_rows")).to_contain_text("episode store")


def test_services_jobs_and_audit(page, serve_dashboard, urls, folder, worker):
    address = serve_dashboard()
    problems = []
    page.on("pageerror", lambda error: problems.append(str(error)))
    page.goto(f"{address}/system")
    services_are_shown(page, urls)
    expect(page.locator("#no_jobs")).to_be_visible()

    with httpx.Client(base_url=address, timeout=60, trust_env=False) as client:
        submitted = client.post("/v1/alignment/alignments", json={"recording_ids": TAKES})
        assert submitted.status_code == 202, submitted.text
        items = [{"kind": "recording", "id": HOSTILE}]
        assert client.post("/v1/episode_store/trash", json={"items": items}).status_code >= 200
    job = page.locator("#job_rows tr").filter(has_text=TAKES[-1])
    expect(job).to_contain_text("waiting")
    job.get_by_role("button", name="Cancel").click()
    expect(job).to_be_visible()
    job.get_by_role("button", name="Cancel now").click()
    expect(page.locator("#jobs_note")).to_have_text(f"Alignment of {TAKES[-1]} cancelled.")
    expect(job).to_have_count(0)
    running = page.locator("#job_rows tr").filter(has_text="running")
    expect(running).to_contain_text("25 %")
    expect(running).to_contain_text("dating · head")
    expect(running.get_by_role("link")).to_have_attribute("href", f"/episodes/recording/{TAKES[0]}")
    expect(page.locator("#queue_rows")).to_contain_text("alignments waiting")
    worker.held.set()
    expect(page.locator("#no_jobs")).to_be_visible()
    assert len(EpisodeStore(folder).list(kind="episode")) == len(TAKES) - 1

    rows = page.locator("#audit_rows tr")
    expect(rows.nth(0)).to_contain_text("cancel alignment")
    expect(rows.nth(1)).to_contain_text(HOSTILE)
    expect(rows.nth(2)).to_contain_text(", ".join(TAKES))
    expect(page.locator("#audit_rows img")).to_have_count(0)
    page.locator("[name=action]").select_option("align")
    expect(rows).to_have_count(1)
    expect(rows).to_contain_text("open access")
    assert problems == []


@pytest.mark.slow
def test_spools_show_what_they_hold_and_for_how_long(page, serve, serve_dashboard, tmp_path):
    spool = tmp_path / "spool"
    for name in "abc":
        (spool / name).mkdir(parents=True)
        (spool / name / "recording.json").write_bytes(b"{}")
        (spool / name / "batches.log").write_bytes(bytes(10**6))
        if name != "a":
            note = RecordingStatus(recording_id=name, state="finished")
            (spool / name / "uploaded.json").write_text(note.model_dump_json())
    settings = AcquisitionSettings(
        mock=True, spool=spool, keep_uploaded_days=3, keep_uploaded_gb=200, upload_period_s=3600
    )
    address = serve_dashboard(acquisition_url=serve(create_station(settings)))
    page.goto(f"{address}/system")
    row = page.locator("#spool_rows tr")
    expect(row).to_contain_text("station desk")
    expect(row).to_contain_text("1.0 MB in 1 take")
    expect(row).to_contain_text("2.0 MB in 2 takes")
    expect(row).to_contain_text("kept for 3 days, at most 200 GB")


@pytest.mark.slow
def test_people_are_named_and_filtered(page, serve_dashboard):
    keys = [{"name": name, "key": name + KEY, "scopes": ("operate",)} for name in ("ada", "kim")]
    address = serve_dashboard(api_keys=keys, alignment_url=None, twin_url=None)
    for key in ("no such key", f"kim{KEY}", f"ada{KEY}"):
        page.goto(f"{address}/system")
        page.locator("[name=key]").fill(key)
        page.keyboard.press("Enter")
        if key.startswith("kim"):
            page.get_by_role("button", name="Sign out").click()
            expect(page.locator("[name=key]")).to_be_visible()
        elif key.startswith("no"):
            expect(page.get_by_text("unknown key")).to_be_visible()
        else:
            expect(page.get_by_role("link", name="System")).to_be_visible()
    rows = page.locator("#audit_rows tr")
    expect(rows).to_have_count(4)
    for row, words in zip(
        (rows.nth(number) for number in range(4)),
        (("ada", "sign in"), ("kim", "sign out"), ("kim", "sign in"), ("not signed in", "401")),
        strict=True,
    ):
        for word in words:
            expect(row).to_contain_text(word)
    page.locator("[name=person]").fill("kim")
    expect(rows).to_have_count(2)


@pytest.mark.slow
def test_the_navigation_has_one_line(open_page, serve_dashboard):
    keys = [{"name": "ada", "key": KEY, "scopes": ("operate",)}]
    address = serve_dashboard(api_keys=keys)
    page = open_page(viewport={"width": 1366, "height": 768})
    page.goto(f"{address}/system")
    page.locator("[name=key]").fill(KEY)
    page.keyboard.press("Enter")
    expect(page.get_by_role("link", name="System")).to_be_visible()
    for path in ("/system", "/", "/episodes", "/studies"):
        page.goto(f"{address}{path}")
        expect(page.get_by_role("link", name="System")).to_be_visible()
        tops = page.locator(".screens a").evaluate_all("as => as.map((a) => a.offsetTop)")
        assert len(set(tops)) == 1, path
        assert page.locator(".bar").evaluate("bar => bar.offsetHeight") < 70, path
