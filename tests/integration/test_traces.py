"""The trace of a plain HTTP client, from an upload to the recording, its episode and the lists."""

import httpx
import numpy as np
import pytest

from dextouch.episodes import EpisodeStore
from dextouch.streams import SampleBatch, StreamDescriptor, encode_batch
from services.alignment.jobs import align_recording
from services.alignment.settings import AlignmentOptions
from services.episode_store.app import create_app
from services.episode_store.settings import EpisodeStoreSettings
from services.pipelines.servers import served
from tests.unit.alignment.recordings import write_recording

# Of the specification (https://www.w3.org/TR/trace-context/).
TRACE_ID = "4bf92f3577b34da6a3ce929d0e0e4736"
PARENT = f"00-{TRACE_ID}-00f067aa0ba902b7-01"
OTHER = "0af7651916cd43dd8448eb211c80319c"
STREAM = StreamDescriptor(
    name="head",
    kind="pose",
    shape=(7,),
    dtype="float64",
    unit="pose_m_wxyz",
    nominal_rate_hz=100,
)
TAKE = {
    "recording_id": "take-1",
    "task": "stand_bottle",
    "instruction": "stand it up",
    "domain": "human",
    "station": "bench",
    "streams": [STREAM.model_dump(mode="json")],
}


@pytest.fixture
def folder(tmp_path):
    return str(tmp_path / "store")


@pytest.fixture
def client(folder):
    settings = EpisodeStoreSettings(store_url=folder, commit_in_process=False)
    with (
        served({"store": create_app(settings)}) as urls,
        httpx.Client(base_url=urls["store"], timeout=60, trust_env=False) as opened,
    ):
        yield opened


def upload(client, take, **headers):
    path = f"/v1/recordings/{take['recording_id']}"
    numbers = np.arange(5, dtype=np.int64)
    batch = SampleBatch(numbers * 10**7, numbers * 10**7, numbers, np.zeros((5, 7)))
    octets = {"content-type": "application/octet-stream"}
    for answer in (
        client.post("/v1/recordings", json=take, headers=headers),
        # A repetition in another trace is of the same upload.
        client.post("/v1/recordings", json=take),
        client.post(
            f"{path}/streams/head/batches/0",
            content=encode_batch(STREAM, batch, number=0),
            headers=octets,
        ),
        client.post(f"{path}/finish", json={"num_batches": {"head": 1}}),
    ):
        assert answer.is_success, answer.text


def test_a_recording_keeps_the_trace_of_its_upload_unless_it_has_one(client):
    upload(client, TAKE, traceparent=PARENT)
    upload(client, TAKE | {"recording_id": "take-2", "trace_id": OTHER}, traceparent=PARENT)
    kept = client.get("/v1/recordings/take-1/attributes").json()
    assert kept["trace_id"] == TRACE_ID
    for trace_id, name in ((TRACE_ID, "take-1"), (OTHER, "take-2")):
        found = client.get("/v1/recordings", params={"trace_id": trace_id}).json()
        assert [one["recording_id"] for one in found["recordings"]] == [name]
    refused = client.post("/v1/recordings", json=TAKE | {"trace_id": "X" * 32})
    assert refused.status_code == 422


def test_an_episode_has_the_trace_of_its_recording_and_is_found_by_it(client, folder):
    store = EpisodeStore(folder)
    write_recording(store, "traced", trace_id=TRACE_ID)
    write_recording(store, "older", task="other")
    for name in ("traced", "older"):
        align_recording(store, name, AlignmentOptions())
    found = client.get("/v1/episodes", params={"trace_id": TRACE_ID}).json()["episodes"]
    (episode,) = [one["episode_id"] for one in found]
    attributes = client.get(f"/v1/episodes/{episode}").json()["attributes"]
    assert attributes["trace_id"] == TRACE_ID
    assert attributes["lineage"][0]["id"] == "traced"
    # The search field of the dashboard's list.
    for query in ({"text": TRACE_ID.upper()}, {"trace_id": TRACE_ID}):
        params = {"kind": "episode"} | query
        items = client.get("/v1/catalog/items", params=params).json()["items"]
        assert [one["id"] for one in items] == [episode]
    # What has no trace is written as before.
    assert "trace_id" not in client.get("/v1/recordings/older/attributes").json()
