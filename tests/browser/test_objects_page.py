"""Marking objects in first images: clicks, keys and zoom, and that no click is lost."""

import json
import re

import pytest
from playwright.sync_api import expect

from dextouch.episodes import EpisodeStore
from dextouch.schemas import ObjectClicks
from services.dashboard.app import create_app as create_dashboard
from services.dashboard.settings import DashboardSettings
from services.episode_store.app import create_app as create_store
from services.episode_store.settings import EpisodeStoreSettings
from tests.unit.episodes.test_object_clicks import BOTTLE, CUP, TABLE_Z_M, written

NAMES = ("take-0", "take-1", "take-2")
FILE = {"table_z_m": TABLE_Z_M, "tasks": {"stand_bottle": [BOTTLE, CUP]}}
SIDE_PX = 32


@pytest.fixture
def store(tmp_path):
    store = EpisodeStore(tmp_path / "store")
    for name in NAMES:
        written(store, name)
    return store


@pytest.fixture
def address(serve, store, tmp_path):
    path = tmp_path / "objects.json"
    path.write_text(json.dumps(FILE))
    settings = EpisodeStoreSettings(store_url=str(store.root), objects=path)
    return serve(
        create_dashboard(DashboardSettings(episode_store_url=serve(create_store(settings))))
    )


def open_page(page, address):
    page.goto(f"{address}/objects")
    expect(page.locator("#progress")).to_contain_text("of 3 marked")
    ready(page)
    return current(page)


def ready(page):
    page.locator("#image[data-state=shown]").wait_for()


def current(page):
    return re.search(r"take-\d", page.locator("#episode").inner_text())[0]


def click(page, u, v):
    """Click a pixel of the image as a whole."""
    box = page.locator("#image").bounding_box()
    page.mouse.click(box["x"] + u / SIDE_PX * box["width"], box["y"] + v / SIDE_PX * box["height"])


def saved(page):
    expect(page.locator("#message")).to_have_text(re.compile("^Saved"))


def row(page, name):
    return page.locator(f"#objects [data-key={name}]")


@pytest.mark.slow
def test_clicks_are_saved_at_once(page, address, store):
    name = open_page(page, address)
    expect(page.locator("#progress")).to_have_text("0 of 3 marked")
    expect(row(page, "bottle")).to_have_attribute("aria-pressed", "true")
    click(page, 12, 20)
    expect(row(page, "bottle")).to_have_attribute("data-state", "heading")
    expect(row(page, "bottle")).to_contain_text("click farther along its z axis")
    saved(page)
    page.reload()
    ready(page)
    assert current(page) == name
    expect(row(page, "bottle")).to_have_attribute("data-state", "heading")
    click(page, 20, 16)
    expect(row(page, "bottle")).to_have_attribute("data-state", "done")
    # The next object is chosen by itself; a symmetric one has one click.
    expect(row(page, "cup")).to_have_attribute("aria-pressed", "true")
    click(page, 24, 24)
    expect(page.locator("#message")).to_have_text("Saved. Enter goes on.")
    expect(page.locator("#progress")).to_have_text("1 of 3 marked")
    kept = store.clicks(name).objects
    assert kept["bottle"].point_px == pytest.approx((12, 20), abs=0.1)
    assert kept["bottle"].heading_px == pytest.approx((20, 16), abs=0.1)
    assert kept["cup"].point_px == pytest.approx((24, 24), abs=0.1)


@pytest.mark.slow
def test_keys_lead_through_the_episodes(page, address, store):
    name = open_page(page, address)
    click(page, 12, 20)
    click(page, 20, 16)
    click(page, 24, 24)
    expect(page.locator("#progress")).to_have_text("1 of 3 marked")
    page.keyboard.press("Enter")
    ready(page)
    expect(page.locator("#episode")).not_to_contain_text(name)
    second = current(page)
    page.keyboard.press("2")
    page.keyboard.press("h")
    expect(row(page, "cup")).to_contain_text("cannot be seen")
    saved(page)
    page.keyboard.press("a")
    expect(row(page, "bottle")).to_contain_text("not there")
    expect(page.locator("#progress")).to_have_text("2 of 3 marked")
    page.keyboard.press("Backspace")
    expect(row(page, "bottle")).to_have_attribute("data-state", "open")
    expect(row(page, "bottle")).to_have_attribute("aria-pressed", "true")
    saved(page)
    assert {key: one.state for key, one in store.clicks(second).objects.items()} == {
        "cup": "hidden"
    }
    page.keyboard.press("Shift+Enter")
    ready(page)
    expect(page.locator("#episode")).to_contain_text(name)
    expect(row(page, "bottle")).to_contain_text("clicked")
    with page.expect_download() as download:
        page.get_by_role("link", name="Download JSON").click()
    assert download.value.suggested_filename == "clicks.json"
    given = ObjectClicks.model_validate_json(download.value.path().read_bytes())
    assert given.episodes == {key: store.clicks(key) for key in (name, second)}


@pytest.mark.slow
def test_a_pixel_can_be_clicked_where_the_image_is_zoomed(page, address, store):
    name = open_page(page, address)
    box = page.locator("#image").bounding_box()
    x, y = box["x"] + 10.25 / 32 * box["width"], box["y"] + 20.75 / 32 * box["height"]
    page.mouse.move(x, y)
    for _ in range(12):
        page.mouse.wheel(0, -100)
    # Dragging moves the image with the pointer, and is no click.
    page.mouse.down()
    page.mouse.move(x + 40, y - 25, steps=4)
    page.mouse.up()
    page.mouse.click(x + 40, y - 25)
    saved(page)
    # The browser's pointer is at whole pixels, of which the image had about 15 for each of its own.
    assert store.clicks(name).objects["bottle"].point_px == pytest.approx((10.25, 20.75), abs=0.07)
    page.keyboard.press("0")
    click(page, 26, 8)
    expect(row(page, "bottle")).to_have_attribute("data-state", "done")


@pytest.mark.slow
def test_a_refused_click_is_taken_back_and_says_why(page, address, store):
    name = open_page(page, address)
    click(page, 12, 20)
    saved(page)
    click(page, 12.1, 20)
    expect(page.locator("#message")).to_contain_text("mm from point_px")
    expect(row(page, "bottle")).to_have_attribute("data-state", "heading")
    expect(row(page, "bottle")).to_have_attribute("aria-pressed", "true")
    assert store.clicks(name).objects["bottle"].heading_px is None
    click(page, 22, 20)
    saved(page)
    assert store.clicks(name).objects["bottle"].heading_px is not None


@pytest.mark.slow
def test_the_page_fits_a_phone(page, address, store):
    page.set_viewport_size({"width": 390, "height": 844})
    name = open_page(page, address)
    assert page.evaluate("() => document.documentElement.scrollWidth") <= 390
    click(page, 12, 20)
    saved(page)
    page.get_by_role("button", name="Cannot see").click()
    expect(row(page, "bottle")).to_contain_text("cannot be seen")
    page.get_by_role("button", name="Next").click()
    expect(page.locator("#episode")).not_to_contain_text(name)


@pytest.mark.slow
def test_without_a_file_of_objects_the_page_says_how(page, serve, store):
    url = serve(create_store(EpisodeStoreSettings(store_url=str(store.root))))
    page.goto(serve(create_dashboard(DashboardSettings(episode_store_url=url))) + "/episodes")
    page.get_by_role("link", name="Mark objects").click()
    expect(page.get_by_role("alert")).to_contain_text("DEXTOUCH_EPISODE_STORE_OBJECTS")
