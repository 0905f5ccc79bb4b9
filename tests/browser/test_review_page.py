"""The review queue over a real store of toy takes: what is listed, verdicts by keys, and memory."""

from datetime import UTC, datetime, timedelta

import pytest
from fastapi import FastAPI
from playwright.sync_api import expect

from dextouch.episodes import EpisodeStore, is_rejected
from services.dashboard.app import create_app as create_dashboard
from services.dashboard.settings import DashboardSettings
from services.episode_store.app import create_app as create_store
from services.episode_store.settings import EpisodeStoreSettings
from tests.unit.episode_store.episodes import write_recording, write_take

NOON = datetime(2026, 5, 4, 12, tzinfo=UTC)
HOSTILE = '<img src=x onerror="document.title=1">'


@pytest.fixture
def store(tmp_path):
    """Ten usual takes of a task, one far too long, one not judged; two takes of a hostile task."""
    store = EpisodeStore(tmp_path / "store")
    for number in range(10):
        at = NOON - timedelta(minutes=number)
        write_take(store, f"take-{number}", num_steps=30 + number % 3, success=True, started_at=at)
    write_take(store, "long", num_steps=200, success=True, started_at=NOON)
    write_take(store, "open", num_steps=31, success=None, started_at=NOON)
    for name in ("odd-0", "odd-1"):
        write_take(store, name, success=None, task=HOSTILE, instruction=HOSTILE, started_at=NOON)
    return store


@pytest.fixture
def alignment():
    """Failed jobs of an alignment service."""
    app, app.jobs = FastAPI(), []
    app.get("/v1/alignments")(lambda: {"alignments": app.jobs, "num_matching": len(app.jobs)})
    return app


@pytest.fixture
def address(serve, store, alignment):
    url = serve(create_store(EpisodeStoreSettings(store_url=str(store.root))))
    settings = DashboardSettings(episode_store_url=url, alignment_url=serve(alignment))
    return serve(create_dashboard(settings))


def names(page):
    return page.locator("#rows .item_name")


@pytest.mark.slow
def test_what_is_unusual_comes_first_and_leaves_with_a_verdict(page, address, store):
    page.goto(f"{address}/review")
    expect(names(page)).to_have_text(["long", "open", "odd-1", "odd-0"])
    expect(page.locator("#rows tr").first).to_contain_text("duration 13.3 s, usually 2.07 s")
    expect(page.locator("#few")).to_contain_text(
        f"at least 8 are needed: {HOSTILE} (2 human episodes)"
    )
    assert page.locator("main img").count() == 0
    expect(page).not_to_have_title("1")
    page.get_by_label("Reviewer").fill("mika")
    page.keyboard.press("Escape")

    page.keyboard.press("r")
    dialog = page.get_by_role("dialog")
    expect(dialog).to_contain_text("Reject long")
    page.keyboard.press("3")
    page.keyboard.press("Enter")
    expect(names(page)).to_have_text(["open", "odd-1", "odd-0"])
    review = store.review("long-aligned")
    assert (review.verdict, review.reviewer) == ("rejected", "mika")
    assert review.reason == "a sensor failed or lost samples"
    assert is_rejected(store, store.open("long-aligned").attributes)

    page.keyboard.press("a")
    expect(names(page)).to_have_text(["odd-1", "odd-0"])
    assert store.review("open-aligned").verdict == "accepted"
    page.reload()
    expect(names(page)).to_have_text(["odd-1", "odd-0"])
    expect(page.get_by_label("Reviewer")).to_have_value("mika")


@pytest.mark.slow
def test_the_first_take_of_a_task_is_listed_with_why_it_is_incomplete(page, address, store):
    cause = "camera_head: 2.10 s without a sample, expected at most 0.5 s"
    about = {"task": "first_of_all", "success": True, "started_at": NOON}
    write_take(store, "torn", num_steps=30, complete=False, incomplete_cause=cause, **about)
    page.goto(f"{address}/review?task=first_of_all")
    expect(names(page)).to_have_text(["torn"])
    expect(page.locator("#rows tr").first).to_contain_text(f"incomplete: {cause}")
    page.goto(f"{address}/episodes?task=first_of_all")
    stage = page.locator("#rows tr .stage")
    expect(stage).to_contain_text("Incomplete")
    expect(stage).not_to_contain_text("Checked")


@pytest.mark.slow
def test_many_are_rejected_for_a_reason_of_ones_own_and_taken_back(page, address, store):
    page.goto(f"{address}/review")
    expect(names(page)).to_have_count(4)
    page.keyboard.press("Control+a")
    page.keyboard.press("r")
    expect(page.get_by_role("dialog")).to_contain_text("Reject 4 items")
    page.keyboard.press("5")
    page.keyboard.type("3 takes of a demo")
    page.keyboard.press("Enter")
    expect(page.locator("#empty")).to_be_visible()
    rejected = ["long", "odd-0", "odd-1", "open"]
    assert {store.review(f"{name}-aligned").reason for name in rejected} == {"3 takes of a demo"}
    page.keyboard.press("z")
    expect(names(page)).to_have_count(4)
    assert [store.review(f"{name}-aligned") for name in rejected] == [None] * 4


@pytest.mark.slow
def test_nothing_is_rejected_without_a_reason(page, address, store):
    page.goto(f"{address}/review")
    expect(names(page)).to_have_count(4)
    page.keyboard.press("r")
    page.keyboard.press("5")
    page.keyboard.press("Enter")
    expect(page.get_by_role("dialog")).to_be_visible()
    page.keyboard.press("Escape")
    expect(page.get_by_role("dialog")).to_be_hidden()
    expect(names(page)).to_have_count(4)
    assert store.review("long-aligned") is None


@pytest.mark.slow
def test_recordings_that_could_not_be_aligned(page, address, store, alignment):
    write_recording(store, "raw", success=True, started_at=NOON)
    problem = {"detail": "recording 'raw': streams ['head'] are missing"}
    alignment.jobs = [
        {"recording_id": name, "state": "failed", "progress": 0.0, "problem": problem}
        for name in ("deleted", "raw")
    ]
    page.goto(f"{address}/review?task=stand_bottle")
    expect(names(page)).to_have_text(["raw", "long", "open"])
    first = page.locator("#rows tr").first
    expect(first).to_contain_text("alignment failed: streams ['head'] are missing")
    page.keyboard.press("r")
    page.keyboard.press("Enter")
    expect(names(page)).to_have_text(["long", "open"])
    assert store.review("raw", kind="recording").verdict == "rejected"
