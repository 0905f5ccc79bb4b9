"""Watching rollouts: what is listed and shown, to whom, and that nothing about them changes."""

import asyncio
from dataclasses import replace

import httpx
import msgpack
import numpy as np
import pytest
from httpx import ASGITransport, AsyncClient
from pydantic import SecretStr

from dextouch.clients import RolloutClient
from dextouch.schemas import RolloutUncertainty, Uncertainty, decode_answer
from dextouch.serving.keys import ApiKey
from dextouch.serving.state import MemoryState
from dextouch.streams import unpack
from dextouch.worlds import WorldServiceSettings, create_world_app
from dextouch.worlds.records import RecordStore, RolloutWatch
from dextouch.worlds.rollouts import RolloutService
from dextouch.worlds.settings import RolloutLimits
from tests.unit.worlds.begun import ALL, START, begin, decoded
from tests.unit.worlds.fakes import SumWorld, actions
from tests.unit.worlds.running import served

FLOAT64 = {"content-type": "application/octet-stream; dtype=float64"}
BODY = {"world": "sum", "task": "stand_bottle", "seed": 3, "instruction": "stand it"}
KEYS = tuple(
    ApiKey(name=name, key=SecretStr(f"the-key-of-{name}-1234"), scopes=scopes)
    for name, scopes in (("policy", ("rollout",)), ("desk", ("watch",)), ("other", ("store_read",)))
)


def bearer(name):
    return {"authorization": f"Bearer the-key-of-{name}-1234"}


@pytest.fixture
async def client():
    app = create_world_app({"sum": SumWorld()}, WorldServiceSettings(api_keys=KEYS))
    transport = ASGITransport(app, raise_app_exceptions=False)
    async with (
        app.router.lifespan_context(app),
        AsyncClient(transport=transport, base_url="http://localhost") as opened,
    ):
        yield opened


async def start(client, **headers):
    answer = await client.post("/v1/rollouts", json=BODY, headers=bearer("policy") | headers)
    assert answer.status_code == 201, answer.text
    return decode_answer(answer.content, max_bytes=10**6)


async def step(client, rollout_id, chunk, value=0.0, query=""):
    path = f"/v1/rollouts/{rollout_id}/chunks/{chunk}{query}"
    body = actions(4, value).astype("<f8").tobytes()
    return await client.post(path, content=body, headers=FLOAT64 | bearer("policy"))


async def listed(client):
    return (await client.get("/v1/watch", headers=bearer("desk"))).json()


async def test_a_rollout_keeps_the_trace_that_began_it(client):
    # Of the specification (https://www.w3.org/TR/trace-context/).
    trace_id, other = "4bf92f3577b34da6a3ce929d0e0e4736", "0af7651916cd43dd8448eb211c80319c"
    begun = await start(client, traceparent=f"00-{trace_id}-00f067aa0ba902b7-01")
    await step(client, begun.rollout.id, 0)
    (one,) = (await listed(client))["rollouts"]
    assert (one["trace_id"], one["next_chunk"]) == (trace_id, 1)
    fork = await client.post(
        f"/v1/rollouts/{begun.rollout.id}/fork",
        json={"seed": 4},
        headers=bearer("policy") | {"traceparent": f"00-{other}-b7ad6b7169203331-00"},
    )
    assert fork.status_code == 201, fork.text
    assert {one["trace_id"] for one in (await listed(client))["rollouts"]} == {trace_id, other}


async def test_the_listing_says_who_does_what_since_when(client):
    begun = await start(client, **{"dextouch-client": "careful%20%C3%A9%00%0A"})
    await step(client, begun.rollout.id, 0)
    (one,) = (await listed(client))["rollouts"]
    assert one["world"] == "sum"
    assert (one["task"], one["instruction"], one["seed"]) == ("stand_bottle", "stand it", 3)
    assert (one["next_chunk"], one["last_step"], one["ended"]) == (1, 4, None)
    assert (one["key"], one["client"]) == ("policy", "careful é")
    assert 0 <= one["idle_s"] <= one["age_s"] < 60
    # Neither the id nor anything that leads to it is listed.
    assert begun.rollout.id not in str(one)
    assert one["watch_id"] != begun.rollout.id


async def test_the_last_ten_that_ended_are_listed_as_they_were(client):
    for number in range(12):
        begun = await start(client, **{"dextouch-client": f"policy-{number}"})
        await step(client, begun.rollout.id, 0)
        await client.delete(f"/v1/rollouts/{begun.rollout.id}", headers=bearer("policy"))
    page = await listed(client)
    assert (page["rollouts"], page["num_open"]) == ([], 0)
    assert [one["client"] for one in page["over"]] == [f"policy-{n}" for n in range(11, 1, -1)]
    assert {one["last_step"] for one in page["over"]} == {4}
    assert begun.rollout.id not in str(page)


async def test_rollouts_that_end_at_once_are_all_listed(client, monkeypatch):
    begun = [await start(client, **{"dextouch-client": f"policy-{n}"}) for n in range(8)]
    get = MemoryState.get

    async def get_and_wait(store, key):
        stored = await get(store, key)
        await asyncio.sleep(0)
        return stored

    monkeypatch.setattr(MemoryState, "get", get_and_wait)
    paths = [f"/v1/rollouts/{one.rollout.id}" for one in begun]
    await asyncio.gather(*(client.delete(path, headers=bearer("policy")) for path in paths))
    over = (await listed(client))["over"]
    assert sorted(one["client"] for one in over) == [f"policy-{n}" for n in range(8)]


class DoubtfulWorld(SumWorld):
    """Doubts chunks of which joint values are negative."""

    def step(self, state, rows, **options):
        stepped = super().step(state, rows, **options)
        slipped = bool((rows == -1.0).any())
        uncertainty = Uncertainty(
            disagreement=0, distance=0, outside=slipped, reason="slipped" if slipped else None,
            success_probability=0.25,
        )  # fmt: skip
        return replace(stepped, observation=replace(stepped.observation, uncertainty=uncertainty))


def test_every_answer_after_a_doubted_chunk_says_so():
    with (
        served(create_world_app({"sum": DoubtfulWorld()}, WorldServiceSettings())) as url,
        RolloutClient(url) as client,
        client.start(**BODY) as rollout,
    ):
        assert rollout.info.rollout_uncertainty is None
        rollout.step(actions(4))
        assert rollout.info.rollout_uncertainty == RolloutUncertainty(success_probability=0.25)
        rollout.step(actions(4, -1.0))
        rollout.step(actions(8))
        expected = RolloutUncertainty(reason="slipped", step=8, success_probability=0.25)
        assert rollout.observation.uncertainty.reason is None
        assert rollout.info.rollout_uncertainty == expected
        # Branches share the unreliable past, and watchers see it.
        with rollout.fork(seed=5) as branch:
            branch.step(actions(4))
            assert branch.info.rollout_uncertainty == expected
        (one,) = httpx.get(f"{url}/v1/watch").json()["rollouts"]
        assert one["rollout_doubt"] == expected.model_dump()
        assert one["doubt"]["reason"] is None


async def test_an_end_is_listed_with_its_reason(client):
    begun = await start(client)
    await step(client, begun.rollout.id, 0)
    assert (await step(client, begun.rollout.id, 1, 4e6)).status_code == 409
    (one,) = (await listed(client))["rollouts"]
    assert (one["ended"], one["last_step"]) == ("too many to count", 4)
    await client.delete(f"/v1/rollouts/{begun.rollout.id}", headers=bearer("policy"))
    page = await listed(client)
    assert (page["rollouts"], page["num_open"]) == ([], 0)
    assert [one["ended"] for one in page["over"]] == ["too many to count"]


async def test_the_newest_come_first_and_as_many_as_asked_for(client):
    for name in ("a", "b", "c"):
        await start(client, **{"dextouch-client": name})
        await asyncio.sleep(0.002)
    two = (await client.get("/v1/watch?limit=2", headers=bearer("desk"))).json()
    assert [one["client"] for one in two["rollouts"]] == ["c", "b"]
    assert two["num_open"] == 3
    for limit in ("0", "201", "x"):
        refused = await client.get(f"/v1/watch?limit={limit}", headers=bearer("desk"))
        assert refused.status_code == 422


@pytest.mark.parametrize("query", ["", "?steps=last&cameras=camera_head&images=jpeg", "?cameras="])
async def test_watchers_see_what_the_client_got(client, query):
    begun = await start(client)
    path = f"/v1/watch/{(await listed(client))['rollouts'][0]['watch_id']}"
    first = await client.get(path, headers=bearer("desk"))
    assert same_arrays(first.content, begun)
    got = await step(client, begun.rollout.id, 0, 0.25, query)
    seen = await client.get(path, headers=bearer("desk"))
    theirs, ours = (msgpack.unpackb(answer.content) for answer in (got, seen))
    assert ours["arrays"] == theirs["arrays"]
    assert ours["fields"]["observation"] == theirs["fields"]["observation"]
    assert "id" not in ours["fields"]["rollout"]
    assert begun.rollout.id.encode() not in seen.content
    assert ours["fields"]["rollout"]["next_chunk"] == 1


def same_arrays(content, answer):
    _, arrays = unpack(content, max_bytes=10**6)
    seen = answer.observation
    return np.array_equal(arrays["tactile_kpa"], seen.tactile_kpa) and all(
        np.array_equal(arrays[f"image/{camera}"], images) for camera, images in seen.images.items()
    )


async def test_what_did_not_change_is_not_sent_again(client):
    begun = await start(client)
    path = f"/v1/watch/{(await listed(client))['rollouts'][0]['watch_id']}"
    tag = (await client.get(path, headers=bearer("desk"))).headers["etag"]
    again = await client.get(path, headers=bearer("desk") | {"if-none-match": tag})
    assert (again.status_code, again.content) == (304, b"")
    await step(client, begun.rollout.id, 0)
    newer = await client.get(path, headers=bearer("desk") | {"if-none-match": tag})
    assert newer.status_code == 200
    assert newer.headers["etag"] != tag


async def test_watching_and_acting_need_scopes_of_their_own(client):
    begun = await start(client)
    watch_id = (await listed(client))["rollouts"][0]["watch_id"]
    for path in ("/v1/watch", f"/v1/watch/{watch_id}"):
        assert (await client.get(path)).status_code == 401
        for name in ("policy", "other"):
            assert (await client.get(path, headers=bearer(name))).status_code == 403
    path = f"/v1/rollouts/{begun.rollout.id}"
    assert (await client.get(path, headers=bearer("desk"))).status_code == 403
    # A watcher's name for a rollout opens nothing else.
    acting = f"/v1/rollouts/{watch_id}"
    assert (await client.delete(acting, headers=bearer("policy"))).status_code == 404


async def test_unknown_names_are_refused(client):
    for name, status in (("0" * 32, 404), ("x" * 32, 422), ("0" * 31, 422)):
        answer = await client.get(f"/v1/watch/{name}", headers=bearer("desk"))
        assert answer.status_code == status
        assert answer.headers["content-type"] == "application/problem+json"


async def test_watching_changes_nothing(state):
    """The same chunks with and without watchers, and the time to live is not renewed."""
    world = SumWorld()
    service = RolloutService({"sum": world}, state, RolloutLimits())
    watch = RolloutWatch(RecordStore(state, ttl_s=600.0))
    payloads = []
    for is_watched in (False, True):
        rollout_id = await begin(service)
        seen = []
        for chunk in range(3):
            answer = await service.step(rollout_id, chunk, actions(4, 0.5), ALL)
            seen.append(decoded(answer).observation.tactile_kpa.tolist())
            if is_watched:
                one = (await watch.listed(1)).rollouts[0]
                assert one.last_step == 4 * (chunk + 1)
                key = f"rollout:{one.watch_id}"
                before = await state.version(key)
                await watch.newest(one.watch_id)
                assert await state.version(key) == before > 0
        payloads.append(seen)
        await service.delete(rollout_id)
    assert payloads[0] == payloads[1]
    # Nothing was restored or computed for the watcher.
    assert world.num_steps == 6
    assert world.num_restores == 0
    service.close()


async def test_rollouts_of_other_processes_are_watched_too(state):
    here, there = (RolloutService({"sum": SumWorld()}, state) for _ in range(2))
    rollout_id = await begin(here)
    await there.step(rollout_id, 0, actions(4), ALL)
    watch = RolloutWatch(RecordStore(state, ttl_s=600.0))
    (one,) = [o for o in (await watch.listed(200)).rollouts if o.instruction == START.instruction]
    assert one.last_step == 4
    await here.delete(rollout_id)
    for service in (here, there):
        service.close()


def test_a_client_says_which_policy_it_plays():
    app = create_world_app({"sum": SumWorld()}, WorldServiceSettings())
    with served(app) as url, RolloutClient(url, name="colour servo") as client:
        asked = {"world": "sum", "task": "stand_bottle", "seed": 1, "instruction": "x"}
        with client.start(**asked):
            answer = client._link.request("GET", "/v1/watch")
    assert b'"client":"colour servo"' in answer.body
