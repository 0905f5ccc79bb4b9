"""Notes, trims and relabels in the player: what is shown before, what is in the store after."""

import pytest
from playwright.sync_api import expect

from dextouch.episodes import EpisodeStore
from services.dashboard.app import create_app as create_dashboard
from services.dashboard.settings import DashboardSettings
from services.episode_store.app import create_app as create_store
from services.episode_store.settings import EpisodeStoreSettings
from tests.unit.episode_store.episodes import write_episode, write_recording

HOSTILE = '<img src=x onerror="document.title=1">'


@pytest.fixture
def store(tmp_path):
    store = EpisodeStore(tmp_path / "store")
    write_episode(store, "take", num_steps=31, operator="p-1")
    write_recording(store, "raw", num_samples=90, started_t_host_ns=-500_000_000)
    return store


@pytest.fixture
def address(serve, store):
    url = serve(create_store(EpisodeStoreSettings(store_url=str(store.root))))
    return serve(create_dashboard(DashboardSettings(episode_store_url=url)))


def opened(page, address, item):
    page.goto(f"{address}/episodes/{item}")
    expect(page.locator("#deck")).to_be_visible()


def seek(page, seconds):
    page.locator("#timeline").focus()
    page.keyboard.press("Home")
    for _ in range(seconds):
        page.keyboard.press("Shift+ArrowRight")


@pytest.mark.slow
def test_a_selection_is_trimmed_after_a_preview(page, address, store):
    opened(page, address, "episode/take")
    expect(page.locator("#open_trim")).to_be_disabled()
    seek(page, 1)
    page.keyboard.press("[")
    expect(page.locator("#selection")).to_have_text("1 \N{EN DASH} 2 s")
    page.locator("#open_trim").click()
    dialog = page.locator("#edit_dialog")
    expect(dialog).to_contain_text("steps 15 to 30")
    expect(dialog.locator(".preview")).to_contain_text("Becomes take-trimmed-1")
    expect(dialog.locator("code")).to_have_text("dextouch store trim take --steps 15 31")
    assert store.list() == ["take"]
    dialog.get_by_label("Keep the source").check()
    expect(dialog.locator("code")).to_have_text("dextouch store trim take --steps 15 31 --keep")
    dialog.get_by_role("button", name="Trim to selection").click()
    dialog.locator("a.result").click()
    page.wait_for_url("**/episodes/episode/take-trimmed-1")
    assert store.list() == ["take", "take-trimmed-1"]
    assert store.open("take-trimmed-1").num_steps == 16


@pytest.mark.slow
def test_an_answer_to_an_earlier_dialog_is_not_written_into_the_next(page, address):
    held = []

    def hold(route):
        held.append(route)

    page.route("**/catalog/relabel", hold)
    opened(page, address, "episode/take")
    page.locator("#open_relabel").click()
    dialog = page.locator("#edit_dialog")
    dialog.get_by_role("button", name="Cancel").click()
    seek(page, 1)
    page.keyboard.press("]")
    page.locator("#open_trim").click()
    preview = dialog.locator(".preview")
    expect(preview).to_contain_text("its end is cut off")
    becomes = {"id": "other", "source_is": "kept", "messages": []}
    with page.expect_response("**/catalog/relabel"):
        held[0].fulfill(json={"edited": [becomes], "refused": []})
    page.wait_for_timeout(100)
    expect(preview).to_contain_text("its end is cut off")
    expect(dialog.get_by_role("button", name="Trim to selection")).to_be_disabled()


@pytest.mark.slow
def test_space_presses_the_button_that_has_the_focus(page, address):
    opened(page, address, "episode/take")
    # Beside the slider, which can have no controls in it.
    expect(page.locator("[role=slider] button")).to_have_count(0)
    streams = page.get_by_role("button", name="Streams")
    was_open = streams.get_attribute("aria-expanded") == "true"
    streams.focus()
    page.keyboard.press("Space")
    expect(streams).to_have_attribute("aria-expanded", str(not was_open).lower())
    expect(page.locator("#play_text")).to_have_text("Play")


@pytest.mark.slow
def test_a_browser_that_keeps_nothing_shows_the_pages(page, address):
    problems = []
    page.on("pageerror", lambda error: problems.append(str(error)))
    page.add_init_script(
        "Storage.prototype.getItem = Storage.prototype.setItem = () => { throw new Error('none') }"
    )
    opened(page, address, "episode/take")
    streams = page.get_by_role("button", name="Streams")
    was_open = streams.get_attribute("aria-expanded") == "true"
    streams.click()
    expect(streams).to_have_attribute("aria-expanded", str(not was_open).lower())
    page.locator("#theme").click()
    expect(page.locator("#theme_name")).to_have_text("light")
    page.get_by_role("region", name="Action").hover()
    page.get_by_role("button", name="Hide Action").click()
    expect(page.get_by_role("region", name="Action")).to_be_hidden()
    page.goto(address)
    expect(page.locator("#prompt")).to_be_visible()
    page.locator("#theme").click()
    page.locator("#sounds").click()
    expect(page.locator("#sounds")).to_have_text("Sounds: on")
    assert problems == []


@pytest.mark.slow
def test_an_end_that_is_cut_off_needs_an_outcome(page, address, store):
    opened(page, address, "episode/take")
    seek(page, 1)
    page.keyboard.press("]")
    page.locator("#open_trim").click()
    dialog = page.locator("#edit_dialog")
    apply = dialog.get_by_role("button", name="Trim to selection")
    expect(dialog.locator(".preview")).to_contain_text("its end is cut off")
    expect(apply).to_be_disabled()
    dialog.locator("[name=outcome]").select_option("failure")
    apply.click()
    expect(dialog).to_contain_text("To undo this, delete take-trimmed-1 and restore take")
    assert store.list() == ["take-trimmed-1"]
    assert store.open("take-trimmed-1").attributes.success is False


@pytest.mark.slow
def test_notes_are_drawn_jumped_to_and_removed(page, address, store):
    opened(page, address, "recording/raw")
    expect(page.locator("#open_trim")).to_be_hidden()
    page.evaluate("document.title = 'kept'")
    page.locator("#zoom_fit").click()
    page.keyboard.press("End")
    page.keyboard.press("n")
    dialog = page.locator("#edit_dialog")
    dialog.locator("[name=text]").fill(HOSTILE)
    dialog.locator("[name=author]").fill("p-7")
    dialog.get_by_role("button", name="Add").click()
    expect(page.locator("#note_rows .note_text")).to_have_text(HOSTILE)
    expect(page.locator(".note_mark")).to_have_count(1)
    (note,) = store.notes("raw", kind="recording").notes
    assert (note.start_ns, note.author) == (89 * 33_333_333, "p-7")
    expect(dialog).to_be_hidden()
    at_note = page.locator("#clock").get_attribute("title")
    page.keyboard.press("Home")
    expect(page.locator("#clock")).not_to_have_attribute("title", at_note)
    page.locator("#note_rows button").first.click()
    expect(page.locator("#clock")).to_have_attribute("title", at_note)
    page.get_by_label("remove note 1").click()
    expect(page.locator("#notes")).to_be_hidden()
    assert page.title() == "kept"
    assert store.notes("raw", kind="recording").notes == ()


@pytest.mark.slow
def test_a_relabel_changes_what_was_typed_and_nothing_else(page, address, store):
    opened(page, address, "episode/take")
    page.locator("#open_relabel").click()
    dialog = page.locator("#edit_dialog")
    expect(dialog.locator(".preview")).to_contain_text("nothing changes")
    dialog.locator("[name=instruction]").fill("it's up")
    dialog.locator("[name=instruction]").blur()
    expect(dialog.locator("code")).to_have_text(
        r"""dextouch store relabel take --instruction 'it'\''s up'"""
    )
    dialog.get_by_role("button", name="Relabel").click()
    expect(dialog.locator("a.result")).to_have_text("take-relabelled-1")
    about = store.open("take-relabelled-1").attributes
    assert (about.instruction, about.operator, about.task) == ("it's up", "p-1", "stand_bottle")
    assert store.list() == ["take-relabelled-1"]
