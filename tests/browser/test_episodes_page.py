"""The list of recordings and episodes, over a real store of toy takes, worked by keys."""

from datetime import UTC, datetime, timedelta

import pytest
from fastapi import FastAPI
from playwright.sync_api import expect

from dextouch.episodes import EpisodeStore
from services.dashboard.app import create_app as create_dashboard
from services.dashboard.settings import DashboardSettings
from services.episode_store.app import create_app as create_store
from services.episode_store.settings import EpisodeStoreSettings
from tests.unit.episode_store.episodes import write_episode, write_recording, write_take

NOON = datetime(2026, 5, 4, 12, tzinfo=UTC)
HOSTILE = '<img src=x onerror="document.title=1">'


@pytest.fixture
def folder(tmp_path):
    return tmp_path / "store"


@pytest.fixture
def store(folder):
    return EpisodeStore(folder)


@pytest.fixture
def takes(store):
    """Five takes, an hour apart from newest to oldest: take-0 … take-4; take-3 is not aligned."""
    for number in range(5):
        changes = {
            "task": "stack_bowls" if number % 2 else "fold_towel",
            "operator": ("mika", "sanna")[number // 3],
            "started_at": NOON - timedelta(hours=number),
            "consent": True,
        }
        if number == 3:
            write_recording(store, f"take-{number}", **changes)
        else:
            write_take(store, f"take-{number}", success=True, **changes)


@pytest.fixture
def address(serve, folder):
    url = serve(create_store(EpisodeStoreSettings(store_url=str(folder))))
    return serve(create_dashboard(DashboardSettings(episode_store_url=url)))


def names(page):
    return page.locator("#rows .item_name")


def open_list(page, address, query=""):
    page.goto(f"{address}/episodes{query}")
    expect(page.locator("#range")).not_to_be_empty()


@pytest.mark.slow
def test_a_take_is_one_row_and_opens_in_the_player(page, address, takes):
    open_list(page, address)
    expect(names(page)).to_have_text([f"take-{number}" for number in range(5)])
    first = page.locator("#rows tr").first
    expect(first).to_contain_text("recording → episode")
    expect(first).to_contain_text("consent given")
    expect(first).to_contain_text("mika")
    expect(page.locator("#range")).to_have_text("1 to 5 of 5")
    page.keyboard.press("ArrowDown")
    page.keyboard.press("ArrowDown")
    page.keyboard.press("Enter")
    page.wait_for_url("**/episodes/episode/take-1-aligned")


@pytest.mark.slow
def test_filters_are_in_the_address_and_survive_a_reload(page, address, takes):
    open_list(page, address)
    page.locator("[name=task]").select_option("stack_bowls")
    expect(names(page)).to_have_text(["take-1", "take-3"])
    page.locator("[name=operator]").select_option("sanna")
    expect(names(page)).to_have_text(["take-3"])
    page.get_by_role("button", name="Recordings").click()
    page.get_by_role("button", name="Name, kind").click()
    expect(page).to_have_url(
        f"{address}/episodes?view=recording&task=stack_bowls&operator=sanna&sort=id&order=up"
    )
    page.reload()
    expect(names(page)).to_have_text(["take-3"])
    expect(page.locator("[name=task]")).to_have_value("stack_bowls")
    expect(page.locator("[name=operator]")).to_have_value("sanna")
    page.go_back()
    expect(page).to_have_url(f"{address}/episodes?view=recording&task=stack_bowls&operator=sanna")
    page.get_by_role("button", name="Clear filters").click()
    expect(names(page)).to_have_text([f"take-{number}" for number in range(5)])
    page.keyboard.press("/")
    page.keyboard.type("TAKE-4")
    expect(names(page)).to_have_text(["take-4"])
    expect(page).to_have_url(f"{address}/episodes?view=recording&text=TAKE-4")


@pytest.mark.slow
def test_days_are_those_of_the_browser(open_page, address, store):
    # 23:30 of the third and 00:30 of the fourth in Helsinki.
    for name, at in (("late", "2026-05-03T20:30:00Z"), ("early", "2026-05-03T21:30:00Z")):
        write_episode(store, name, created_at=at, num_steps=2)
    page = open_page(timezone_id="Europe/Helsinki")
    open_list(page, address, "?from=2026-05-04&to=2026-05-04")
    expect(names(page)).to_have_text(["early"])
    open_list(page, address, "?to=2026-05-03")
    expect(names(page)).to_have_text(["late"])


@pytest.mark.slow
def test_pages_are_turned_by_keys(page, address, store):
    for number in range(53):
        write_episode(store, f"e-{number:02d}", num_steps=2)
    open_list(page, address, "?sort=id&order=up")
    expect(names(page)).to_have_count(50)
    page.keyboard.press("ArrowRight")
    expect(names(page)).to_have_text(["e-50", "e-51", "e-52"])
    expect(page.locator("#range")).to_have_text("51 to 53 of 53")
    page.reload()
    expect(names(page)).to_have_text(["e-50", "e-51", "e-52"])


@pytest.mark.slow
def test_many_are_deleted_and_restored_by_keys(page, address, store, takes):
    open_list(page, address)
    expect(names(page)).to_have_count(5)
    for key in ("ArrowDown", " ", "ArrowDown", " "):
        page.keyboard.press(key)
    expect(page.locator("#selected")).to_have_text("2 selected")
    page.keyboard.press("Delete")
    expect(page.locator("#message")).to_contain_text(
        "Move 2 recordings and 2 episodes to the trash?"
    )
    assert store.exists("take-0", kind="recording")
    page.keyboard.press("Escape")
    expect(page.locator("#message")).to_be_empty()
    for key in (" ", "ArrowUp", " ", "Delete", "Delete"):
        page.keyboard.press(key)
    expect(names(page)).to_have_text(["take-2", "take-3", "take-4"])
    assert store.list() == ["take-2-aligned", "take-4-aligned"]

    page.get_by_role("button", name="Trash").click()
    expect(names(page)).to_have_count(4)
    page.reload()
    expect(names(page)).to_have_count(4)
    page.keyboard.press("Control+a")
    page.keyboard.press("r")
    expect(page.locator("#empty")).to_be_visible()
    assert store.list(kind="recording") == [f"take-{number}" for number in range(5)]
    page.get_by_role("button", name="Both").click()
    expect(names(page)).to_have_count(5)


@pytest.mark.slow
def test_a_deletion_is_taken_back(page, address, store, takes):
    open_list(page, address)
    expect(names(page)).to_have_count(5)
    page.keyboard.press("Delete")
    page.keyboard.press("Delete")
    expect(page.locator("#message")).to_contain_text("Z brings back")
    expect(names(page)).to_have_count(4)
    page.keyboard.press("z")
    expect(names(page)).to_have_count(5)


def test_hostile_names_stay_text(page, address, store):
    words = {"task": HOSTILE, "instruction": HOSTILE, "operator": HOSTILE, "station": HOSTILE}
    write_take(store, "hostile", started_at=NOON, **words)
    open_list(page, address)
    row = page.locator("#rows tr")
    expect(row).to_contain_text(HOSTILE)
    page.keyboard.press("l")
    expect(page.get_by_role("dialog")).to_contain_text(HOSTILE)
    assert page.locator("main img").count() == 0
    expect(page).not_to_have_title("1")


def test_lineage_of_a_take(page, address, store, takes):
    lineage = [{"kind": "episode", "id": "take-0-aligned"}, {"kind": "checkpoint", "id": "wm-1"}]
    write_episode(store, "dream", origin="imagined", lineage=lineage)
    open_list(page, address, "?view=episode&text=dream")
    expect(names(page)).to_have_count(1)
    page.keyboard.press("l")
    shown = page.get_by_role("dialog")
    expect(shown.get_by_role("link")).to_have_text(["take-0-aligned", "take-0", "dream"])
    expect(shown).to_contain_text("wm-1")
    page.keyboard.press("Escape")
    expect(shown).to_be_hidden()


class Services:
    """A station with takes to upload and an alignment service, both in states that tests set."""

    def __init__(self):
        self.uploads, self.jobs, self.asked = [], [], []
        self.app = FastAPI()
        self.app.get("/v1/uploads")(lambda: self.uploads)
        self.app.get("/v1/alignments")(self._alignments)
        self.app.post("/v1/alignments")(self._align)

    def _alignments(self):
        return {"alignments": self.jobs, "num_matching": len(self.jobs)}

    def _align(self, wanted: dict):
        self.asked.append(wanted)
        return self._alignments()


def job(state, progress, **more):
    return {"recording_id": "take-9", "state": state, "progress": progress, **more}


def test_a_saved_take_is_one_row_that_moves_on_by_itself(page, serve, store, folder):
    services = Services()
    url = serve(services.app)
    store_url = serve(create_store(EpisodeStoreSettings(store_url=str(folder))))
    settings = DashboardSettings(
        episode_store_url=store_url, acquisition_url=url, alignment_url=url
    )
    services.uploads = [{"recording_id": "take-9", "uploaded": False}]
    open_list(page, serve(create_dashboard(settings)))
    stage = page.locator("#rows tr .stage")
    expect(stage).to_have_text("Uploading")
    expect(names(page)).to_have_text(["take-9"])

    services.uploads = [{"recording_id": "take-9", "uploaded": True}]
    about = {"task": "fold_towel", "started_at": NOON, "success": True}
    recording = write_recording(store, "take-9", **about)
    expect(stage).to_have_text("Not aligned")
    services.jobs = [job("running", 0.43)]
    expect(stage).to_have_text("Aligning, 43 %")
    services.jobs = [job("failed", 0.5, problem={"detail": "no stretch is long enough"})]
    expect(stage).to_contain_text("no stretch is long enough")
    page.keyboard.press("g")
    expect(page.locator("#message")).to_have_text("1 recording given to alignment.")
    assert services.asked == [{"recording_ids": ["take-9"]}]
    services.jobs = [job("waiting", 0.0)]
    expect(stage).to_have_text("Waiting to be aligned")
    source = {"kind": "recording", "id": "take-9", "sha256": recording.content_sha256}
    write_episode(store, "take-9-aligned", origin="recorded", lineage=[source])
    expect(stage).to_have_text("Checked")
    expect(names(page)).to_have_text(["take-9"])
