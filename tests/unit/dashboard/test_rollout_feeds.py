"""Topics of rollouts: several worlds in one list, messages of steps, and their limits."""

import json

import httpx
import numpy as np
import pytest

from dextouch.schemas import ReturnSelector, RolloutInfo, answer_parts, decode_answer
from dextouch.streams import pack
from dextouch.worlds import CopyFirstWorld, WorldServiceSettings, create_world_app
from services.dashboard import rollout_feeds
from services.dashboard.app import create_app
from services.dashboard.feeds import Feeds
from services.dashboard.rollout_feeds import MAX_TOPICS, RolloutFeeds, steps_message
from services.dashboard.settings import DashboardSettings
from services.dashboard.upstream import Upstream
from tests.unit.other_gloves import small_layout
from tests.unit.worlds.fakes import CAMERAS, SumWorld, observation

SETTINGS = DashboardSettings(station_period_s=0.05)
START = {"world": "sum", "task": "stand_bottle", "seed": 3, "instruction": "stand it"}
INFO = RolloutInfo(
    id="a", world="sum", world_digest="d", task="t", instruction="i", seed=1,
    action_kind="commanded", next_chunk=1, last_step=16, ttl_s=60,
)  # fmt: skip


def upstream_of(name, app):
    client = httpx.AsyncClient(transport=httpx.ASGITransport(app), base_url="http://127.0.0.1")
    return Upstream(name, client)


def refused(name):
    transport = httpx.MockTransport(lambda request: httpx.Response(500))
    return Upstream(name, httpx.AsyncClient(transport=transport, base_url="http://fake"))


@pytest.fixture
async def world():
    app = create_world_app({"sum": SumWorld()}, WorldServiceSettings())
    async with app.router.lifespan_context(app):
        yield upstream_of("twin", app)


def parsed(message):
    """Header, touch and images by camera of a message, read as its documentation says."""
    assert message[0] == 2
    size = int.from_bytes(message[4:8], "little")
    header, rest = json.loads(message[8 : 8 + size]), message[8 + size :]
    count, touch, images = len(header["steps"]), None, {}
    if header["has_touch"]:
        length = count * 640 * 4
        touch, rest = np.frombuffer(rest[:length], "<f4").reshape(count, 2, 320), rest[length:]
    for camera in header["cameras"]:
        shape = (count, camera["height"], camera["width"], 3)
        length = int(np.prod(shape))
        images[camera["name"]] = np.frombuffer(rest[:length], np.uint8).reshape(shape)
        rest = rest[length:]
    assert not rest
    return header, touch, images


def response(seen, **selected):
    return pack(*answer_parts(INFO, seen, selector=ReturnSelector(**selected)))


def test_a_message_holds_the_steps_bit_for_bit():
    seen = observation(16, seed=4, first_step=33)
    header, touch, images = parsed(steps_message("rollout/twin/x", response(seen)))
    assert header["steps"] == list(range(33, 49))
    assert header["topic"] == "rollout/twin/x"
    np.testing.assert_array_equal(touch, seen.tactile_kpa)
    assert set(images) == set(CAMERAS)
    for camera in CAMERAS:
        np.testing.assert_array_equal(images[camera], seen.images[camera])


def test_of_too_many_images_the_last_step_is_kept(monkeypatch):
    seen = observation(16, seed=4, first_step=1)
    # Two cameras of 8 by 8 px are 384 bytes a step.
    monkeypatch.setattr(rollout_feeds, "MAX_IMAGE_BYTES", 5 * 384)
    header, touch, images = parsed(steps_message("t", response(seen)))
    assert header["steps"] == [4, 8, 12, 16]
    assert header["num_steps"] == 16
    np.testing.assert_array_equal(touch, seen.tactile_kpa[3::4])
    np.testing.assert_array_equal(images[CAMERAS[0]], seen.images[CAMERAS[0]][3::4])


@pytest.mark.parametrize("selected", [{"images": "jpeg"}, {"tactile": False}])
def test_other_forms_of_responses_are_read_too(selected):
    header, touch, images = parsed(steps_message("t", response(observation(4), **selected)))
    assert (touch is None) == ("tactile" in selected)
    assert {array.shape for array in images.values()} == {(4, 8, 8, 3)}
    assert len(header["steps"]) == 4


async def test_services_that_fail_do_not_hide_the_others(world):
    await world.send("POST", "/v1/rollouts", START)
    feeds = RolloutFeeds(
        Feeds({"twin": world, "world_model": refused("world_model")}, SETTINGS), SETTINGS
    )
    view = await feeds.listed()
    assert [(one.service, one.kind, one.task) for one in view.rollouts] == [
        ("twin", "model", "stand_bottle")
    ]
    assert view.problems == ("world_model: GET /v1/worlds answered 500 without a reason",)
    none = await RolloutFeeds(Feeds({}, SETTINGS), SETTINGS).listed()
    assert "DEXTOUCH_DASHBOARD_TWIN_URL" in none.problems[0]


async def test_worlds_say_the_layout_of_their_gloves():
    layout = small_layout()
    world = CopyFirstWorld(tasks=("stand_bottle",), tactile_layout=layout)
    app = create_world_app({"a": world, "b": SumWorld()}, WorldServiceSettings())
    async with app.router.lifespan_context(app):
        feeds = Feeds({"twin": upstream_of("twin", app)}, SETTINGS)
        worlds = (await RolloutFeeds(feeds, SETTINGS).listed()).model_dump(mode="json")["worlds"]
    layouts = {world["name"]: world.get("tactile_layout") for world in worlds}
    assert layouts == {"a": json.loads(layout.model_dump_json()), "b": None}


async def test_a_watched_rollout_is_fetched_again_only_after_it_changed(world):
    begun = await world.send("POST", "/v1/rollouts", START)
    feeds = RolloutFeeds(Feeds({"twin": world}, SETTINGS), SETTINGS)
    (one,) = (await feeds.listed()).rollouts
    topic = feeds.topic(f"rollout/twin/{one.watch_id}")
    assert topic is feeds.topic(f"rollout/twin/{one.watch_id}")
    statuses = []
    send = world.send

    async def noted(*given, **options):
        answer = await send(*given, **options)
        statuses.append(answer.status_code)
        return answer

    world.send = noted
    first = await topic.fetch()
    assert await topic.fetch() == first
    assert statuses == [200, 304]
    header, _, _ = parsed(first[0])
    assert "id" not in header["rollout"]
    rollout_id = decode_answer(begun.content, max_bytes=10**6).rollout.id
    await send("DELETE", f"/v1/rollouts/{rollout_id}")
    (gone,) = await topic.fetch()
    assert json.loads(gone)["data"]["gone"]


@pytest.mark.parametrize(
    "name",
    ["rollout/twin/x", "rollout/alignment/" + "0" * 32, "rollout/twin/" + "0" * 31, "rollout", ""],
)
def test_other_names_are_no_topics(name):
    assert RolloutFeeds(Feeds({}, SETTINGS), SETTINGS).topic(name) is None


def test_as_many_topics_are_kept_as_allowed():
    feeds = RolloutFeeds(Feeds({}, SETTINGS), SETTINGS)
    for number in range(MAX_TOPICS + 5):
        assert feeds.topic(f"rollout/twin/{number:032x}") is not None
    assert len(feeds._watched) == MAX_TOPICS


@pytest.mark.long
async def test_replays_need_a_session_and_their_services():
    key = {"name": "operator", "key": "a-key-of-some-length", "scopes": ("operate",)}
    body = {"episode_id": "take-0001"}
    for settings, status in (({"api_keys": (key,)}, 401), ({}, 404)):
        app = create_app(DashboardSettings(**settings), {})
        transport = httpx.ASGITransport(app)
        async with httpx.AsyncClient(transport=transport, base_url="http://127.0.0.1") as client:
            answer = await client.post("/v1/comparisons", json=body)
            assert answer.status_code == status
            assert (await client.get("/v1/comparisons/x/chunks/0")).status_code == status
    assert "DEXTOUCH_DASHBOARD_WORLD_MODEL_URL" in answer.json()["detail"]
    async with httpx.AsyncClient(transport=transport, base_url="http://127.0.0.1") as client:
        hostile = await client.post("/v1/comparisons", json={"episode_id": "../../x"})
    assert hostile.status_code == 422
