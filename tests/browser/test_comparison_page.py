"""An operator replays an episode in a real and an imagined world, and sees how far they part."""

import json
import re
from dataclasses import replace

import httpx
import numpy as np
import pytest
from playwright.sync_api import expect

from dextouch.episodes import EpisodeStore
from dextouch.errors import EndedError
from dextouch.schemas import EVERYTHING, RolloutStart, Uncertainty
from dextouch.streams import unpack
from dextouch.worlds import SteppedRollout, WorldServiceSettings, create_world_app
from services.dashboard.app import create_app
from services.dashboard.settings import DashboardSettings
from services.episode_store.app import create_app as create_store
from services.episode_store.settings import EpisodeStoreSettings
from services.evaluation.settings import StudyServiceSettings
from services.evaluation.studies.app import create_app as create_studies
from tests.unit.evaluation import study_rows, toy
from tests.unit.evaluation.toy_store import write

SEED = 3
UNRELIABLE = "the hand is 20 mm from where it was sent"
PIXELS = """canvas => [canvas.width, canvas.height,
  [...canvas.getContext('2d').getImageData(0, 0, canvas.width, canvas.height).data]]"""


class DoubtfulWorld(toy.ToyWorld):
    """Doubts its third chunk, and may end the rollout at a later one."""

    def __init__(self, *, ends_at=None):
        super().__init__("dream", judge=False, drift_m=0.02)
        self.ends_at = ends_at

    def step(self, state, actions, *, seed, selector=EVERYTHING):
        if self.ends_at is not None and state.step >= self.ends_at:
            raise EndedError("dream: lost", reason="the spot is out of sight")
        stepped = super().step(state, actions, seed=seed, selector=selector)
        outside = state.step == 32
        uncertainty = Uncertainty(
            disagreement=0.02, distance=0.5, outside=outside, reason=UNRELIABLE if outside else None
        )
        info = {"uncertainty/bound_share": 1.4 if outside else 0.5}
        return SteppedRollout(
            stepped.state, replace(stepped.observation, uncertainty=uncertainty), info
        )


def steps_of(world, item, start):
    """Images and touch of every step of a replay, by the world alone."""
    begun = world.reset(start)
    state, seen = begun.state, [begun.observation]
    for first in range(1, toy.STEPS, 4):
        stepped = world.step(state, item.commanded[first : first + 4], seed=0)
        state = stepped.state
        seen.append(stepped.observation)
    images = np.concatenate([one.images["camera_head"] for one in seen])
    return images, np.concatenate([one.tactile_kpa for one in seen]), begun


@pytest.fixture
def item():
    return toy.demonstration("reach", SEED)


@pytest.fixture
def expected(item):
    """Steps of both worlds, which the errors are computed from below."""
    start = RolloutStart("reach", SEED, item.instruction)
    images, touch, begun = steps_of(toy.ToyWorld("twin", judge=True), item, start)
    given = replace(start, observation=begun.observation, anchor=begun.anchor, K_head=begun.K_head)
    other_images, other_touch, _ = steps_of(DoubtfulWorld(), item, given)
    return images, other_images, touch, other_touch


@pytest.fixture
def serve_dashboard(serve, tmp_path, item):
    store = EpisodeStore(str(tmp_path / "store"))
    write(store, item)
    write(store, toy.demonstration("reach", 4, name="recorded-by-hand"), domain="human", seed=None)
    store_url = serve(create_store(EpisodeStoreSettings(store_url=str(tmp_path / "store"))))
    twin = serve(
        create_world_app({"twin": toy.ToyWorld("twin", judge=True)}, WorldServiceSettings())
    )

    def start(*, studies_url=None, **options):
        model = serve(create_world_app({"dream": DoubtfulWorld(**options)}, WorldServiceSettings()))
        urls = {"twin_url": twin, "world_model_url": model, "episode_store_url": store_url}
        urls |= {"studies_url": studies_url} if studies_url else {}
        return serve(create_app(DashboardSettings(**urls))), twin, model

    return start


def replay(page, episode_id):
    page.get_by_label("Episode").select_option(episode_id)
    page.get_by_role("button", name="Replay").click()


def shown(page, name):
    width, height, values = page.locator(f"#{name}").evaluate(PIXELS)
    return np.array(values, np.uint8).reshape(height, width, 4)[..., :3]


def loops(images, other_images, touch, other_touch):
    """Errors of every step by plain loops over taxels; contact begins at 2 kPa."""
    pixels = [
        sum(abs(int(x) - int(y)) for x, y in zip(a.ravel(), b.ravel(), strict=True)) / a.size
        for a, b in zip(images, other_images, strict=True)
    ]
    pressures, f1 = [], []
    for truth, guess in zip(touch, other_touch, strict=True):
        pairs = list(zip(truth.ravel().tolist(), guess.ravel().tolist(), strict=True))
        pressures.append(sum(abs(x - y) for x, y in pairs) / len(pairs))
        both = sum(x >= 2 and y >= 2 for x, y in pairs)
        one = sum((x >= 2) != (y >= 2) for x, y in pairs)
        f1.append(2 * both / (2 * both + one) if both + one else 1.0)
    return pixels, pressures, f1


@pytest.mark.slow
def test_both_worlds_side_by_side_with_their_errors(page, serve_dashboard, item, expected):
    address, twin, model = serve_dashboard()
    problems = []
    page.on("pageerror", lambda error: problems.append(str(error)))
    page.goto(f"{address}/rollouts")
    replay(page, item.episode_id)
    expect(page.locator("#comparison_state")).to_contain_text("finished")
    expect(page.locator("#comparison_step")).to_have_attribute("max", "80")
    images, other_images, touch, other_touch = expected
    pixels, pressures, f1 = loops(*expected)
    assert max(pixels) > 1
    assert max(pressures) > 0.01
    for step in (0, 20, 36, 80):
        page.get_by_label("step of the comparison").fill(str(step))
        expect(page.locator("#compared")).to_have_attribute("data-step", str(step))
        assert np.array_equal(shown(page, "real_image"), images[step])
        assert np.array_equal(shown(page, "imagined_image"), other_images[step])
        apart = np.abs(images[step].astype(int) - other_images[step])
        assert np.array_equal(shown(page, "difference_image"), apart)
        touched = max(touch[step].max(), other_touch[step].max()) >= 2
        contact = f"{f1[step]:.2f}" if touched else "undefined (no contact)"
        words = f"step {step}: pixels {pixels[step]:.2f}, pressure {pressures[step]:.3f} kPa, "
        expect(page.locator("#comparison_text")).to_have_text(f"{words}contact F1 {contact}")
        for side, kpa in zip(("left", "right"), other_touch[step], strict=True):
            count = int((kpa >= 2).sum())
            said = f"{count} taxels in contact, peak {kpa.max():.0f} kPa" if count else "no contact"
            expect(page.locator(f"#imagined_{side}_text")).to_have_text(said)
        uncertainty = page.locator("#imagined_uncertainty")
        said = {0: "given", 20: "within", 36: f"unreliable: {UNRELIABLE}"}
        later = f"unreliable since step 36: {UNRELIABLE}"
        expect(uncertainty).to_contain_text(said.get(step, later))
    assert page.locator("#charts canvas").count() == 3
    # Nothing is left behind in the worlds.
    for url in (twin, model):
        assert httpx.get(f"{url}/v1/watch").json()["num_open"] == 0
    assert problems == []


def strip_colour(page, step):
    """Colour of the chart below the videos at a step, above its curve."""
    return page.evaluate(
        """step => {
          const canvas = document.querySelector("#uncertainty_strip canvas");
          const over = document.querySelector("#uncertainty_strip .u-over");
          const scale = canvas.width / canvas.clientWidth;
          const x = over.offsetLeft + over.clientWidth * step / 80;
          const place = [Math.round(scale * x), Math.round(scale * (over.offsetTop + 4))];
          return [...canvas.getContext("2d").getImageData(...place, 1, 1).data];
        }""",
        step,
    )


@pytest.mark.slow
def test_a_policy_author_sees_where_imagination_left_the_truth(
    page, serve, serve_dashboard, tmp_path, item, monkeypatch
):
    rows = {"policy": {"real": "SF", "model": "FF", "blurred": "SF"}}
    monkeypatch.setattr(study_rows, "ROWS", {"reach": rows})
    changes = {"tasks": ["reach"], "num_starts": 2, "policies": {"policy": {"script": "hold"}}}
    for name, value in changes.items():
        monkeypatch.setitem(study_rows.DEFINITION, name, value)
    study_rows.write_study(tmp_path / "studies" / "touch")
    studies = serve(create_studies(StudyServiceSettings(studies=tmp_path / "studies")))
    found = httpx.get(f"{studies}/v1/studies/touch/rollouts").json()["rollouts"]
    assert found[0]["disagrees"]
    kept = replace(item, episode_id=found[0]["real_episode_id"])
    write(EpisodeStore(str(tmp_path / "store")), kept)

    address, *_ = serve_dashboard(studies_url=studies)
    page.goto(f"{address}/studies")
    page.get_by_role("link", name="touch and sight").click()
    # It opens on what differs, and on the picture of all policies.
    expect(page.locator("#rollouts tbody tr")).to_have_count(1)
    expect(page.locator("#picture svg text", has_text="real success")).to_be_visible()
    with page.expect_download() as download:
        page.get_by_role("link", name="LaTeX").click()
    assert "addlegendentry{policy}" in download.value.path().read_text()
    page.get_by_role("link", name="Compare").click()
    expect(page.get_by_label("Episode")).to_have_value(kept.episode_id)
    page.get_by_role("button", name="Replay").click()
    expect(page.locator("#outcomes")).to_contain_text("Real: success.")
    moment = page.locator("#moment")
    expect(moment).to_contain_text(f"Leaves what it knows at 2.2 s (step 33): {UNRELIABLE}")
    page.get_by_role("button", name="Go there").click()
    expect(page.locator("#compared")).to_have_attribute("data-step", "33")
    figure = page.locator("figure", has=page.locator("#imagined_image"))
    expect(figure).to_have_attribute("data-outside", "true")
    before, after = (strip_colour(page, step) for step in (22, 62))
    assert before != after
    page.get_by_label("step of the comparison").fill("32")
    expect(figure).to_have_attribute("data-outside", "false")
    # Both rollouts are over, and stay with what came of them.
    expect(page.locator("tr[data-over]")).to_have_count(2)
    expect(page.locator("tr[data-over]", has_text="twin").locator(".outcome")).to_have_text(
        "success"
    )


@pytest.mark.slow
def test_hands_are_moved_by_the_keyboard_while_their_field_has_the_focus(page, serve_dashboard):
    address, twin, _ = serve_dashboard()
    page.goto(f"{address}/rollouts")
    page.get_by_role("button", name="Move hands").click()
    pad = page.locator("#drive_pad")
    expect(pad).to_be_focused()
    # The toy's hand is the left one.
    page.locator("#drive_sides").select_option("left")
    pad.focus()
    page.keyboard.down("d")
    expect(page.locator("#comparison_step")).to_have_attribute("max", re.compile("^[1-9][0-9]$"))
    page.keyboard.up("d")
    # The newest response of the twin has the hand to the right of where it began.
    (rollout,) = httpx.get(f"{twin}/v1/watch").json()["rollouts"]
    newest = httpx.get(f"{twin}/v1/watch/{rollout['watch_id']}").content
    fields, arrays = unpack(newest, max_bytes=10**7)
    reached = arrays["action_reached"]
    last_step = fields["observation"]["first_step"] + len(reached) - 1
    # Hands go no further than half a metre.
    assert reached[-1][0] == pytest.approx(min(last_step / 15 * 0.25, 0.5))
    page.get_by_role("button", name="Stop").click()
    expect(page.locator("#comparison_state")).to_contain_text("stopped")
    expect(pad).to_be_hidden()


@pytest.fixture
def tell(page):
    """Changes what the live link says about a topic, now and from now on."""
    changes, newest, sockets = {}, {}, []

    def send(topic):
        data = newest.get(topic, {}) | changes.get(topic, {})
        sockets[-1].send(json.dumps({"topic": topic, "data": data}))

    def connect(socket):
        sockets.append(socket)

        def pass_on(text):
            if isinstance(text, bytes):
                socket.send(text)
                return
            message = json.loads(text)
            newest[message["topic"]] = message["data"]
            send(message["topic"])

        socket.connect_to_server().on_message(pass_on)

    def change(topic, **fields):
        changes[topic] = fields
        send(topic)

    page.route_web_socket("**/v1/live", connect)
    return change


@pytest.mark.slow
def test_a_chosen_episode_stays_chosen(page, serve_dashboard, tmp_path, item, tell):
    store = EpisodeStore(str(tmp_path / "store"))
    write(store, toy.demonstration("reach", 5))
    episodes = "**/v1/episode_store/episodes?*"
    problem = {"detail": "the store starts"}
    page.route(episodes, lambda route: route.fulfill(status=503, json=problem))
    page.goto(f"{serve_dashboard()[0]}/rollouts")
    note = page.locator("#offer_note")
    expect(note).to_have_text("Episodes cannot be listed: the store starts")
    page.unroute(episodes)
    expect(note).to_have_text("")
    chosen = page.get_by_label("Episode")
    expect(chosen.locator("option")).to_have_count(2)
    for episode_id in ("reach-5-0", item.episode_id):
        chosen.select_option(episode_id)
        tell("rollouts", worlds=[])
        expect(page.locator("#drive")).to_be_hidden()
        tell("rollouts")
        expect(page.locator("#drive")).to_be_visible()
        expect(chosen).to_have_value(episode_id)
    write(store, toy.demonstration("reach", 6))
    page.get_by_role("button", name="Replay").focus()
    chosen.focus()
    expect(chosen.locator("option")).to_have_count(3)
    expect(chosen).to_have_value(item.episode_id)


@pytest.mark.slow
def test_what_is_shown_stays_while_a_world_or_the_dashboard_is_away(page, serve_dashboard, tell):
    page.goto(f"{serve_dashboard()[0]}/rollouts")
    page.get_by_role("button", name="Move hands").click()
    expect(page.locator("#drive_pad")).to_be_focused()
    page.get_by_role("button", name="Watch").first.click()
    about = page.locator("#watched_about")
    expect(page.locator("#step_text")).to_contain_text("step 0")
    tell("rollouts", rollouts=[])
    expect(page.locator("tr[data-watch]")).to_have_count(0)
    expect(about).to_contain_text("running")
    tell("comparison", state="none")
    expect(page.locator("#comparison_state")).to_contain_text("stopped")
    expect(page.locator("#drive_pad")).to_be_hidden()
    expect(page.locator("#replay_stop")).to_be_hidden()


@pytest.mark.slow
def test_a_world_that_ends_its_rollout_says_why(page, serve_dashboard, item):
    address, *_ = serve_dashboard(ends_at=48)
    page.goto(f"{address}/rollouts?replay={item.episode_id}")
    page.get_by_role("button", name="Replay").click()
    ended = "The world model ended its rollout: the spot is out of sight"
    expect(page.locator("#comparison_note")).to_have_text(ended)
    expect(page.locator("#comparison_step")).to_have_attribute("max", "48")
    # Of a comparison that somebody else begins now, it would not be true.
    begun = httpx.post(f"{address}/v1/comparisons", json={"task": "reach", "seed": SEED})
    assert begun.status_code == 202
    expect(page.locator("#comparison_state")).to_contain_text("running")
    expect(page.locator("#comparison_note")).to_have_text("")


@pytest.mark.parametrize(
    ("episode_id", "says"),
    [("recorded-by-hand", "expected robot"), ("nothing", "nothing")],
)
@pytest.mark.slow
def test_episodes_that_cannot_be_replayed_are_refused(page, serve_dashboard, episode_id, says):
    address, *_ = serve_dashboard()
    page.goto(f"{address}/rollouts?replay={episode_id}")
    page.get_by_role("button", name="Replay").click()
    expect(page.locator("#comparison_note")).to_contain_text(says)
    expect(page.locator("#compared")).to_be_hidden()
