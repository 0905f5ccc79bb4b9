"""An operator watches rollouts in a real browser: the page shows what the policy's client got."""

import socket
from dataclasses import replace

import numpy as np
import pytest
from playwright.sync_api import expect

from dextouch.clients import RolloutClient
from dextouch.schemas import EVERYTHING, ReturnSelector, Uncertainty
from dextouch.worlds import SteppedRollout, WorldServiceSettings, create_world_app
from services.dashboard.app import create_app
from services.dashboard.settings import DashboardSettings
from tests.unit.worlds.fakes import SumWorld, actions

UNRELIABLE = "objects are 12 mm apart in two predictions, the bound is 8 mm"
START = {"world": "sum", "task": "stand_bottle", "seed": 7, "instruction": "stand <b>it</b> up"}
PIXELS = """canvas => [canvas.width, canvas.height,
  [...canvas.getContext('2d').getImageData(0, 0, canvas.width, canvas.height).data]]"""


class NoisyWorld(SumWorld):
    """Every step has its own image and touch; the third chunk is unreliable."""

    def step(self, state, actions, *, seed, selector=EVERYTHING):
        stepped = super().step(state, actions, seed=seed)
        seen, rng = stepped.observation, np.random.default_rng(seed)
        images = {
            name: rng.integers(0, 256, rows.shape, np.uint8) for name, rows in seen.images.items()
        }
        touch = rng.uniform(0, 30, seen.tactile_kpa.shape).astype(np.float32)
        outside = state.step == 8
        uncertainty = Uncertainty(
            disagreement=0.012,
            distance=1.5,
            outside=outside,
            reason=UNRELIABLE if outside else None,
        )
        told = replace(seen, images=images, tactile_kpa=touch, uncertainty=uncertainty).selected(
            selector
        )
        return SteppedRollout(stepped.state, told, stepped.info)


@pytest.fixture
def world_url(serve):
    return serve(create_world_app({"sum": NoisyWorld()}, WorldServiceSettings()))


@pytest.fixture
def opened(page, serve, world_url):
    problems = []
    page.on("pageerror", lambda error: problems.append(str(error)))
    page.on("console", lambda line: problems.append(line.text) if line.type == "error" else None)
    page.goto(serve(create_app(DashboardSettings(twin_url=world_url))) + "/rollouts")
    yield page
    assert problems == []


def shown_image(page, camera):
    width, height, values = page.locator(f"canvas[data-camera={camera}]").evaluate(PIXELS)
    return np.array(values, np.uint8).reshape(height, width, 4)[..., :3]


def assert_shows(page, seen):
    """The last step of an observation, image by image and hand by hand."""
    last_step = seen.first_step + len(seen) - 1
    expect(page.locator("#watched")).to_have_attribute("data-step", str(last_step))
    for camera, images in seen.images.items():
        assert np.array_equal(shown_image(page, camera), images[-1])
    for side, kpa in zip(("left", "right"), seen.tactile_kpa[-1], strict=True):
        touching, peak = sum(1 for value in kpa if value >= 2.0), max(kpa)
        words = f"{touching} taxels in contact, peak {peak:.0f} kPa"
        expect(page.locator(f"#hand_{side}_text")).to_have_text(words)


def test_a_rollout_is_watched_step_by_step(opened, world_url):
    expect(opened.get_by_text("No open rollouts")).to_be_visible()
    with RolloutClient(world_url, name="colour servo") as client, client.start(**START) as rollout:
        row = opened.locator("tr[data-watch]")
        expect(row).to_contain_text("colour servo")
        # Text of a client stays text.
        expect(row).to_contain_text("stand <b>it</b> up")
        row.get_by_role("button", name="Watch").click()
        expect(opened.locator("#step_text")).to_have_text("start, step 0")
        for chunk in range(2):
            assert_shows(opened, rollout.step(actions(4, 0.1)))
            expect(opened.locator("#step_text")).to_contain_text(f"chunk {chunk}, step")
        expect(opened.locator("#watched_note")).to_have_text("")

        assert_shows(opened, rollout.step(actions(4, 0.1)))
        expect(opened.locator("#watched_note")).to_have_text(f"Unreliable steps: {UNRELIABLE}")
        expect(row).to_contain_text("unreliable")
        expect(row).to_contain_text(UNRELIABLE)
        # Of an earlier step, which the operator goes back to.
        opened.get_by_label("step of the newest chunk").focus()
        opened.keyboard.press("ArrowLeft")
        expect(opened.locator("#watched")).to_have_attribute("data-step", "11")
        for camera, images in rollout.observation.images.items():
            assert np.array_equal(shown_image(opened, camera), images[-2])
        # The next chunk is within the bound, but what it goes on from is not.
        assert_shows(opened, rollout.step(actions(4, 0.1)))
        since = f"unreliable since step 12: {UNRELIABLE}"
        expect(opened.locator("#watched_note")).to_have_text(since)
        expect(row).to_contain_text(since)
        expect(row).to_contain_text("unreliable")
    expect(opened.locator("#watched_note")).to_have_text(
        "This rollout is over: It was ended, or expired."
    )
    expect(opened.get_by_text("No open rollouts")).to_be_visible()


def test_a_policy_without_images_shows_touch_alone(opened, world_url):
    blind = ReturnSelector(cameras=())
    with RolloutClient(world_url, selector=blind) as client, client.start(**START) as rollout:
        opened.get_by_role("button", name="Watch").click()
        assert_shows(opened, rollout.step(actions(4, 0.1)))
        expect(opened.locator("#watched_note")).to_contain_text("asks for no images")


@pytest.mark.slow
def test_steps_are_sent_only_while_they_are_in_view(opened, world_url):
    with RolloutClient(world_url) as client, client.start(**START) as rollout:
        opened.get_by_role("button", name="Watch").click()
        expect(opened.locator("#watched")).to_have_attribute("data-step", "0")
        opened.get_by_role("button", name="Close").click()
        expect(opened.locator("#watched")).to_be_hidden()
        rollout.step(actions(4, 0.1))
        expect(opened.locator("tr[data-watch]")).to_contain_text("4")
        assert opened.locator("#watched").get_attribute("data-step") == "0"


@pytest.mark.slow
def test_a_service_that_does_not_answer_is_named(page, serve):
    with socket.socket() as closed:
        closed.bind(("127.0.0.1", 0))
        dead = f"http://127.0.0.1:{closed.getsockname()[1]}"
        page.goto(serve(create_app(DashboardSettings(world_model_url=dead))) + "/rollouts")
        expect(page.locator("#problems")).to_contain_text("world_model: no answer")
