"""An operator reads a study in a real browser: the tables show what scipy and plain loops count."""

import re
from urllib.parse import parse_qs, urlsplit

import pytest
from playwright.sync_api import expect

from services.dashboard.app import create_app
from services.dashboard.settings import DashboardSettings
from services.evaluation.settings import StudyServiceSettings
from services.evaluation.studies.app import create_app as create_studies
from tests.unit.evaluation.study_rows import (
    DEFINITION,
    ROWS,
    UNRELIABLE,
    WORLDS,
    counted,
    disagreements,
    interval,
    kendall,
    lines,
    mmrv,
    pearson,
    write_study,
)


@pytest.fixture
def root(tmp_path):
    write_study(tmp_path / "studies" / "touch", unfinished=("blurred",))
    return tmp_path / "studies"


@pytest.fixture
def address(serve, root):
    studies = serve(create_studies(StudyServiceSettings(studies=root)))
    return serve(create_app(DashboardSettings(studies_url=studies)))


@pytest.fixture
def opened(page, address):
    problems = []
    page.on("pageerror", lambda error: problems.append(str(error)))
    page.goto(f"{address}/studies")
    yield page
    assert problems == []


def finish(root):
    text = "".join(line + "\n" for line in lines())
    (root / "touch" / "results.jsonl").write_text(text, encoding="utf-8")


def figures_of(text):
    return [float(found) for found in re.findall(r"-?\d+\.\d\d", text)]


def test_a_study_that_runs_and_ends(opened, root):
    row = opened.locator("#study_rows tr")
    expect(row).to_contain_text("96 of 144")
    expect(row).to_contain_text("incomplete")
    opened.get_by_role("link", name="touch and sight").click()
    cell = opened.locator("tr[data-task=stand_bottle][data-policy=hold] [data-world=blurred]")
    expect(cell).to_contain_text("8 of 8 have no result yet")
    finish(root)
    expect(opened.locator("#study_state")).to_contain_text("143 of 144")
    expect(cell).to_contain_text("0.25")

    for task, policies in ROWS.items():
        for policy in policies:
            for world in WORLDS:
                place = f"tr[data-task={task}][data-policy={policy}] [data-world={world}]"
                shown = figures_of(opened.locator(f"{place} .cell_link").inner_text())
                successes, trials = counted(task, policy, world)
                expected = [successes / trials, *interval(task, policy, world)]
                assert shown == pytest.approx(expected, abs=0.0051)
    for task in ROWS:
        for world in WORLDS[1:]:
            place = f"#agreement tr[data-task={task}][data-world={world}]"
            for name, expected in (("pearson", pearson), ("kendall", kendall), ("mmrv", mmrv)):
                shown = opened.locator(f"{place} [data-figure={name}] strong").inner_text()
                assert float(shown) == pytest.approx(expected(task, world), abs=0.0051)


def test_two_policies_are_shown_without_a_correlation(opened, root, monkeypatch):
    for task, policies in ROWS.items():
        monkeypatch.setitem(ROWS, task, {name: policies[name] for name in ("careful", "clumsy")})
    policies = {name: {"script": "hold"} for name in ("careful", "clumsy")}
    monkeypatch.setitem(DEFINITION, "policies", policies)
    monkeypatch.setitem(DEFINITION, "name", "two alone")
    write_study(root / "two")
    opened.reload()
    opened.get_by_role("link", name="two alone").click()
    for task in (*ROWS, ""):
        row = opened.locator(f"#agreement tr[data-task='{task}'][data-world=model]")
        expect(row.locator("[data-figure=pearson]")).to_contain_text("undefined (2 policies)")
        expect(row.locator("[data-figure=mean_absolute_error] strong")).to_have_text(
            re.compile(r"0\.\d\d")
        )


@pytest.mark.slow
def test_what_cannot_be_trusted_is_said_beside_the_number(opened, root):
    finish(root)
    opened.get_by_role("link", name="touch and sight").click()
    unreliable = opened.locator("tr[data-task=stand_bottle][data-policy=hold] [data-world=model]")
    # Text of a result stays text.
    expect(unreliable).to_contain_text(f"1 of 8 cannot tell: {UNRELIABLE}")
    failed = opened.locator("tr[data-task=open_drawer][data-policy=hold] [data-world=real]")
    expect(failed).to_contain_text("1 of 8 failed to run and are not counted")


@pytest.mark.slow
def test_the_picture_is_that_of_the_last_choice(opened, root):
    finish(root)
    opened.get_by_role("link", name="touch and sight").click()
    picture, task = opened.locator("#picture"), opened.locator("#picture_task")
    expect(picture).to_contain_text("all tasks")
    late = []

    def hold(route):
        late.append(route)

    opened.route("**/picture?*task=stand_bottle*", hold)
    with opened.expect_request("**/picture?*task=stand_bottle*"):
        task.select_option("stand_bottle")
    task.select_option("open_drawer")
    expect(picture).to_contain_text("open drawer")
    with opened.expect_response("**/picture?*task=stand_bottle*"):
        late[0].continue_()
    opened.evaluate("new Promise(requestAnimationFrame)")
    expect(picture).to_contain_text("open drawer")
    opened.unroute("**/picture?*task=stand_bottle*")
    problem = {"detail": "the study was moved"}
    opened.route("**/picture?*", lambda route: route.fulfill(status=404, json=problem))
    task.select_option("stand_bottle")
    expect(picture).to_have_text("the study was moved")


@pytest.mark.slow
def test_rates_are_sorted_by_any_column(opened, root):
    finish(root)
    opened.get_by_role("link", name="touch and sight").click()
    opened.get_by_role("button", name="model (imagined)").click()
    for reverse in (True, False):
        shown = opened.locator("#rates tbody [data-world=model] strong").all_inner_texts()
        rates = [counted(t, p, "model") for t, policies in ROWS.items() for p in policies]
        expected = sorted((won / decided for won, decided in rates), reverse=reverse)
        assert [float(text) for text in shown] == pytest.approx(expected, abs=0.0051)
        opened.get_by_role("button", name="model (imagined)").click()


@pytest.mark.slow
def test_disagreements_come_first_and_every_cell_leads_to_its_rollouts(opened, root):
    finish(root)
    opened.get_by_role("link", name="touch and sight").click()
    expected = disagreements()
    note = opened.locator("#rollouts_note")
    expect(note).to_contain_text(f"{len(expected)} of {len(expected)} outcomes that differ")
    expect(note).to_contain_text("run the study with --store")
    rows = opened.locator("#rollouts tbody tr")
    expect(rows).to_have_count(len(expected))
    opened.locator("tr[data-task=open_drawer][data-policy=hold] [data-world=real] button").click()
    expect(rows).to_have_count(8)
    expect(rows.filter(has_text="UnavailableError: no answer")).to_have_count(1)
    opened.get_by_role("button", name="All", exact=True).click()
    expect(rows).to_have_count(50)
    opened.get_by_role("button", name="Show more").click()
    expect(rows).to_have_count(100)


@pytest.mark.slow
def test_rollouts_in_the_dashboards_store_are_linked(page, address, root):
    finish(root)
    requests = []

    def stored(route):
        requests.append(route.request.url)
        ids = parse_qs(urlsplit(route.request.url).query)["id"]
        route.fulfill(json={"items": [{"id": one} for one in ids if "-real-" in one]})

    page.route("**/v1/episode_store/**", stored)
    page.goto(f"{address}/studies/touch")
    row = page.locator("#rollouts tbody tr").first
    link = row.get_by_role("link", name="Play real")
    expect(link).to_have_attribute("href", re.compile("^/episodes/episode/rollout-.*-real-"))
    # What is not stored is neither linked nor requested on its own, which logged a 404 each.
    expect(row.get_by_role("link", name=re.compile("^Play (?!real)"))).to_have_count(0)
    assert len(requests) == 1
    assert "/catalog/items?kind=episode&" in requests[0]


@pytest.mark.slow
def test_unknown_studies_are_named(page, address):
    page.goto(f"{address}/studies/none")
    expect(page.locator("#study_note")).to_contain_text("no results in")


@pytest.mark.slow
def test_the_rating_page_is_in_the_navigation_where_it_is_configured(page, serve):
    page.goto(serve(create_app(DashboardSettings(rating_url="http://127.0.0.1:8087"))))
    link = page.get_by_role("link", name="Rating")
    expect(link).to_have_attribute("href", "http://127.0.0.1:8087")
    page.goto(serve(create_app(DashboardSettings())))
    expect(page.get_by_role("link", name="Rating")).to_have_count(0)
