"""Routes of browsers and players: order and cursors, lineage, trash, gaps, images and signals."""

import io

import numpy as np
import pytest
from httpx import ASGITransport, AsyncClient
from PIL import Image

from dextouch.episodes import EpisodeStore
from dextouch.schemas import LineageEntry
from dextouch.serving.keys import ApiKey
from dextouch.streams import StreamDescriptor, unpack
from services.episode_store.app import create_app
from tests.unit.episode_store.episodes import write_episode

SOURCE = [{"kind": "recording", "id": "take-1"}]
ROWS = {
    "e-1": {"task": "b", "created_at": "2026-03-01T10:00:00+00:00", "success": True},
    "e-2": {"task": "a", "created_at": "2026-03-01T12:00:00+02:00", "success": None},
    "e-3": {"task": "b", "created_at": "2026-03-01T11:00:00+00:00", "success": False},
    "e-4": {"task": "a", "instruction": "Fold the SHIRT", "lineage": SOURCE},
}


@pytest.fixture
def store(settings):
    return EpisodeStore(settings.store_url)


@pytest.fixture
async def http(settings):
    transport = ASGITransport(create_app(settings))
    async with AsyncClient(transport=transport, base_url="http://localhost") as client:
        yield client


@pytest.fixture
def rows(store):
    for name, changes in ROWS.items():
        write_episode(store, name, num_steps=2, **changes)


async def listed(http, **query):
    answer = await http.get("/v1/episodes", params=query)
    assert answer.status_code == 200, answer.text
    return answer.json()


async def ids(http, **query):
    return [row["episode_id"] for row in (await listed(http, **query))["episodes"]]


@pytest.mark.parametrize(
    ("query", "expected"),
    [
        ({"sort": "task"}, ["e-2", "e-4", "e-1", "e-3"]),
        ({"sort": "task", "descending": True}, ["e-3", "e-1", "e-4", "e-2"]),
        # e-4 has no time; 12:00 in Helsinki is 10:00 in London, so ids decide.
        ({"sort": "time"}, ["e-4", "e-1", "e-2", "e-3"]),
        ({"descending": True}, ["e-4", "e-3", "e-2", "e-1"]),
        ({"outcome": "not_judged"}, ["e-2"]),
        ({"outcome": "failure"}, ["e-3"]),
        ({"text": "shirt"}, ["e-4"]),
        ({"text": "E-3"}, ["e-3"]),
        ({"derived_from": "take-1"}, ["e-4"]),
    ],
)
async def test_order_and_filters(http, rows, query, expected):
    assert await ids(http, **query) == expected


@pytest.mark.long
@pytest.mark.parametrize("sort", ["id", "time", "duration", "task", "operator", "station"])
@pytest.mark.parametrize("descending", [False, True])
async def test_pages_join_to_the_list_even_if_a_row_goes(http, store, rows, sort, descending):
    order = {"sort": sort, "descending": descending}
    whole = await ids(http, **order)
    first = await listed(http, limit=2, **order)
    # The cursor's own row is deleted between two pages.
    store.delete(whole[1])
    second = await listed(http, limit=2, after=first["next_after"], **order)
    got = [row["episode_id"] for page in (first, second) for row in page["episodes"]]
    assert got == whole
    assert second["next_after"] is None


async def test_values_and_lineage(http, store, rows):
    made = [{"kind": "episode", "id": "e-4"}, {"kind": "checkpoint", "id": "wm-1"}]
    write_episode(store, "i-1", num_steps=2, origin="imagined", lineage=made)
    assert (await http.get("/v1/catalog/values")).json()["tasks"] == ["a", "b", "stand_bottle"]
    answer = await http.get("/v1/catalog/lineage/episode/e-4")
    nodes = {node["id"]: node for node in answer.json()["nodes"]}
    assert {name: node["relation"] for name, node in nodes.items()} == {
        "e-4": "self",
        "take-1": "source",
        "i-1": "product",
    }
    assert not nodes["take-1"]["is_stored"]
    assert nodes["i-1"]["made_from"] == ["e-4", "wm-1"]
    assert (await http.get("/v1/catalog/lineage/episode/e-9")).status_code == 404
    assert (await http.get("/v1/catalog/lineage/checkpoint/e-4")).status_code == 422


async def test_a_circle_of_lineage_ends(http, store):
    write_episode(store, "x", num_steps=2, lineage=[{"kind": "episode", "id": "y"}])
    write_episode(store, "y", num_steps=2, lineage=[{"kind": "episode", "id": "x"}])
    answer = await http.get("/v1/catalog/lineage/episode/x")
    assert [node["id"] for node in answer.json()["nodes"]] == ["x", "y"]


async def test_trash_and_back(http, store, rows):
    items = [{"kind": "episode", "id": name} for name in ("e-1", "e-9", "e-3")]
    answer = (await http.post("/v1/trash", json={"items": items})).json()
    assert [item["id"] for item in answer["moved"]] == ["e-1", "e-3"]
    assert [item["id"] for item in answer["refused"]] == ["e-9"]
    assert "not in the store" in answer["refused"][0]["reason"]
    assert await ids(http) == ["e-2", "e-4"]
    trash = (await http.get("/v1/trash", params={"limit": 1})).json()
    assert trash["num_items"] == 2
    assert [item["id"] for item in trash["items"]] == ["e-3"]
    assert trash["items"][0]["num_bytes"] > 0
    back = await http.post("/v1/trash/restore", json={"items": items[:1]})
    assert [item["id"] for item in back.json()["moved"]] == ["e-1"]
    assert store.list() == ["e-1", "e-2", "e-4"]
    again = (await http.post("/v1/trash/restore", json={"items": items[:1]})).json()
    assert again["refused"][0]["id"] == "e-1"


@pytest.mark.parametrize("items", [[], [{"kind": "upload", "id": "a"}], [{"kind": "episode"}]])
async def test_bad_moves_are_refused(http, items):
    assert (await http.post("/v1/trash", json={"items": items})).status_code == 422


@pytest.mark.parametrize("name", ["../e-1", ".", "E", "a" * 129])
async def test_names_that_no_item_has_are_not_moved(http, name):
    items = [{"kind": "episode", "id": name}]
    assert (await http.post("/v1/trash", json={"items": items})).status_code == 422


async def test_deleting_needs_its_own_scope(settings, store, rows):
    key = ApiKey(name="station", key="a-key-of-some-length", scopes=("store_read", "store_write"))
    app = create_app(settings.model_copy(update={"api_keys": (key,)}))
    headers = {"authorization": "Bearer a-key-of-some-length"}
    async with AsyncClient(
        transport=ASGITransport(app), base_url="http://localhost", headers=headers
    ) as client:
        body = {"items": [{"kind": "episode", "id": "e-1"}]}
        assert (await client.post("/v1/trash", json=body)).status_code == 403
        assert (await client.post("/v1/trash/restore", json=body)).status_code == 403
        assert (await client.get("/v1/trash")).status_code == 200
    assert store.exists("e-1")


async def test_gaps_of_a_stream(http, store):
    stamps = np.array([0, 10, 20, 50, 60, 75], dtype=np.int64) * 1_000_000
    with store.writer(attributes=store_attributes(store)) as writer:
        writer.add_stream(
            StreamDescriptor(
                name="head",
                kind="pose",
                shape=(7,),
                dtype="float64",
                unit="pose_m_wxyz",
                nominal_rate_hz=100,
            )
        )
        writer.append("head", values=np.ones((6, 7)), t_ref_ns=stamps)
    answer = (await http.get("/v1/playback/episode/gappy")).json()
    (stream,) = answer["streams"]
    # 15 ms is one and a half periods, which is not above it.
    assert stream["gaps_ns"] == [[20_000_000, 50_000_000]]
    assert (stream["num_gaps"], stream["num_samples"]) == (1, 6)
    assert (answer["start_ns"], answer["stop_ns"]) == (0, 75_000_000)


async def test_what_was_not_measured_is_there_to_be_drawn(store, http):
    states = np.zeros(320)
    states[[3, 90]] = 1, 8
    calibration = {
        "interpolated_head_s": ((0.2, 0.4),),
        "interpolated_fingers_left_s": ((0.1, 0.3, 3.0),),
        "tactile_left_refused_taxels": (tuple(states.tolist()),),
    }
    write_episode(store, "e", num_steps=9, calibration=calibration, absent=("wrist_right",))
    answer = (await http.get("/v1/playback/episode/e")).json()
    assert answer["absent"] == ["wrist_right"]
    streams = {stream["name"]: stream for stream in answer["streams"]}
    ms = 1_000_000
    assert streams["action"]["interpolated"] == [
        {"part": "ring_left", "start_ns": 100 * ms, "stop_ns": 300 * ms},
        {"part": "head", "start_ns": 200 * ms, "stop_ns": 400 * ms},
    ]
    assert streams["tactile_left"]["unmeasured_taxels"] == [3, 90]
    assert streams["camera_head"]["interpolated"] == []
    names = streams["action"]["components"]
    assert [names[k] for k in (0, 9, 12, 18, 57)] == [
        "wrist_left.x_m",
        "wrist_right.x_m",
        "wrist_right.r00",
        "l_thumb_cmc_flex_rad",
        "r_pinky_dip_rad",
    ]
    assert (len(names), streams["tactile_left"]["components"]) == (67, [])
    # Those of a person in the twin are of a human hand.
    write_episode(store, "human", domain="human")
    answer = (await http.get("/v1/playback/episode/human")).json()
    (human,) = (one["components"] for one in answer["streams"] if one["name"] == "action")
    assert [human[k] for k in (0, 18, 57)] == [names[0], "left_joint_0_rad", "right_joint_19_rad"]


def store_attributes(store):
    template = write_episode(store, "template", num_steps=1).attributes
    lineage = (LineageEntry(kind="recording", id="take-1"),)
    changes = {"episode_id": "gappy", "streams": (), "lineage": lineage}
    return template.model_copy(update=changes)


async def test_images_are_those_of_the_span(http, store):
    reader = write_episode(store, "e-1")
    stamps = reader.stamps_ns("camera_head")
    query = {"start_ns": int(stamps[2]), "stop_ns": int(stamps[5])}
    answer = await http.get("/v1/playback/episode/e-1/images/camera_head", params=query)
    fields, arrays = unpack(answer.content, max_bytes=1 << 20)
    assert fields == {"camera": "camera_head"}
    np.testing.assert_array_equal(arrays["t_ns"], stamps[2:5])
    ends = np.cumsum(arrays["num_bytes"])
    for k, end in enumerate(ends):
        data = arrays["data"][end - arrays["num_bytes"][k] : end].tobytes()
        picture = np.asarray(Image.open(io.BytesIO(data)), dtype=float)
        expected = reader.images("camera_head", 2 + k, 3 + k)[0].astype(float)
        # The next image differs by 1 everywhere: only its mean tells them apart.
        assert abs((picture - expected).mean()) < 0.6
    again = {"if-none-match": answer.headers["etag"]}
    url = "/v1/playback/episode/e-1/images/camera_head"
    assert (await http.get(url, params=query, headers=again)).status_code == 304
    half = await http.get(url, params=query | {"half_size": True})
    _, arrays = unpack(half.content, max_bytes=1 << 20)
    first = arrays["data"][: arrays["num_bytes"][0]].tobytes()
    assert Image.open(io.BytesIO(first)).size == (16, 16)


@pytest.mark.parametrize("stop_ns", [2**62, 2**63 - 1, 10**30])
async def test_signals_to_the_end_are_those_until_the_largest_time(http, store, stop_ns):
    write_episode(store, "e-1")
    url, query = "/v1/playback/episode/e-1/signals", {"names": "action", "points": 1, "start_ns": 0}
    to_the_end, most = [
        await http.get(url, params=query | {"stop_ns": stop}) for stop in (stop_ns, 2**62 - 1)
    ]
    assert to_the_end.status_code == 200, to_the_end.text
    assert to_the_end.content == most.content


@pytest.mark.parametrize(
    ("path", "status"),
    [
        ("episode/e-1/images/tactile_left", 422),
        ("episode/e-1/images/no_camera", 422),
        ("episode/e-9", 404),
        ("rollout/e-1", 422),
        ("episode/..%2Fe-1", 404),
        ("episode/e-1/signals?names=tactile_left&start_ns=5&stop_ns=5", 422),
        (f"episode/e-1/signals?names=tactile_left&start_ns={2**63}&stop_ns={2**64}", 422),
        ("episode/e-1/signals?names=tactile_left.320&start_ns=0&stop_ns=5", 422),
        ("episode/e-1/signals?names=tactile_left.%C2%B2&start_ns=0&stop_ns=5", 422),
        ("episode/e-1/signals?names=camera_head&start_ns=0&stop_ns=5", 422),
        ("episode/e-1/signals?names=" + ",".join(f"action.{k}" for k in range(17)), 422),
        ("episode/e-1/signals?names=action&start_ns=0&stop_ns=5&points=4001", 422),
    ],
)
async def test_what_cannot_be_played_is_refused(http, store, path, status):
    write_episode(store, "e-1")
    answer = await http.get(f"/v1/playback/{path}")
    assert answer.status_code == status, answer.text
    assert answer.json()["detail"]


async def test_too_many_images_are_refused(settings, store):
    write_episode(store, "e-1")
    app = create_app(settings.model_copy(update={"max_answer_bytes": 4 * 32 * 32 * 3}))
    async with AsyncClient(transport=ASGITransport(app), base_url="http://localhost") as client:
        answer = await client.get("/v1/playback/episode/e-1/images/camera_head")
    assert answer.status_code == 413
    assert "expected at most 4" in answer.json()["detail"]


async def test_signals_are_extremes_of_their_bins(http, store):
    reader = write_episode(store, "e-1")
    sums = reader.read("tactile_left").values.astype(float).sum(axis=1)
    # Nine samples at 15 Hz in ten bins of 100 ms: two of the bins hold two samples, three none.
    names = "tactile_left,tactile_left.7,tactile_left.max,action.interval_ms"
    query = {"names": names, "points": 10}
    query |= {"start_ns": 0, "stop_ns": 10**9}
    answer = await http.get("/v1/playback/episode/e-1/signals", params=query)
    assert answer.status_code == 200, answer.text
    _, arrays = unpack(answer.content, max_bytes=1 << 20)
    bins = (reader.stamps_ns("tactile_left") // 10**8).tolist()
    for place in range(10):
        inside = [sums[k] for k, one in enumerate(bins) if one == place]
        low, high = arrays["tactile_left/low"][place], arrays["tactile_left/high"][place]
        if inside:
            np.testing.assert_allclose([low, high], [min(inside), max(inside)], rtol=1e-6)
        else:
            assert np.isnan([low, high]).all()
    assert arrays["tactile_left.7/low"][0] == min(reader.read("tactile_left").values[:2, 7])
    assert arrays["tactile_left.max/high"][0] == reader.read("tactile_left").values[:2].max()
    np.testing.assert_allclose(np.nanmax(arrays["action.interval_ms/high"]), 66.7, atol=0.1)
