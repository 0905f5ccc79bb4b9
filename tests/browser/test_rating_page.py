"""A person rates rollouts on the page, by mouse and by keyboard, in a real browser."""

import re

import pytest
from playwright.sync_api import expect

from dextouch.episodes import EpisodeStore
from services.evaluation.rating.app import create_rating_app
from services.evaluation.rating.marks import MarkLog
from services.evaluation.settings import RatingSettings
from tests.unit.evaluation import toy
from tests.unit.evaluation.test_rating_app import RUBRICS
from tests.unit.evaluation.toy_store import write


@pytest.fixture
def settings(tmp_path):
    store = EpisodeStore(str(tmp_path / "store"))
    for seed in (1, 2, 3):
        write(store, toy.demonstration("reach", seed))
    (tmp_path / "rubrics.toml").write_text(RUBRICS)
    return RatingSettings(
        store_url=str(tmp_path / "store"),
        marks=tmp_path / "ratings.sqlite",
        rubrics=tmp_path / "rubrics.toml",
    )


@pytest.mark.slow
def test_a_person_rates_all_rollouts(serve, page, settings):
    problems = []
    page.on("pageerror", lambda error: problems.append(str(error)))
    page.on("console", lambda line: problems.append(line.text) if line.type == "error" else None)
    page.goto(serve(create_rating_app(settings)))
    page.get_by_label("Your name").fill("ada")
    page.get_by_role("button", name="Start").click()
    expect(page.get_by_role("heading", name="Touch the red spot.")).to_be_visible()
    expect(page.locator("#progress")).to_have_text("ada: 0 rated, 3 to go")
    # The picture is really drawn: its canvas has the size of a picture of the server.
    expect(page.locator("canvas")).to_have_attribute("height", "384")
    expect(page.locator("#time")).to_have_text(re.compile(r"^(0\.[3-9]|[1-9])"))

    save = page.get_by_role("button", name="Save and next")
    expect(save).to_be_disabled()
    rows = page.locator(".criterion")
    rows.nth(0).get_by_role("button", name="Yes").click()
    rows.nth(1).get_by_role("button", name="No").click()
    page.get_by_label("Comment").fill("slipped at the end")
    save.click()

    expect(page.locator("#progress")).to_have_text("ada: 1 rated, 2 to go")
    for pressed in ("1", "2", "i", "Enter"):
        page.locator("body").press(pressed)
    expect(page.locator("#progress")).to_have_text("ada: 2 rated, 1 to go")
    page.locator("body").press("c")
    expect(page.locator("#progress")).to_have_text("Everything is rated. Thank you.")

    first, second, third = (stored.mark for stored in MarkLog(settings.marks).history())
    assert first.holds == {"touched": True, "stayed": False}
    assert first.comment == "slipped at the end"
    assert second.holds == {"touched": True, "stayed": True}
    assert second.is_inconsistent
    assert third.cannot_judge
    assert problems == []


@pytest.mark.slow
def test_a_key_that_is_held_down_answers_for_one_rollout(serve, page, settings):
    page.goto(serve(create_rating_app(settings)))
    page.get_by_label("Your name").fill("ada")
    page.get_by_role("button", name="Start").click()
    expect(page.locator("#progress")).to_have_text("ada: 0 rated, 3 to go")
    page.keyboard.down("c")
    expect(page.locator("#progress")).to_have_text("ada: 1 rated, 2 to go")
    # As the keyboard repeats it.
    page.keyboard.down("c")
    for _ in range(3):
        page.keyboard.down("1")
    touched = page.locator(".criterion").nth(0).get_by_role("button", name="Yes")
    expect(touched).to_have_attribute("aria-pressed", "true")
    page.keyboard.up("c")
    page.keyboard.up("1")
    for held in ("2", "Enter"):
        page.keyboard.press(held)
    expect(page.locator("#progress")).to_have_text("ada: 2 rated, 1 to go")
    assert [one.mark.cannot_judge for one in MarkLog(settings.marks).history()] == [True, False]


@pytest.mark.slow
def test_a_wrong_key_is_said_and_the_right_one_opens_the_page(serve, page, settings):
    key = {"name": "ada", "key": "a-key-of-some-length", "scopes": ("rate",)}
    app = create_rating_app(RatingSettings(**settings.model_dump() | {"api_keys": (key,)}))
    page.goto(serve(app))
    page.get_by_label("Your name").fill("ada")
    for typed, says in (("", "no key"), ("a-key-that-nobody-has", "unknown key")):
        page.get_by_label("Key").fill(typed)
        page.get_by_role("button", name="Start").click()
        expect(page.get_by_role("alert")).to_contain_text(says)
    page.get_by_label("Key").fill(key["key"])
    page.get_by_role("button", name="Start").click()
    expect(page.get_by_role("heading", name="Touch the red spot.")).to_be_visible()
    # Pictures and marks carry the key, too.
    expect(page.locator("#time")).to_have_text(re.compile(r"^(0\.[3-9]|[1-9])"))
    page.locator("body").press("c")
    expect(page.locator("#progress")).to_have_text("ada: 1 rated, 2 to go")
    assert MarkLog(settings.marks).history()[0].mark.cannot_judge


@pytest.mark.slow
def test_an_invited_rater_opens_a_link_and_keeps_keys_of_their_own(serve, page, settings):
    key = {"name": "lead", "key": "the-lead's-own-key-4711", "scopes": ("rate_lead",)}
    url = serve(create_rating_app(RatingSettings(**settings.model_dump() | {"api_keys": (key,)})))
    page.goto(f"{url}/lead")
    page.get_by_label("Key").fill(key["key"])
    page.get_by_role("button", name="Show").click()
    expect(page.get_by_role("table", name="agreement")).to_contain_text("0 of 3")
    page.get_by_label("Name").fill("p07")
    page.get_by_role("button", name="Make a link").click()
    expect(page.get_by_role("table", name="raters")).to_contain_text("valid, until")
    link = page.get_by_label("Link, shown only now").input_value()

    page.goto(link)
    expect(page.locator("#progress")).to_have_text("p07: 0 rated, 3 to go")
    page.get_by_text("Keys", exact=True).click()
    # The first criterion by "c", which was another action's: that one gets its key.
    page.get_by_role("button", name="Criterion 1: 1").click()
    page.locator("body").press("c")
    expect(page.get_by_role("button", name="Cannot judge: 1")).to_be_visible()
    expect(page.get_by_role("button", name="Criterion 1: C")).to_be_focused()
    page.reload()
    expect(page.locator(".criterion kbd").first).to_have_text("C")
    for pressed in ("c", "2", "Enter"):
        page.locator("body").press(pressed)
    expect(page.locator("#progress")).to_have_text("p07: 1 rated, 2 to go")
    page.locator("body").press("1")
    expect(page.locator("#progress")).to_have_text("p07: 2 rated, 1 to go")
    first, second = (stored.mark for stored in MarkLog(settings.marks).history())
    assert first.holds == {"touched": True, "stayed": True}
    assert second.cannot_judge

    page.goto(f"{url}/lead")
    page.get_by_label("Key").fill(key["key"])
    page.get_by_role("button", name="Show").click()
    expect(page.get_by_role("table", name="agreement")).to_contain_text("1 of 3")
    page.get_by_role("button", name="Revoke the link of p07").click()
    expect(page.get_by_role("table", name="raters")).to_contain_text("revoked")
    page.goto(link)
    expect(page.get_by_role("alert")).to_contain_text("was revoked or replaced")


@pytest.mark.slow
def test_a_refresh_keeps_what_was_said_and_says_when_it_fails(serve, page, settings):
    key = {"name": "lead", "key": "the-lead's-own-key-4711", "scopes": ("rate_lead",)}
    url = serve(create_rating_app(RatingSettings(**settings.model_dump() | {"api_keys": (key,)})))
    page.clock.install()
    page.goto(f"{url}/lead")
    page.get_by_label("Key").fill(key["key"])
    page.get_by_role("button", name="Show").click()
    page.get_by_label("Name").fill("lead")
    page.get_by_role("button", name="Make a link").click()
    expect(page.get_by_role("alert")).to_contain_text("a key has this name")
    with page.expect_response("**/invitations"):
        page.clock.fast_forward(15_000)
    expect(page.get_by_role("alert")).to_contain_text("a key has this name")
    page.route("**/agreement", lambda route: route.abort())
    page.clock.fast_forward(15_000)
    expect(page.get_by_role("status")).to_contain_text("; not refreshed: ")
