"""An operator's way through a take over HTTP, on a station with mock devices."""

import asyncio
from contextlib import asynccontextmanager

import httpx
import numpy as np
import pytest

from dextouch.episodes.spool import SpoolReader
from dextouch.streams import unpack
from services.acquisition.app import create_app
from services.acquisition.mocks import pattern
from services.acquisition.settings import AcquisitionSettings

# Of the specification (https://www.w3.org/TR/trace-context/).
TRACE_ID = "4bf92f3577b34da6a3ce929d0e0e4736"
PROMPT = {"task": "stack_bowls", "instruction": "stack the bowls"}


@asynccontextmanager
async def station(tmp_path, **options):
    settings = AcquisitionSettings(spool=tmp_path, mock=True, mock_faults="none", **options)
    app = create_app(settings)
    async with app.router.lifespan_context(app):
        transport = httpx.ASGITransport(app)
        async with httpx.AsyncClient(transport=transport, base_url="http://localhost") as client:
            yield client


async def assert_history(client, recording_id, names):
    """The history holds rows of all streams and the take, in both formats; queries are checked."""
    path = "/v1/health/history"
    async with asyncio.timeout(30):
        while True:
            history = (await client.get(path)).json()
            if history["t_ns"]:
                break
            await asyncio.sleep(0.1)
    assert set(history["streams"]) == set(history["nominal_rate_hz"]) == names
    assert [take["recording_id"] for take in history["takes"]] == [recording_id]
    assert history["takes"][0]["start_ns"] < history["takes"][0]["stop_ns"] <= history["now_ns"]
    assert {len(column) for column in history["streams"]["head"]} == {len(history["t_ns"])}
    query = {"stream": "head", "limit": 1, "format": "msgpack"}
    fields, arrays = unpack((await client.get(path, params=query)).content, max_bytes=10_000)
    assert fields["nominal_rate_hz"] == {"head": 100.0}
    shape = (1, len(fields["stream_series"]), 1)
    assert (arrays["streams"].dtype, arrays["streams"].shape) == (np.float32, shape)
    assert arrays["t_ns"].shape == (1,)
    assert (await client.get(path, params={"since_ns": 2**62})).json()["t_ns"] == []
    unknown = await client.get(path, params={"stream": "nose"})
    assert unknown.status_code == 422
    assert "head" in unknown.json()["detail"]
    assert (await client.get(path, params={"limit": 3601})).status_code == 422


async def until_samples(client, count):
    async with asyncio.timeout(300):
        while True:
            answer = (await client.get("/v1/recorder")).json()
            if min(answer["num_samples"].values(), default=0) >= count:
                return
            await asyncio.sleep(0.02)


async def test_a_take_over_http(tmp_path):
    async with station(tmp_path) as client:
        assert (await client.get("/readyz")).status_code == 200
        assert (await client.get("/v1/recorder")).json()["state"] == "idle"
        assert (await client.post("/v1/recorder/arm", json=PROMPT)).json()["state"] == "armed"
        recording_id = (await client.post("/v1/recorder/record")).json()["recording_id"]
        await until_samples(client, 5)
        stopped = (await client.post("/v1/recorder/stop")).json()
        assert stopped["state"] == "checking"
        assert set(stopped["actions"]) == {"save", "discard", "rerecord"}
        body = {"success": True, "accept_incomplete": True}
        assert (await client.post("/v1/recorder/save", json=body)).json()["state"] == "saved"
        spool = SpoolReader(tmp_path / recording_id)
        assert spool.closed
        assert spool.attributes.success
        uploads = (await client.get("/v1/uploads")).json()
        assert [u["recording_id"] for u in uploads] == [recording_id]
        assert uploads[0]["error"].startswith("no episode_store_url is set")

        health = (await client.get("/v1/health")).json()
        assert {s["stream"] for s in health["streams"]} == set(spool.streams)
        assert all(d["connected"] for d in health["devices"])
        await assert_history(client, recording_id, set(spool.streams))
        fields, arrays = unpack((await client.get("/v1/live/taxels")).content, max_bytes=10_000)
        assert fields == {}
        assert arrays["tactile_left"].shape == (320,)
        assert arrays["tactile_left"].dtype == np.float32
        fields, arrays = unpack((await client.get("/v1/live/poses")).content, max_bytes=10_000)
        trackers = {"head", "wrist_left", "wrist_right", "keypoints_left", "keypoints_right"}
        assert set(fields["age_s"]) == trackers
        assert all(0 <= age_s < 300 for age_s in fields["age_s"].values())
        assert set(fields["late_s"]) == trackers
        assert all(late_s >= 0 for late_s in fields["late_s"].values())
        shapes = {"keypoints": (25, 3), "wrist": (4, 4), "head": (4, 4)}
        assert all(arrays[name].shape == shapes[name.split("_")[0]] for name in arrays)
        cameras = (await client.get("/v1/live/cameras")).json()["cameras"]
        assert [c["name"] for c in cameras] == [
            "camera_head",
            "camera_wrist_left",
            "camera_wrist_right",
        ]
        image = await client.get("/v1/live/cameras/camera_head")
        assert image.headers["content-type"] == "image/jpeg"
        assert image.content[:2] == b"\xff\xd8"


async def test_refusals_are_problems(tmp_path):
    async with station(tmp_path) as client:
        answer = await client.post("/v1/recorder/record")
        assert answer.status_code == 409
        assert answer.headers["content-type"] == "application/problem+json"
        assert "possible now: arm" in answer.json()["detail"]
        answer = await client.post("/v1/recorder/arm", json={"task": "a"})
        assert answer.status_code == 422
        assert "instruction" in answer.json()["detail"]
        answer = await client.get("/v1/live/cameras/nowhere")
        assert answer.status_code == 404


async def test_a_take_keeps_the_trace_in_which_it_was_saved(tmp_path, monkeypatch):
    streams = [s for s in pattern.pattern_streams() if s.descriptor.name == "head"]
    monkeypatch.setattr(pattern, "pattern_streams", lambda **_: streams)
    async with station(tmp_path) as client:
        await client.post("/v1/recorder/arm", json=PROMPT)
        recording_id = (await client.post("/v1/recorder/record")).json()["recording_id"]
        await until_samples(client, 3)
        await client.post("/v1/recorder/stop")
        saved = await client.post(
            "/v1/recorder/save",
            json={"accept_incomplete": True},
            headers={"traceparent": f"00-{TRACE_ID}-00f067aa0ba902b7-01"},
        )
        assert saved.is_success, saved.text
    assert SpoolReader(tmp_path / recording_id).attributes.trace_id == TRACE_ID


async def test_keys_are_asked_for(tmp_path):
    key = {"name": "desk", "key": "a-key-of-some-length", "scopes": ["station"]}
    async with station(tmp_path, api_keys=(key,)) as client:
        assert (await client.get("/v1/recorder")).status_code == 401
        headers = {"authorization": "Bearer a-key-of-some-length"}
        assert (await client.get("/v1/recorder", headers=headers)).status_code == 200


def test_a_station_without_devices_is_refused(tmp_path):
    from dextouch.errors import InvalidInputError

    with pytest.raises(InvalidInputError, match="at least one"):
        create_app(AcquisitionSettings(spool=tmp_path))
