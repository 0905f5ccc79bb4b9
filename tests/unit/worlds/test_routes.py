"""The routes: every content type, every refusal as problem+json, and nothing makes a 500."""

import base64
import json
import threading

import anyio.to_thread
import hypothesis.strategies as st
import msgpack
import numpy as np
import pytest
from httpx import ASGITransport, AsyncClient
from hypothesis import HealthCheck, given, settings
from pydantic import SecretStr

from dextouch.schemas import (
    Problem,
    RolloutInfo,
    RolloutStart,
    StartRequest,
    decode_answer,
    encode_start,
)
from dextouch.serving.keys import ApiKey
from dextouch.worlds import CopyFirstWorld, WorldServiceSettings, create_world_app, routes
from tests.unit.worlds.fakes import CAMERAS, K_HEAD, SumWorld, actions, anchor, observation

MSGPACK = {"content-type": "application/msgpack"}
JSON = {"content-type": "application/json"}
FLOAT64 = {"content-type": "application/octet-stream; dtype=float64"}
FLOAT32 = {"content-type": "application/octet-stream; dtype=float32"}
START = {"world": "sum", "task": "stand_bottle", "seed": 3, "instruction": "stand it"}
MAX_BODY_BYTES = 2**20


def make_app(**changed):
    world = SumWorld()
    worlds = {"sum": world, "copy-first": CopyFirstWorld.beside(world.description)}
    return create_world_app(worlds, WorldServiceSettings(max_body_bytes=MAX_BODY_BYTES, **changed))


def client_of(app):
    transport = ASGITransport(app, raise_app_exceptions=False)
    return AsyncClient(transport=transport, base_url="http://localhost")


@pytest.fixture
async def client():
    app = make_app()
    async with app.router.lifespan_context(app), client_of(app) as opened:
        yield opened


async def begin(client) -> str:
    response = await client.post("/v1/rollouts", json=START)
    assert response.status_code == 201, response.text
    return decode_answer(response.content, max_bytes=10**6).rollout.id


def problem_of(response) -> Problem:
    assert response.headers["content-type"] == "application/problem+json", response.text
    assert "Traceback" not in response.text
    return Problem.model_validate_json(response.content)


async def test_worlds_are_listed(client):
    listed = (await client.get("/v1/worlds")).json()["worlds"]
    assert [one["name"] for one in listed] == ["sum", "copy-first"]
    assert listed[0]["tasks"] == ["stand_bottle", "stack_bowls"]


async def test_an_ended_rollout_is_a_problem_with_its_reason(client):
    path = f"/v1/rollouts/{await begin(client)}"
    url = f"{path}/chunks/0?steps=last&cameras="
    for value in (4e6, 0.0):
        body = actions(4, value).astype("<f8").tobytes()
        problem = problem_of(await client.post(url, content=body, headers=FLOAT64))
        assert (problem.status, problem.title) == (409, "Ended")
        assert problem.details["reason"] == "too many to count"
        assert problem.details["last_chunk"] is None
    assert (await client.get(path)).json()["ended"] == "too many to count"


async def test_every_kind_of_chunk_body_means_the_same(client):
    chunk = actions(4, 0.5)
    bodies = [
        (json.dumps({"actions": chunk.tolist()}).encode(), JSON),
        (chunk.astype("<f8").tobytes(), FLOAT64),
        (chunk.astype("<f4").tobytes(), FLOAT32),
    ]
    contents = []
    for body, headers in bodies:
        rollout_id = await begin(client)
        path = f"/v1/rollouts/{rollout_id}/chunks/0"
        response = await client.post(path, content=body, headers=headers)
        assert response.status_code == 200, response.text
        assert response.headers["dextouch-replayed"] == "false"
        assert response.headers["content-type"] == "application/msgpack"
        contents.append(decode_answer(response.content, max_bytes=10**6).observation)
        # 0.5 is exact in both widths, so the other ways of saying it are the same request.
        for other, other_headers in bodies:
            again = await client.post(path, content=other, headers=other_headers)
            assert again.headers["dextouch-replayed"] == "true"
            assert again.content == response.content
    for seen in contents[1:]:
        np.testing.assert_array_equal(seen.tactile_kpa, contents[0].tactile_kpa)


async def test_timing_tells_queue_and_device(client):
    path = f"/v1/rollouts/{await begin(client)}/chunks/0"
    response = await client.post(path, content=actions(4).tobytes(), headers=FLOAT64)
    names = [part.split(";")[0] for part in response.headers["server-timing"].split(", ")]
    assert names == ["decode", "queue", "device", "encode", "store", "total"]


async def test_metrics_tell_parts_and_batches(client):
    path = f"/v1/rollouts/{await begin(client)}/chunks/0"
    await client.post(path, content=actions(4).tobytes(), headers=FLOAT64)
    text = (await client.get("/metrics")).text
    route = "/v1/rollouts/{rollout_id}/chunks/{chunk}"
    for part in ("decode", "queue", "device", "encode", "store"):
        labels = f'{{part="{part}",route="{route}"}}'
        assert f"dextouch_http_part_seconds_count{labels} 1.0" in text
    for name in (
        'bucket{le="1.0",world="sum"}',
        'bucket{le="+Inf",world="sum"}',
        'sum{world="sum"}',
    ):
        assert f"dextouch_batch_rollouts_{name} 1.0" in text


async def test_the_selector_narrows_the_answer(client):
    path = f"/v1/rollouts/{await begin(client)}/chunks/0"
    query = f"?steps=last&tactile=false&cameras={CAMERAS[1]}"
    response = await client.post(path + query, content=actions(8).tobytes(), headers=FLOAT64)
    message = msgpack.unpackb(response.content)
    assert message["fields"]["observation"]["first_step"] == 8
    assert set(message["arrays"]) == {"action_reached", "image/camera_wrist_left"}
    assert message["arrays"]["action_reached"]["shape"] == [1, 67]


async def test_a_chunk_waits_for_no_thread_but_its_worlds(client, monkeypatch):
    """A thread of the pool for its query cost a chunk a tenth of its time."""
    path = f"/v1/rollouts/{await begin(client)}/chunks/0?steps=last"
    taken = []
    run_sync = anyio.to_thread.run_sync

    async def counted(*call, **options):
        taken.append(call)
        return await run_sync(*call, **options)

    monkeypatch.setattr(anyio.to_thread, "run_sync", counted)
    response = await client.post(path, content=actions(4).tobytes(), headers=FLOAT64)
    assert response.status_code == 200
    assert not taken


async def test_large_json_chunks_are_decoded_beside_the_event_loop(client, monkeypatch):
    path = f"/v1/rollouts/{await begin(client)}/chunks/0"
    decoded_in = []
    validate = routes.validate_fields

    def noted(*args, **options):
        decoded_in.append(threading.current_thread())
        return validate(*args, **options)

    monkeypatch.setattr(routes, "validate_fields", noted)
    for num_steps in (4, 1000):
        body = {"actions": actions(num_steps).tolist()}
        await client.post(path, json=body)
    assert decoded_in[0] is threading.current_thread()
    assert decoded_in[1] is not threading.current_thread()


@pytest.mark.parametrize("rows", [["x"] * 1000, [["x"] * 1000]])
async def test_only_the_first_mistake_of_a_chunk_is_told(client, rows):
    path = f"/v1/rollouts/{await begin(client)}/chunks/0"
    problem = problem_of(await client.post(path, json={"actions": rows}))
    assert problem.status == 422
    assert problem.detail.count("actions.") == 1


async def test_json_answers_hold_the_same(client):
    accept = {"accept": "application/json"}
    response = await client.post("/v1/rollouts", json=START, headers=accept)
    body = response.json()
    assert body["fields"]["rollout"]["next_chunk"] == 0
    tactile = body["arrays"]["tactile_kpa"]
    values = np.frombuffer(base64.b64decode(tactile["data"]), tactile["dtype"])
    np.testing.assert_array_equal(values.reshape(tactile["shape"]), np.full((1, 2, 320), 3.0))


async def test_start_from_an_observation_ignores_other_cameras(client):
    start = RolloutStart("stand_bottle", 1, "x", "commanded", observation(seed=4), anchor(), K_HEAD)
    start.observation.images["camera_ceiling"] = start.observation.images[CAMERAS[0]]
    request = StartRequest(world="copy-first", task="stand_bottle", seed=1, instruction="x")
    body = encode_start(request, start)
    response = await client.post("/v1/rollouts", content=body, headers=MSGPACK)
    answer = decode_answer(response.content, max_bytes=10**6)
    assert set(answer.observation.images) == set(CAMERAS)
    np.testing.assert_array_equal(answer.origin.K_head, K_HEAD)


async def test_get_fork_delete(client):
    rollout_id = await begin(client)
    info = RolloutInfo.model_validate((await client.get(f"/v1/rollouts/{rollout_id}")).json())
    assert (info.id, info.next_chunk, info.ttl_s) == (rollout_id, 0, 600.0)
    forked = await client.post(f"/v1/rollouts/{rollout_id}/fork", json={"seed": 7})
    assert forked.status_code == 201
    assert (forked.json()["seed"], forked.json()["id"] != rollout_id) == (7, True)
    assert (await client.delete(f"/v1/rollouts/{rollout_id}")).status_code == 204
    for method in ("GET", "DELETE"):
        gone = await client.request(method, f"/v1/rollouts/{rollout_id}")
        assert problem_of(gone).status == 404


async def test_a_key_needs_the_scope_rollout():
    key = "a-key-of-some-length"
    app = make_app(api_keys=(ApiKey(name="rater", key=SecretStr(key), scopes=("rate",)),))
    async with client_of(app) as client:
        assert problem_of(await client.get("/v1/worlds")).status == 401
        header = {"authorization": f"Bearer {key}"}
        assert problem_of(await client.get("/v1/worlds", headers=header)).status == 403
        assert (await client.get("/healthz")).status_code == 200


@pytest.mark.parametrize(
    ("body", "headers", "status", "says"),
    [
        (actions(6).tobytes(), FLOAT64, 422, "multiple of 4"),
        (actions(20).tobytes(), FLOAT64, 413, "at most 16"),
        (actions(4).tobytes()[:-1], FLOAT64, 422, "multiple of 536"),
        (b"", FLOAT64, 422, "got 0 bytes"),
        (np.full((4, 67), np.nan).tobytes(), FLOAT64, 422, "row 0, column 0"),
        (np.full((4, 67), np.inf).tobytes(), FLOAT64, 422, "infinite"),
        (actions(4).tobytes(), {"content-type": "application/octet-stream"}, 422, "dtype"),
        (actions(4).tobytes(), {"content-type": "text/plain"}, 415, "Content-Type"),
        (actions(4).tobytes(), {}, 415, "Content-Type"),
        (b"{", JSON, 422, "body"),
        (b'{"actions": [[1, 2]]}', JSON, 422, "67"),
        (b'{"actions": []}', JSON, 422, "67"),
        (b'{"actions": [[NaN]]}', JSON, 422, "67"),
        (b'{"actions": [' + b"[]," * 5000 + b"[]]}", JSON, 422, "at most 4096 items"),
        (json.dumps({"actions": [[float("nan")] * 67] * 4}).encode(), JSON, 422, "NaN"),
        (json.dumps({"actions": [["1"] * 67] * 4}).encode(), JSON, 422, "valid number"),
        (json.dumps({"actions": [[True] * 67] * 4}).encode(), JSON, 422, "valid number"),
        (b'{"actions": 3, "more": 1}', JSON, 422, "actions"),
        (actions(4, 1e6).tobytes(), FLOAT64, 422, "1e6 cannot"),
        (actions(4, 3e6).tobytes(), FLOAT64, 422, "stays as it was"),
        (b"x" * (MAX_BODY_BYTES + 1), FLOAT64, 413, str(MAX_BODY_BYTES)),
    ],
)
async def test_bad_chunks_are_refused_and_change_nothing(client, body, headers, status, says):
    rollout_id = await begin(client)
    path = f"/v1/rollouts/{rollout_id}/chunks/0"
    problem = problem_of(await client.post(path, content=body, headers=headers))
    assert problem.status == status
    assert says in problem.detail
    good = await client.post(path, content=actions(4).tobytes(), headers=FLOAT64)
    assert good.status_code == 200


@pytest.mark.parametrize(
    ("changed", "says"),
    [
        ({"world": "moon"}, "valid: copy-first, sum"),
        ({"task": "juggle"}, "valid: stack_bowls, stand_bottle"),
        ({"seed": -1}, "seed"),
        ({"seed": 2**63}, "seed"),
        ({"seed": "many"}, "seed"),
        ({"action_kind": "wished"}, "action_kind"),
        ({"action_kind": "measured"}, "valid: commanded"),
        ({"instruction": "x" * 2001}, "instruction"),
        ({"colour": "red"}, "colour"),
        ({"world": "copy-first"}, "expected one of observation"),
    ],
)
async def test_bad_starts_are_refused(client, changed, says):
    problem = problem_of(await client.post("/v1/rollouts", json=START | changed))
    assert problem.status == 422
    assert says in problem.detail


@pytest.mark.parametrize(
    ("path", "status"),
    [
        ("/v1/rollouts/none/chunks/0", 404),
        ("/v1/rollouts/none/chunks/first", 422),
        ("/v1/rollouts/%00%ff*/chunks/0", 404),
        ("/v1/rollouts/none/fork", 415),
        ("/v1/nothing", 404),
        ("/v1/rollouts/a/chunks/0?steps=some", 422),
        ("/v1/rollouts/a/chunks/0?pad=hold", 422),
        ("/v1/rollouts/a/chunks/0?camera=camera_head", 422),
    ],
)
async def test_unknown_places(client, path, status):
    response = await client.post(path, content=actions(4).tobytes(), headers=FLOAT64)
    assert problem_of(response).status == status


async def test_a_mistake_inside_a_world_is_a_500_that_tells_nothing(client):
    path = f"/v1/rollouts/{await begin(client)}/chunks/0"
    response = await client.post(path, content=actions(4, 2e6).tobytes(), headers=FLOAT64)
    assert problem_of(response).status == 500
    assert "mistake" not in response.text
    good = await client.post(path, content=actions(4).tobytes(), headers=FLOAT64)
    assert good.status_code == 200


SLACK = settings(
    max_examples=60, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture]
)
JSON_LIKE = st.recursive(
    st.none() | st.booleans() | st.integers() | st.floats() | st.text(max_size=8),
    lambda inner: (
        st.lists(inner, max_size=4)
        | st.dictionaries(st.sampled_from(["actions", "world", "seed", "start", "x"]), inner)
    ),
    max_leaves=12,
)


@pytest.mark.long
@SLACK
@given(
    body=st.binary(max_size=5000) | JSON_LIKE.map(lambda value: json.dumps(value).encode()),
    headers=st.sampled_from([FLOAT64, FLOAT32, JSON, MSGPACK, {}]),
)
async def test_no_chunk_body_makes_a_500(client, body, headers):
    response = await client.post("/v1/rollouts/none/chunks/0", content=body, headers=headers)
    assert 400 <= problem_of(response).status < 500


async def test_a_start_with_an_absurd_shape_is_refused(client):
    """An empty array whose other axes numpy cannot hold."""
    start = RolloutStart("stand_bottle", 1, "x", "commanded", observation(), anchor(), K_HEAD)
    request = StartRequest(world="copy-first", task="stand_bottle", seed=1, instruction="x")
    message = msgpack.unpackb(encode_start(request, start))
    message["arrays"]["tactile_kpa"] |= {"shape": [0, 2**62, 320], "data": b""}
    response = await client.post("/v1/rollouts", content=msgpack.packb(message), headers=MSGPACK)
    problem = problem_of(response)
    assert problem.status == 422
    assert "'tactile_kpa': shape [0, 4611686018427387904, 320]" in problem.detail


def damaged_start(data: st.DataObject) -> bytes:
    """A good start of which one value was replaced by another."""
    start = RolloutStart("stand_bottle", 1, "x", "commanded", observation(), anchor(), K_HEAD)
    request = StartRequest(world="copy-first", task="stand_bottle", seed=1, instruction="x")
    message = msgpack.unpackb(encode_start(request, start))
    arrays = message["arrays"]
    where = data.draw(st.sampled_from(["field", "array", "part", "cut"]))
    anything = st.none() | st.integers(-10, 10) | st.binary(max_size=4) | st.text(max_size=4)
    if where == "cut":
        whole = msgpack.packb(message)
        return whole[: data.draw(st.integers(0, len(whole) - 1))]
    if where == "field":
        fields = message["fields"][data.draw(st.sampled_from(["start", "observation"]))]
        fields[data.draw(st.sampled_from(sorted(fields)))] = data.draw(
            st.none()
            | st.lists(st.integers(-(2**63), 2**64 - 1), max_size=2)
            | st.floats(allow_nan=True)
        )
    elif where == "array":
        del arrays[data.draw(st.sampled_from(sorted(arrays)))]
    else:
        array = arrays[data.draw(st.sampled_from(sorted(arrays)))]
        array[data.draw(st.sampled_from(["dtype", "shape", "data"]))] = data.draw(
            anything
            | st.lists(st.integers(-1, 70), max_size=5)
            | st.lists(st.sampled_from([0, 1, 320, 2**31, 2**62, 2**64 - 1]), max_size=5)
        )
    return msgpack.packb(message)


@SLACK
@given(data=st.data())
async def test_no_start_body_makes_a_500(client, data):
    body = damaged_start(data)
    response = await client.post("/v1/rollouts", content=body, headers=MSGPACK)
    # Some replacements are as good as what stood there; such a start is taken and ended again.
    if response.status_code == 201:
        rollout_id = decode_answer(response.content, max_bytes=10**6).rollout.id
        assert (await client.delete(f"/v1/rollouts/{rollout_id}")).status_code == 204
    else:
        assert 400 <= problem_of(response).status < 500
