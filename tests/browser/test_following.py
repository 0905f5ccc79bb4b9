"""The line on each hand's card: whether the robot's hand can follow, and one sound if it cannot."""

import pytest
from fastapi import FastAPI
from playwright.sync_api import expect

from services.dashboard.app import create_app as create_dashboard
from services.dashboard.settings import DashboardSettings
from tests.browser.test_recorder_instrument import FAKE_AUDIO

TONE_HZ = 587
FOLLOWS = {"level": "OK", "message": "robot follows"}
CANNOT = {
    "level": "WARN",
    "message": "robot cannot follow: index at the joint limit",
    "fingers": {"index": "limit"},
}


def stream(side, following):
    return {
        "stream": f"keypoints_{side}",
        "device": f"finger_tracker_{side}",
        "hand": side,
        "level": "OK",
        "reasons": [],
        "rate_hz": 60,
        "nominal_rate_hz": 60,
        "age_s": 0.01,
        "received": 1,
        "lost": 0,
        "following": following,
    }


class Station:
    """A station whose hands a test moves."""

    def __init__(self):
        self.following = {"left": FOLLOWS, "right": FOLLOWS}
        self.recorder = {"state": "recording", "actions": ["stop"], "recording_id": "take-1"}
        self.app = FastAPI()
        self.app.get("/v1/recorder")(lambda: self.recorder)
        self.app.get("/v1/health")(self.health)

    def health(self):
        streams = [stream(side, following) for side, following in self.following.items()]
        return {"station": "desk", "level": "OK", "streams": streams, "devices": []}


def sounded(page):
    return page.evaluate("tones").count(TONE_HZ)


@pytest.fixture
def station():
    return Station()


@pytest.fixture
def opened(page, serve, station):
    page.add_init_script(FAKE_AUDIO)
    page.goto(serve(create_dashboard(DashboardSettings(acquisition_url=serve(station.app)))))
    expect(page.locator("#hand_left_follow")).to_have_text("robot follows")
    return page


@pytest.mark.slow
def test_the_card_says_which_finger_and_why_and_it_sounds_once(opened, station):
    opened.locator("#sounds").click()
    left, right = (opened.locator(f"#hand_{side}_follow") for side in ("left", "right"))
    station.following["left"] = CANNOT | {"lasted_s": 0.2}
    expect(left).to_have_text(CANNOT["message"])
    expect(left).to_have_attribute("data-level", "WARN")
    expect(right).to_have_attribute("data-level", "OK")
    assert sounded(opened) == 0
    station.following["left"] = CANNOT | {"lasted_s": 0.4}
    for _ in range(600):
        if sounded(opened):
            break
        opened.wait_for_timeout(50)
    assert sounded(opened) == 1
    station.following["left"] = None
    expect(left).to_be_hidden()
    station.following["left"] = CANNOT | {"lasted_s": 0.4}
    expect(left).to_be_visible()
    # Within five seconds of the one before there is no second sound.
    assert sounded(opened) == 1


@pytest.mark.slow
def test_no_sound_between_takes_nor_where_it_is_switched_off(opened, station):
    opened.locator("#sounds").click()
    left = opened.locator("#hand_left_follow")
    station.recorder = {"state": "armed", "actions": ["record"]}
    expect(opened.locator("#recorder_state")).to_have_text("armed")
    station.following["left"] = CANNOT | {"lasted_s": 0.4}
    expect(left).to_have_text(CANNOT["message"])
    station.following["left"] = FOLLOWS
    expect(left).to_have_text("robot follows")
    box = opened.get_by_label("Sound if the robot's hand cannot follow")
    box.uncheck()
    opened.reload()
    expect(box).not_to_be_checked()
    station.recorder = {"state": "recording", "actions": ["stop"], "recording_id": "take-1"}
    expect(opened.locator("#recorder_state")).to_have_text("recording")
    station.following["left"] = CANNOT | {"lasted_s": 0.4}
    expect(left).to_have_text(CANNOT["message"])
    assert sounded(opened) == 0
