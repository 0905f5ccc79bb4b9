"""The recorder as an operator's instrument: keys alone, pedal, counter, reset, sounds, verdict."""

import json

import httpx
import pytest
from fastapi import FastAPI
from playwright.sync_api import expect

from dextouch.episodes.spool import SpoolReader
from services.dashboard.app import create_app as create_dashboard
from services.dashboard.settings import DashboardSettings

HOSTILE = "<img src=x onerror=\"document.title='owned'\">'\"&lt;b&gt;"
# Stands in for the browser's audio: every tone that would be heard, in Hz.
FAKE_AUDIO = """
window.tones = [];
const silent = { setValueAtTime() {}, linearRampToValueAtTime() {} };
window.AudioContext = class { currentTime = 0; state = "running"; destination = {}; resume() {} };
window.GainNode = class { gain = silent; connect(next) { return next; } };
window.OscillatorNode = class {
  constructor(context, { frequency }) { this.frequency = frequency; }
  connect(next) { return next; }
  start() { window.tones.push(this.frequency); }
  stop() {}
};
"""


@pytest.fixture
def spool(tmp_path):
    return tmp_path / "spool"


@pytest.fixture
def station(serve_station, spool):
    """Address of a station with two mock trackers."""
    return serve_station(spool)


@pytest.fixture
def open_dashboard(page, serve, station):
    """Open a dashboard over the station with these settings."""

    def start(**settings):
        page.goto(serve(create_dashboard(DashboardSettings(acquisition_url=station, **settings))))
        expect(state(page)).to_have_text("idle")

    return start


def state(page):
    return page.locator("#recorder_state")


def press(page, key, until):
    """Press a key; once more where it asks whether it is meant."""
    asks = page.locator("#recorder_message").filter(has_text="Once more within three seconds")
    page.keyboard.press(key)
    expect(state(page).filter(has_text=until).or_(asks)).not_to_have_count(0)
    if state(page).text_content() != until:
        page.keyboard.press(key)
    expect(state(page)).to_have_text(until)


def take(page):
    for key, until in (("a", "armed"), ("r", "recording"), ("s", "checking")):
        press(page, key, until)
        if until == "recording":
            expect(page.locator("#recorder_clock")).not_to_have_text("0:00.0")


def save(page, outcome="y"):
    page.keyboard.press(outcome)
    press(page, "v", "saved")


def tab_to(page, selector):
    for _ in range(60):
        page.keyboard.press("Tab")
        if page.evaluate("(selector) => document.activeElement.matches(selector)", selector):
            return
    raise AssertionError(f"Tab does not reach {selector}")


def saved_takes(spool):
    takes = [SpoolReader(path) for path in sorted(spool.iterdir()) if path.is_dir()]
    return [one.attributes for one in takes if one.closed]


def test_a_session_by_keyboard_alone(page, open_dashboard, spool):
    open_dashboard()
    tab_to(page, "#task_choice")
    page.keyboard.press("ArrowDown")
    tab_to(page, "#operator")
    page.keyboard.type("p7")
    tab_to(page, "#consent")
    page.keyboard.press("Space")
    page.keyboard.press("Escape")

    take(page)
    expect(page.locator("#verdict_word")).to_be_visible()
    press(page, "d", "discarded")
    take(page)
    expect(page.locator("input[name=outcome]:checked")).to_have_count(0)
    page.keyboard.press("y")
    press(page, "g", "armed")
    press(page, "r", "recording")
    press(page, "s", "checking")
    expect(page.locator("input[name=outcome]:checked")).to_have_count(0)
    page.keyboard.press("v")
    expect(page.locator("#recorder_message")).to_contain_text("How did this take end?")
    save(page, "n")

    (kept,) = saved_takes(spool)
    # The second task of the list, as the twin words it.
    assert (kept.task, kept.instruction) == (
        "stack_bowls",
        "Lift the left bowl with both hands and stack it into the right bowl.",
    )
    assert (kept.operator, kept.consent, kept.success) == ("p7", True, False)


@pytest.mark.slow
def test_takes_are_counted_against_a_goal(page, open_dashboard, spool, tmp_path):
    tasks = tmp_path / "tasks.toml"
    tasks.write_text(
        '[[tasks]]\nname = "wipe"\ninstructions = ["Wipe it.", "Wipe it dry."]\ngoal = 2\n'
        '[[tasks]]\nname = "fold"\ninstructions = ["Fold it."]\n'
    )
    open_dashboard(task_file=tasks, takes_goal=9)
    count = page.locator("#num_saved")
    page.locator("#operator").fill("p7")
    page.keyboard.press("Escape")
    expect(count).to_have_text("0 / 2")
    take(page)
    save(page)
    expect(count).to_have_text("1 / 2")
    page.reload()
    expect(count).to_have_text("1 / 2")
    take(page)
    press(page, "d", "discarded")
    expect(count).to_have_text("1 / 2")
    take(page)
    save(page)
    expect(page.locator("#count")).to_contain_text("goal reached · wipe · p7")
    page.locator("#operator").fill("p8")
    expect(count).to_have_text("0 / 2")
    page.locator("#task_choice").select_option("fold")
    expect(count).to_have_text("0 / 9")
    page.locator("#task_choice").select_option("wipe")
    page.locator("#operator").fill("p7")
    expect(count).to_have_text("2 / 2")
    assert len(saved_takes(spool)) == 2
    tab_to(page, "button[data-action=session]")
    page.keyboard.press("Enter")
    expect(page.locator("#recorder_message")).to_contain_text("Count the saved takes from zero?")
    page.keyboard.press("Enter")
    expect(count).to_have_text("0 / 2")
    assert len(saved_takes(spool)) == 2


@pytest.mark.slow
def test_after_the_reset_the_next_take_is_armed(page, open_dashboard):
    open_dashboard(reset_s=2)
    page.get_by_label("Arm again after the reset").check()
    take(page)
    save(page)
    expect(page.locator("#reset")).to_contain_text("to reset")
    expect(state(page)).to_have_text("armed")
    expect(page.locator("#reset")).to_be_hidden()


@pytest.mark.slow
def test_a_reset_is_skipped_and_outlives_a_reload(page, open_dashboard):
    open_dashboard(reset_s=3600)
    take(page)
    save(page)
    left = page.locator("#reset_left")
    expect(left).to_have_text("3599 s")
    page.reload()
    expect(left).not_to_have_text("0 s")
    page.keyboard.press("k")
    expect(page.locator("#reset")).to_be_hidden()
    expect(state(page)).to_have_text("saved")
    page.get_by_label("Arm again after the reset").check()
    take(page)
    save(page)
    expect(page.locator("#reset")).to_be_visible()
    page.keyboard.press("k")
    expect(state(page)).to_have_text("armed")


@pytest.mark.slow
def test_a_pedal_is_the_next_step(page, open_dashboard, spool):
    open_dashboard()
    button = page.locator("#pedal")
    button.click()
    expect(button).to_have_text("Press your pedal now")
    page.keyboard.press("r")
    expect(page.locator("#recorder_message")).to_contain_text("R has another meaning")
    expect(state(page)).to_have_text("idle")
    page.keyboard.press("F9")
    expect(button).to_have_text("Pedal: F9")
    page.reload()
    expect(button).to_have_text("Pedal: F9")
    expect(state(page)).to_have_text("idle")
    # Also from a field, where letters are text.
    page.locator("#operator").focus()
    for until in ("armed", "recording", "checking"):
        page.keyboard.press("F9")
        expect(state(page)).to_have_text(until)
    page.keyboard.press("F9")
    expect(page.locator("#recorder_message")).to_contain_text("How did this take end?")
    expect(state(page)).to_have_text("checking")
    page.keyboard.press("u")
    press(page, "F9", "saved")
    assert [one.success for one in saved_takes(spool)] == [None]


@pytest.mark.slow
def test_a_pedal_that_sends_space_presses_no_button(page, open_dashboard):
    open_dashboard()
    page.locator("#pedal").click()
    page.keyboard.press("Space")
    expect(page.locator("#pedal")).to_have_text("Pedal: Space")
    page.locator("#sounds").focus()
    page.keyboard.press("Space")
    expect(state(page)).to_have_text("armed")
    expect(page.locator("#sounds")).to_have_text("Sounds: off")
    page.locator("#operator").focus()
    page.keyboard.press("Space")
    expect(page.locator("#operator")).to_have_value(" ")
    expect(state(page)).to_have_text("armed")


@pytest.mark.slow
def test_keys_work_in_a_list_and_after_typing(page, open_dashboard):
    open_dashboard()
    chosen = page.locator("#task_choice")
    chosen.focus()
    # "s" would choose stack_bowls by its first letter, "a" and "r" are keys of the recorder.
    page.keyboard.press("s")
    expect(chosen).to_have_value("stand_bottle")
    page.keyboard.press("a")
    expect(state(page)).to_have_text("armed")
    page.locator("#task_choice").select_option("")
    page.keyboard.type("dry a rag")
    expect(state(page)).to_have_text("armed")
    expect(page.locator("#task")).to_have_value("stand_bottledry a rag")
    page.keyboard.press("Escape")
    page.keyboard.press("a")
    expect(page.locator("#recorder_message")).to_have_text("Record: R")
    page.keyboard.press("r")
    expect(state(page)).to_have_text("recording")
    page.keyboard.press("?")
    expect(page.locator("#keys")).to_be_visible()
    page.keyboard.press("s")
    page.keyboard.press("Escape")
    expect(page.locator("#keys")).to_be_hidden()
    expect(state(page)).to_have_text("recording")
    press(page, "s", "checking")


@pytest.mark.slow
def test_sounds_are_heard_once_they_are_allowed(page, open_dashboard):
    page.add_init_script(FAKE_AUDIO)
    open_dashboard()
    take(page)
    press(page, "d", "discarded")
    assert page.evaluate("tones") == []
    page.locator("#sounds").click()
    expect(page.locator("#sounds")).to_have_text("Sounds: on")
    page.reload()
    expect(page.locator("#sounds")).to_have_text("Sounds: on")
    expect(state(page)).to_have_text("discarded")
    press(page, "a", "armed")
    assert page.evaluate("tones") == []
    press(page, "r", "recording")
    # What health reports of a busy machine sounds like a problem, too.
    assert [tone for tone in page.evaluate("tones") if tone != 185] == [660, 990]
    press(page, "s", "checking")
    save(page)
    heard = [tone for tone in page.evaluate("tones") if tone != 185]
    # An incomplete take sounds like a problem in place of its stop.
    assert heard[2:] in ([880, 440, 523, 659, 784], [523, 659, 784])


def test_a_hostile_prompt_stays_text(page, open_dashboard, station, tmp_path):
    tasks = tmp_path / "tasks.toml"
    quoted = json.dumps(HOSTILE)
    tasks.write_text(f"[[tasks]]\nname = {quoted}\ninstructions = [{quoted}]\n")
    open_dashboard(task_file=tasks)
    expect(page.locator("#task_choice")).to_have_value(HOSTILE)
    expect(page.locator("#instruction_choice")).to_have_value(HOSTILE)
    expect(page.locator("#count_of")).to_contain_text(HOSTILE)
    other = f"other {HOSTILE}"
    body = {"task": other, "instruction": other, "operator": HOSTILE}
    httpx.post(f"{station}/v1/recorder/arm", json=body, timeout=30).raise_for_status()
    expect(page.locator("#task")).to_have_value(other)
    expect(page.locator("#instruction")).to_have_value(other)
    expect(page.locator("#count_of")).to_contain_text(other)
    assert page.locator("#recorder img").count() == 0
    assert "owned" not in page.title()


@pytest.mark.slow
def test_the_verdict_has_three_lines_and_the_rest_is_folded(page, serve):
    found = [
        {"stream": f"s{i}", "code": "gap", "level": "ERROR", "message": f"s{i}: {i} s missing"}
        for i in range(12)
    ]
    cause = {"message": "USB hub 1-2: nothing comes from a, b", "advice": "Plug the hub in again."}
    check = {"complete": False, "duration_s": 5, "streams": [], "problems": found, "cause": cause}
    recorder = {"state": "checking", "actions": ["save", "discard"], "recording_id": "take-7"}
    recorder |= {"problems": [item["message"] for item in found], "check": check}
    health = {"station": "desk", "level": "OK", "streams": [], "devices": []}
    fake = FastAPI()
    fake.get("/v1/recorder")(lambda: recorder)
    fake.get("/v1/health")(lambda: health)
    page.goto(serve(create_dashboard(DashboardSettings(acquisition_url=serve(fake)))))
    shown = page.locator("#verdict > p")
    expect(shown).to_have_text(["Incomplete", cause["message"], cause["advice"]])
    expect(page.locator("#recorder_note")).to_have_text("take-7 · 12 findings")
    one = page.get_by_text("s11: 11 s missing")
    expect(one).to_be_hidden()
    tab_to(page, "#recorder_problems summary")
    page.keyboard.press("Enter")
    expect(one).to_be_visible()
