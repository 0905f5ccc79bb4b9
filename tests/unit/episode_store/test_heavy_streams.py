"""Uploads of streams with large samples: what they cost is bounded by what was sent."""

import tracemalloc

import numpy as np
import pytest
from httpx import ASGITransport, AsyncClient

from dextouch.streams import SampleBatch, StreamDescriptor
from services.episode_store.app import create_app

HEAVY = StreamDescriptor(
    name="spectrum",
    kind="scalar",
    shape=(50_000,),
    dtype="float64",
    unit="counts",
    nominal_rate_hz=10_000,
)
# A few copies of the 400 kB that were sent; it took 6 GB.
MEMORY_BYTES = 32 << 20


@pytest.fixture
def http(settings):
    return AsyncClient(transport=ASGITransport(create_app(settings)), base_url="http://localhost")


def test_finishing_and_reading_a_small_upload_takes_little_memory(start, attributes):
    client = start()
    stamps = np.array([5])
    values = np.arange(50_000, dtype=np.float64)[None]
    client.create(attributes.model_copy(update={"streams": (HEAVY,)}))
    tracemalloc.start()
    try:
        batch = SampleBatch(stamps, stamps, stamps, values)
        client.send_batch("take-1", HEAVY, batch, number=0)
        client.finish("take-1", {"spectrum": 1})
        samples = client.recording_samples("take-1", "spectrum")
        assert tracemalloc.get_traced_memory()[1] < MEMORY_BYTES
    finally:
        tracemalloc.stop()
    np.testing.assert_array_equal(samples.values, values)


def test_finishing_takes_the_memory_of_a_batch_and_not_of_the_take(start, attributes):
    client = start()
    client.create(attributes.model_copy(update={"streams": (HEAVY,)}))
    for number in range(8):
        stamps = np.arange(20 * number, 20 * number + 20)
        values = np.broadcast_to(stamps[:, None].astype("f8"), (20, 50_000))
        batch = SampleBatch(stamps, stamps, stamps, values)
        client.send_batch("take-1", HEAVY, batch, number=number)
    tracemalloc.start()
    try:
        client.finish("take-1", {"spectrum": 8})
        # Of a batch of 8 MB a few copies.
        assert tracemalloc.get_traced_memory()[1] < 48 << 20
    finally:
        tracemalloc.stop()
    samples = client.recording_samples("take-1", "spectrum", start_ns=30, stop_ns=50)
    assert samples.values[:, 77].tolist() == list(range(30, 50))


@pytest.mark.parametrize(
    ("changed", "says"),
    [
        ({"shape": [2**40]}, "spectrum: a sample of shape (1099511627776,) takes 8796093022208"),
        ({"shape": [0, 2**62, 320]}, "greater than or equal to 1"),
        ({"shape": [1] * 100}, "at most 7 items"),
        ({"nominal_rate_hz": 1e-300}, "greater than or equal to 0.000001"),
    ],
)
async def test_recordings_of_absurd_streams_are_refused(http, attributes, changed, says):
    body = attributes.model_dump(mode="json")
    body["streams"] = [HEAVY.model_dump(mode="json") | changed]
    response = await http.post("/v1/recordings", json=body)
    assert response.status_code == 422
    assert says in response.json()["detail"]


async def test_a_recording_has_at_most_100_streams(http, attributes):
    body = attributes.model_dump(mode="json")
    streams = [HEAVY.model_dump(mode="json") | {"name": f"s{n}"} for n in range(101)]
    response = await http.post("/v1/recordings", json=body | {"streams": streams})
    assert response.status_code == 422
    assert "at most 100 streams" in response.json()["detail"]
    response = await http.post("/v1/recordings", json=body | {"streams": streams[:100]})
    assert response.status_code == 201
