"""Hours of a real store of toy episodes as bars with numbers, against goals."""

from datetime import UTC, datetime

import pytest
from playwright.sync_api import expect

from dextouch.episodes import EpisodeStore
from dextouch.schemas import Review
from services.dashboard.app import create_app as create_dashboard
from services.dashboard.settings import DashboardSettings
from services.episode_store.app import create_app as create_store
from services.episode_store.settings import EpisodeStoreSettings
from tests.unit.episode_store.episodes import write_episode

NOON = datetime(2026, 5, 4, 12, tzinfo=UTC)
HOSTILE = '<img src=x onerror="document.title=1">'


@pytest.mark.slow
def test_hours_and_goals(page, serve, tmp_path):
    store = EpisodeStore(tmp_path / "store")
    # 90 steps are 6 s, which are 0.1 min.
    for name, task, num_steps, verdict in (
        ("a", "fold", 90, "accepted"),
        ("b", "fold", 180, None),
        ("c", "fold", 90, "rejected"),
        ("d", HOSTILE, 90, None),
    ):
        facts = {"origin": "recorded", "created_at": NOON, "operator": "mika"}
        write_episode(store, name, task=task, num_steps=num_steps, **facts)
        if verdict:
            store.set_review(name, Review(verdict=verdict, reviewed_at=NOON))
    write_episode(store, "t", num_steps=90)
    url = serve(create_store(EpisodeStoreSettings(store_url=str(store.root))))
    goals = {"fold": 0.01, "stack": 2.0}
    address = serve(create_dashboard(DashboardSettings(episode_store_url=url, goal_hours=goals)))

    page.goto(f"{address}/hours")
    rows = page.locator("#task_rows tr")
    expect(rows).to_have_count(3)
    # 18 s that are not rejected are half of the goal of 36 s.
    cells = ["", "0.1 min", "0.2 min", "0.1 min", "0.4 min", "3", "50 % of 0.6 min"]
    expect(rows.filter(has_text="fold").locator("td")).to_have_text(cells)
    expect(rows.filter(has_text=HOSTILE)).to_have_count(1)
    expect(rows.filter(has_text="stack")).to_contain_text("0 % of 2.00 h")
    assert page.locator("main img").count() == 0
    expect(page.locator("#total")).to_have_text(
        "0.4 min in 4 episodes, hours without rejected ones"
    )
    expect(page.locator("#operator_rows tr")).to_have_text(["mika0.1 min0.3 min0.1 min0.5 min4"])
    expect(page.locator("#station_rows tr")).to_contain_text(["not known"])
    expect(page.locator("#day_rows tr")).to_contain_text(["4 May 2026"])
    widths = (
        rows.filter(has_text="fold")
        .locator(".bar_part")
        .evaluate_all("parts => parts.map((part) => part.style.width)")
    )
    assert [width.endswith("%") for width in widths] == [True] * 3

    page.locator("[name=origin]").select_option("twin")
    expect(page.locator("#total")).to_have_text("0.1 min in 1 episode, hours without rejected ones")
    expect(page).to_have_url(f"{address}/hours?origin=twin")
    page.reload()
    expect(page.locator("#total")).to_have_text("0.1 min in 1 episode, hours without rejected ones")
    expect(page.locator("[name=origin]")).to_have_value("twin")
