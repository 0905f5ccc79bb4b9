"""Clicks over HTTP: which episodes are listed, what is refused, and what is kept."""

import json

import numpy as np
import pytest
from httpx import ASGITransport, AsyncClient

from dextouch.episodes import EpisodeStore
from dextouch.errors import InvalidInputError
from dextouch.schemas import ObjectClicks, Review
from dextouch.serving.keys import ApiKey
from services.episode_store.app import create_app
from tests.unit.episode_store.test_items import NOON
from tests.unit.episodes.test_object_clicks import FILE, bottle, clicks, seen, written

NAMES = [f"take-{number}" for number in range(4)]


@pytest.fixture
def store(settings):
    return EpisodeStore(settings.store_url)


@pytest.fixture
def described(settings, tmp_path):
    path = tmp_path / "objects.json"
    path.write_text(json.dumps(FILE))
    return settings.model_copy(update={"objects": path})


@pytest.fixture
async def http(described):
    transport = ASGITransport(create_app(described))
    async with AsyncClient(transport=transport, base_url="http://localhost") as client:
        yield client


def body(**objects):
    return clicks(**objects).model_dump(mode="json", exclude_none=True)


async def kept(http, name, given):
    return await http.post(f"/v1/episodes/{name}/clicks", json=given)


async def queue(http, **query):
    answer = await http.get("/v1/catalog/clicks", params=query)
    assert answer.status_code == 200, answer.text
    return answer.json()


async def test_episodes_that_training_would_take_are_listed(http, store):
    for name in NAMES:
        written(store, name)
    written(store, "unjudged", success=None)
    written(store, "simulated", origin="twin")
    written(store, "imagined", origin="imagined")
    written(store, "other-task", task="pour")
    written(store, "rejected")
    store.set_review("rejected", Review(verdict="rejected", reviewed_at=NOON))
    found = await queue(http)
    assert (found["tasks"], found["task"]) == (["stand_bottle"], "stand_bottle")
    assert [one["name"] for one in found["objects"]] == ["bottle", "cup", "mat"]
    assert sorted(one["episode_id"] for one in found["episodes"]) == NAMES
    assert found["num_matching"] == 4
    # What was marked stays in a shorter list.
    first = [one["episode_id"] for one in (await queue(http, limit=1))["episodes"]]
    (other,) = {*NAMES[:2]} - {*first} if first[0] in NAMES[:2] else {NAMES[0]}
    assert (await kept(http, other, body())).status_code == 200
    assert [one["episode_id"] for one in (await queue(http, limit=1))["episodes"]] == [other]
    assert (await http.get("/v1/catalog/clicks", params={"task": "juggle"})).status_code == 404


async def test_clicks_are_kept_and_give_the_box_of_the_object(http, store):
    written(store)
    answer = await kept(http, "take", body())
    assert answer.status_code == 200, answer.text
    assert store.clicks("take") == clicks()
    box_m = np.array([0.0, 0.0, 0.02, 0.03, 0.04, 0.12])
    signs = [[x, y, z] for z in (-1, 1) for y in (-1, 1) for x in (-1, 1)]
    corners = (box_m[:3] + signs * box_m[3:]) @ bottle()[:3, :3].T + bottle()[:3, 3]
    np.testing.assert_allclose(answer.json()["boxes_px"]["bottle"], seen(corners), atol=1e-5)
    again = (await http.get("/v1/episodes/take/clicks")).json()
    assert again == answer.json()
    assert again["image_t_ns"] == 0
    listed = (await queue(http))["episodes"][0]["clicks"]
    assert listed["objects"]["bottle"]["point_px"] == list(clicks().objects["bottle"].point_px)
    assert (await kept(http, "take", {"objects": {}})).status_code == 200
    assert store.clicks("take") is None


@pytest.mark.parametrize(
    ("given", "status", "says"),
    [
        (body(bottle={"point_px": [40.0, 3.0]}), 422, "expected a place in the image"),
        (body(lid={"state": "absent"}), 422, "lid"),
        ({"objects": {"bottle": {"state": "seen"}}}, 422, ""),
        ({"objects": {"bottle": {"state": "absent", "note": "x" * 20_000}}}, 413, ""),
    ],
)
async def test_wrong_clicks_are_refused_and_change_nothing(http, store, given, status, says):
    written(store)
    store.set_clicks("take", clicks())
    answer = await kept(http, "take", given)
    assert answer.status_code == status, answer.text
    assert says in answer.json()["detail"]
    assert store.clicks("take") == clicks()
    assert (await kept(http, "nobody", body())).status_code == 404


async def test_a_first_click_is_kept_before_the_second(http, store):
    written(store)
    half = {"bottle": {"point_px": [16.0, 16.0]}}
    answer = await kept(http, "take", body(**half))
    assert answer.status_code == 200
    assert answer.json()["boxes_px"] == {}
    assert store.clicks("take") == clicks(**half)


async def test_clicks_that_a_new_description_forbids_are_shown_with_why(http, store):
    written(store)
    store.set_clicks("take", clicks(lid={"state": "absent"}))
    found = (await http.get("/v1/episodes/take/clicks")).json()
    assert "lid" in found["problem"]
    assert set(found["clicks"]["objects"]) == {"bottle", "lid"}


async def test_the_file_is_one_that_training_takes(http, store):
    for name in NAMES[:2]:
        written(store, name)
    store.set_clicks(NAMES[1], clicks())
    text = (await http.get("/v1/catalog/clicks/file")).text
    assert ObjectClicks.model_validate_json(text).episodes == {NAMES[1]: clicks()}


async def test_marking_needs_the_scope_of_reviews(described, store):
    written(store)
    key = ApiKey(name="station", key="a-key-of-some-length", scopes=("store_read", "store_write"))
    app = create_app(described.model_copy(update={"api_keys": (key,)}))
    headers = {"authorization": "Bearer a-key-of-some-length"}
    async with AsyncClient(
        transport=ASGITransport(app), base_url="http://localhost", headers=headers
    ) as client:
        assert (await kept(client, "take", body())).status_code == 403
        assert (await client.get("/v1/catalog/clicks")).status_code == 200
    assert store.clicks("take") is None


async def test_without_described_objects_the_page_says_how(settings, store):
    written(store)
    async with AsyncClient(
        transport=ASGITransport(create_app(settings)), base_url="http://localhost"
    ) as client:
        answer = await client.get("/v1/catalog/clicks")
    assert answer.status_code == 404
    assert "DEXTOUCH_EPISODE_STORE_OBJECTS" in answer.json()["detail"]


def test_a_wrong_file_of_objects_ends_the_start(described):
    described.objects.write_text("{}")
    with pytest.raises(InvalidInputError, match="tasks"):
        create_app(described)
