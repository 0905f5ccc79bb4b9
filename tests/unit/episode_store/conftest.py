"""A store service in this process, a take to upload, and a client without a socket."""

import asyncio
import resource
from contextlib import contextmanager

import httpx
import numpy as np
import pytest

from dextouch.clients import EpisodeStoreClient
from dextouch.schemas import RecordingAttributes
from dextouch.streams import SampleBatch, StreamDescriptor
from services.episode_store.app import create_app
from services.episode_store.settings import EpisodeStoreSettings

GLOVE = StreamDescriptor(
    name="glove_left",
    kind="tactile",
    shape=(360,),
    dtype="uint16",
    unit="counts",
    nominal_rate_hz=60,
)
WRIST = StreamDescriptor(
    name="wrist_left",
    kind="pose",
    shape=(7,),
    dtype="float64",
    unit="pose_m_wxyz",
    nominal_rate_hz=100,
)


class InProcess(httpx.BaseTransport):
    """Hands requests of a synchronous client to an application."""

    def __init__(self, app):
        self.app = app

    def handle_request(self, request):
        async def answer():
            transport = httpx.ASGITransport(app=self.app, raise_app_exceptions=False)
            async with httpx.AsyncClient(transport=transport) as client:
                return await client.send(
                    httpx.Request(
                        request.method, request.url, headers=request.headers, content=request.read()
                    )
                )

        response = asyncio.run(answer())
        return httpx.Response(
            response.status_code, headers=response.headers, content=response.content
        )


def glove_batch(first, count):
    numbers = np.arange(first, first + count, dtype=np.int64)
    values = (numbers[:, None] + np.arange(360)).astype("<u2")
    return SampleBatch(numbers * 16_666_667, numbers * 1000, numbers, values)


@pytest.fixture
def attributes():
    return RecordingAttributes(
        recording_id="take-1",
        task="stand_bottle",
        instruction="stand it up",
        domain="human",
        station="bench",
        streams=(GLOVE, WRIST),
    )


@pytest.fixture
def settings(tmp_path):
    return EpisodeStoreSettings(
        store_url=str(tmp_path / "store"), sync_uploads=False, commit_in_process=False
    )


@pytest.fixture
def start(settings):
    """Start a service over the same folder, as after a crash of the one before."""
    clients = []

    def starter(**changes):
        app = create_app(settings.model_copy(update=changes))
        client = EpisodeStoreClient("http://localhost", transport=InProcess(app))
        clients.append(client)
        return client

    yield starter
    for client in clients:
        client.close()


@pytest.fixture
def batch_of():
    return glove_batch


@pytest.fixture
def file_size_limit():
    """The kernel refuses to let any file grow beyond a size: a full disk in small."""

    @contextmanager
    def limit(num_bytes):
        soft, hard = resource.getrlimit(resource.RLIMIT_FSIZE)
        resource.setrlimit(resource.RLIMIT_FSIZE, (num_bytes, hard))
        try:
            yield
        finally:
            resource.setrlimit(resource.RLIMIT_FSIZE, (soft, hard))

    return limit
