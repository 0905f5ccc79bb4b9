"""Practice devices: a second mock station below the first one's address, while it is on."""

import httpx
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from dextouch.serving.keys import ApiKey
from services.acquisition import app as station_app
from services.acquisition.mocks import pattern
from services.acquisition.retention import spooled_takes
from services.acquisition.settings import AcquisitionSettings

HEADS = {"head"}
KEY = "5f1c93b07ad24e68"


@pytest.fixture
def settings(tmp_path, monkeypatch):
    whole = pattern.pattern_streams
    monkeypatch.setattr(pattern, "NUM_POSES", 2)
    monkeypatch.setattr(
        pattern,
        "pattern_streams",
        lambda round_s=1.0, *, layout=None: [
            s for s in whole(round_s, layout=layout) if s.descriptor.name in HEADS
        ],
    )
    return AcquisitionSettings(spool=tmp_path / "spool", mock=True)


async def test_practice_devices_are_there_while_they_are_on(settings, tmp_path):
    app = station_app.create_app(settings)
    transport = httpx.ASGITransport(app=app)
    async with (
        app.router.lifespan_context(app),
        httpx.AsyncClient(transport=transport, base_url="http://localhost") as client,
    ):
        assert (await client.get("/v1/practice")).json() == {"state": "off"}
        assert (await client.get("/practice/v1/health")).status_code == 404
        assert (await client.post("/v1/practice/start")).json() == {"state": "on"}
        assert (await client.post("/v1/practice/start")).json() == {"state": "on"}
        health = (await client.get("/practice/v1/health")).json()
        assert "camera_head" in {stream["stream"] for stream in health["streams"]}
        assert all(device["simulated"] for device in health["devices"])
        own = (await client.get("/v1/health")).json()
        assert {stream["stream"] for stream in own["streams"]} == HEADS
        armed = {"task": "calibrate", "instruction": "rest"}
        reply = await client.post("/practice/v1/recorder/arm", json=armed)
        assert reply.json()["state"] == "armed"
        assert (await client.get("/v1/recorder")).json()["state"] == "idle"
        named = {"recording_id": "rest"}
        for action in ("record", "stop", "save"):
            body = named | ({"accept_incomplete": True} if action == "save" else {})
            reply = await client.post(f"/practice/v1/recorder/{action}", json=body)
            assert reply.status_code == 200, reply.text
        spool = tmp_path / "spool_practice"
        assert spooled_takes(spool) == [spool / "rest"]
        assert (await client.post("/v1/practice/stop")).json() == {"state": "off"}
        # Takes of the time before are not uploaded, and would stay for ever.
        await client.post("/v1/practice/start")
        assert spooled_takes(spool) == []
        assert (await client.post("/v1/practice/stop")).json() == {"state": "off"}
        assert (await client.get("/practice/v1/health")).status_code == 404


async def test_practice_devices_need_the_keys_of_their_station(settings):
    key = ApiKey(name="bench", key=KEY, scopes=("station",))
    app = station_app.create_app(settings.model_copy(update={"api_keys": (key,)}))
    transport = httpx.ASGITransport(app=app)
    known = {"authorization": f"Bearer {KEY}"}
    async with (
        app.router.lifespan_context(app),
        httpx.AsyncClient(transport=transport, base_url="http://localhost") as client,
    ):
        assert (await client.post("/v1/practice/start")).status_code == 401
        assert (await client.post("/v1/practice/start", headers=known)).json() == {"state": "on"}
        for given, status in (({}, 401), ({"authorization": "Bearer wrong"}, 401), (known, 200)):
            for path in ("/practice/v1/health", "/practice/v1/recorder"):
                assert (await client.get(path, headers=given)).status_code == status
            armed = {"task": "calibrate", "instruction": "rest"}
            reply = await client.post("/practice/v1/recorder/arm", json=armed, headers=given)
            assert reply.status_code == status


async def test_a_station_of_real_devices_has_none(tmp_path):
    camera = {"kind": "camera", "stream": "camera_head", "port": 5000}
    app = station_app.create_app(AcquisitionSettings(spool=tmp_path / "spool", devices=(camera,)))
    transport = httpx.ASGITransport(app=app)
    async with httpx.AsyncClient(transport=transport, base_url="http://localhost") as client:
        assert (await client.get("/v1/practice")).json() == {"state": "unavailable"}
        reply = await client.post("/v1/practice/start")
    assert reply.status_code == 409
    assert "dextouch up --mock" in reply.json()["detail"]


def test_the_practice_tracker_moves_as_the_board_is_seen():
    """Board in the world = tracker · mount · board in the camera, at every image at rest."""
    heads = pattern._practice_heads(0)
    first = 0
    for pose, num_still in zip(pattern._board_poses(), pattern._rests(), strict=True):
        seen = np.eye(4)
        seen[:3, :3] = Rotation.from_rotvec(pose[:3]).as_matrix()
        middle = np.array([4 * 0.025, 2.5 * 0.025, 0.0])
        seen[:3, 3] = pose[3:] - seen[:3, :3] @ middle
        for image in (first, first + num_still - 1):
            # Ten poses an image.
            board = heads[10 * image] @ pattern.T_TRACKER_CAMERA @ seen
            difference = np.linalg.inv(pattern.T_WORLD_BOARD) @ board
            # Four sigmas of the tracker at each of three axes, on a lever of a metre.
            assert Rotation.from_matrix(difference[:3, :3]).magnitude() < np.deg2rad(0.15)
            assert np.linalg.norm(difference[:3, 3]) < 0.004
        first += num_still + pattern.MOVING_IMAGES
    assert len(heads) == 10 * first
