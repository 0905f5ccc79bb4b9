"""Export from the list and the player: the command runs, the download is whole, limits are told."""

import io
import json
import shlex
import threading
import zipfile
from datetime import timedelta

import pytest
from mcap.reader import make_reader
from playwright.sync_api import expect

from dextouch.episodes import EpisodeStore
from dextouch.schemas import Review
from services.cli.main import main
from services.dashboard.app import create_app as create_dashboard
from services.dashboard.settings import DashboardSettings
from services.episode_store import downloads
from services.episode_store.app import create_app as create_store
from services.episode_store.settings import EpisodeStoreSettings
from tests.browser.test_episodes_page import NOON, names, open_list
from tests.unit.episode_store.episodes import write_recording, write_take

ODD = "o'brien $(touch x)"


@pytest.fixture
def store(tmp_path):
    store = EpisodeStore(tmp_path / "store")
    for number, operator in enumerate(("mika", ODD, ODD)):
        at = NOON - timedelta(hours=number)
        about = {"operator": operator, "started_at": at, "success": number != 2}
        write_take(store, f"take-{number}", **about)
    write_recording(store, "take-3", operator="mika", started_at=NOON)
    return store


@pytest.fixture
def connect(serve, store):
    """Address of a dashboard, with settings of its store."""

    def make(**settings):
        url = serve(create_store(EpisodeStoreSettings(store_url=str(store.root), **settings)))
        return serve(create_dashboard(DashboardSettings(episode_store_url=url)))

    return make


def review(verdict):
    reason = "interrupted or disturbed" if verdict == "rejected" else ""
    return Review(verdict=verdict, reviewed_at=NOON, reviewer="kim", reason=reason)


def open_export(page, address, query=""):
    open_list(page, address, query)
    page.keyboard.press("e")
    dialog = page.get_by_role("dialog", name="Export for other tools")
    expect(dialog).to_be_visible()
    return dialog


def run(command, store, folder):
    """Run a command that the page shows; names of the files that it writes."""
    program, *words = shlex.split(command)
    assert program == "dextouch"
    to = words.index("--to") + 1
    words[to] = str(folder / words[to])
    assert main([*words, "--store", str(store.root)]) == 0
    return sorted(path.name for path in folder.rglob("*.mcap"))


def test_what_is_filtered_is_exported_by_the_command_and_by_the_download(
    page, connect, store, tmp_path
):
    address = connect()
    dialog = open_export(page, address, "?outcome=success&from=2026-05-04&to=2026-05-04")
    expect(dialog.locator("[data-count]")).to_have_text("2 episodes")
    page.keyboard.press("Escape")
    page.locator("[name=operator]").select_option(ODD)
    expect(names(page)).to_have_text(["take-1"])
    page.get_by_role("button", name="Export …").click()
    expect(dialog.locator("[data-count]")).to_have_text("1 episode")
    command = dialog.locator("code").inner_text()
    assert run(command, store, tmp_path / "one") == ["take-1-aligned.mcap"]
    with page.expect_download() as one:
        dialog.get_by_role("button", name="Download MCAP").click()
    assert one.value.suggested_filename == "take-1-aligned.mcap"
    made = next((tmp_path / "one").rglob("*.mcap"))
    assert one.value.path().read_bytes() == made.read_bytes()
    expect(dialog.locator(".download .note")).to_contain_text("take-1-aligned.mcap, ")
    audit = page.request.get(f"{address}/v1/audit?action=download").json()["entries"]
    assert [entry["target"] for entry in audit] == ["take-1-aligned"]


@pytest.mark.slow
def test_a_lab_lead_exports_mondays_accepted_takes(page, connect, store, tmp_path):
    """From the start page by what is seen: days, verdict, export, and what is in the file."""
    store.set_review("take-1-aligned", review("accepted"))
    store.set_review("take-2-aligned", review("rejected"))
    write_take(store, "tuesday", started_at=NOON + timedelta(days=1))
    store.set_review("tuesday-aligned", review("accepted"))
    page.goto(connect())
    page.get_by_role("navigation", name="screens").get_by_role("link", name="Episodes").click()
    # Before its scripts are there, the page does not listen to its fields.
    expect(names(page)).to_have_count(5)
    page.get_by_label("From", exact=True).fill("2026-05-04")
    page.get_by_label("To", exact=True).fill("2026-05-04")
    page.get_by_label("Review").select_option("accepted")
    expect(names(page)).to_have_text(["take-1"])
    expect(page.locator("#rows tr")).to_contain_text("4 May 2026")
    page.get_by_role("button", name="Export …").click()
    dialog = page.get_by_role("dialog", name="Export for other tools")
    expect(dialog.locator("[data-count]")).to_have_text("1 episode")
    command = dialog.locator("code").inner_text()
    assert run(command, store, tmp_path / "monday") == ["take-1-aligned.mcap"]
    with page.expect_download() as monday:
        dialog.get_by_role("button", name="Download MCAP").click()
    with monday.value.path().open("rb") as file:
        attached = {one.name: one.data for one in make_reader(file).iter_attachments()}
    attributes = json.loads(attached["attributes.json"])
    assert (attributes["episode_id"], attributes["success"]) == ("take-1-aligned", True)


@pytest.mark.slow
def test_what_is_selected_is_exported(page, connect, store, tmp_path):
    address = connect()
    open_list(page, address)
    for number in (0, 1):
        page.get_by_label(f"select take-{number}").check()
    page.keyboard.press("e")
    dialog = page.get_by_role("dialog", name="Export for other tools")
    expect(dialog.locator("[data-count]")).to_have_text("2 episodes")
    ids = ["take-0", "take-1"]
    aligned = [f"{name}-aligned.mcap" for name in ids]
    assert run(dialog.locator("code").inner_text(), store, tmp_path / "a") == aligned
    dialog.get_by_label("Kind").select_option("recording")
    expect(dialog.locator("[data-count]")).to_have_text("2 recordings")
    files = [f"{name}.mcap" for name in ids]
    assert run(dialog.locator("code").inner_text(), store, tmp_path / "b") == files
    with page.expect_download() as several:
        dialog.get_by_role("button", name="Download MCAP").click()
    archive = zipfile.ZipFile(io.BytesIO(several.value.path().read_bytes()))
    assert archive.namelist() == [*files, "foxglove_layout.json", "contents.json"]
    dialog.get_by_label("Format").select_option("lerobot")
    expect(dialog.get_by_label("Kind")).to_have_value("episode")
    expect(dialog.locator("code")).to_have_text(
        "dextouch export --format lerobot take-0-aligned take-1-aligned --to lerobot/"
    )
    expect(dialog.get_by_role("button", name="Download MCAP")).to_be_hidden()


@pytest.mark.slow
def test_what_is_too_large_is_refused_with_the_command(page, connect):
    dialog = open_export(page, connect(max_download_items=2))
    dialog.get_by_role("button", name="Download MCAP").click()
    note = dialog.locator(".download .note")
    expect(note).to_contain_text("got 3 items, expected at most 2")
    expect(note).to_contain_text("dextouch export --format mcap")
    expect(dialog.get_by_role("button", name="Download MCAP")).to_be_enabled()


@pytest.mark.slow
def test_a_download_is_cancelled_and_frees_its_place(page, connect, monkeypatch):
    ended = threading.Event()
    original = downloads._archive

    def endless(readers, folder):
        try:
            while True:
                yield from original(readers, folder)
        finally:
            ended.set()

    monkeypatch.setattr(downloads, "_archive", endless)
    dialog = open_export(page, connect(max_downloads=1))
    dialog.get_by_role("button", name="Download MCAP").click()
    note = dialog.locator(".download .note")
    expect(note).to_contain_text("MB of about")
    dialog.get_by_role("button", name="Cancel download").click()
    expect(note).to_have_text("Cancelled; nothing was saved.")
    assert ended.wait(30)
    monkeypatch.setattr(downloads, "_archive", original)
    with page.expect_download():
        dialog.get_by_role("button", name="Download MCAP").click()


@pytest.mark.slow
def test_the_player_offers_the_file_and_both_fit_a_phone(page, connect):
    address = connect()
    page.set_viewport_size({"width": 390, "height": 844})
    dialog = open_export(page, address)
    width = dialog.evaluate("node => [node.scrollWidth, node.clientWidth]")
    assert width[0] <= width[1]
    assert page.evaluate("() => document.documentElement.scrollWidth") <= 390
    page.goto(f"{address}/episodes/episode/take-0-aligned")
    with page.expect_download() as one:
        page.get_by_role("button", name="Download MCAP").click()
    assert one.value.suggested_filename == "take-0-aligned.mcap"
    assert page.evaluate("() => document.documentElement.scrollWidth") <= 390
