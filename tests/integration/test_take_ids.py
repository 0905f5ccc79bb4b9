"""Two stations choose the same id for a take, and a store refuses a take for good."""

import asyncio
from contextlib import asynccontextmanager

import httpx
import numpy as np
import pytest

from dextouch.clients import EpisodeStoreClient
from dextouch.episodes.spool import SpoolReader
from dextouch.errors import InvalidInputError
from dextouch.schemas import TakePrompt
from services.acquisition.app import create_app as create_station
from services.acquisition.clock import VirtualClock
from services.acquisition.mock_station import MockStation
from services.acquisition.mocks import pattern
from services.acquisition.mocks.faults import FaultScript
from services.acquisition.settings import AcquisitionSettings
from services.acquisition.uploader import Uploader
from services.episode_store.app import create_app as create_store
from services.episode_store.settings import EpisodeStoreSettings
from tests.integration.recording_streams import human_streams
from tests.unit.worlds.running import served

STREAMS = [s for s in human_streams(0.7) if s.descriptor.name in {"head", "wrist_left"}]
PROMPT = TakePrompt(task="stack_bowls", instruction="stack the bowls", operator="p1", consent=True)


class CountingTransport(httpx.HTTPTransport):
    """Notes every request; from the one numbered `dies_at` on, connections are lost."""

    def __init__(self):
        super().__init__()
        self.asked = []
        self.dies_at = None

    def handle_request(self, request):
        self.asked.append(request.url.path)
        if self.dies_at is not None and len(self.asked) > self.dies_at:
            raise httpx.ConnectError("connection lost", request=request)
        return super().handle_request(request)


@pytest.fixture
def transport():
    return CountingTransport()


@pytest.fixture
def store(tmp_path, transport):
    """A real store over HTTP."""
    settings = EpisodeStoreSettings(
        store_url=str(tmp_path / "store"), sync_uploads=False, commit_in_process=False
    )
    with (
        served(create_store(settings)) as url,
        EpisodeStoreClient(url, transport=transport) as client,
    ):
        yield client


def record(root, name, recording_id="same-1"):
    with MockStation(
        STREAMS, FaultScript(), 1, VirtualClock(), spool_root=root / name, name=name
    ) as station:
        station.run_take(PROMPT, recording_id=recording_id)
    return root / name


def stored_take(store, recording_id):
    return {
        name: store.recording_samples(recording_id, name).values for name in ("head", "wrist_left")
    }


def test_the_same_id_on_two_stations_is_two_recordings(tmp_path, store):
    spools = [record(tmp_path, name) for name in ("desk_1", "desk_2")]
    uploaders = [Uploader(spool, store, period_s=1.0) for spool in spools]
    for uploader in uploaders:
        assert uploader.upload_all() == ["same-1"]
    listed = {r.station: r.recording_id for r in store.recordings().recordings}
    assert set(listed) == {"desk_1", "desk_2"}
    assert listed["desk_1"] == "same-1"
    assert listed["desk_2"].startswith("same-1-")
    for uploader, spool, (name, recording_id) in zip(
        uploaders, spools, sorted(listed.items()), strict=True
    ):
        (status,) = uploader.status()
        assert (status.recording_id, status.uploaded) == ("same-1", True), name
        assert (status.stored_as, status.error) == (recording_id, None)
        for stream, values in stored_take(store, recording_id).items():
            np.testing.assert_array_equal(values, SpoolReader(spool / "same-1").read(stream).values)


def test_an_interrupted_upload_goes_on_under_its_second_id(tmp_path, store, transport):
    first, second = (record(tmp_path, name) for name in ("desk_1", "desk_2"))
    Uploader(first, store, period_s=1.0).upload_all()
    for num_requests in range(1, 12):
        # Each time another process of the station, that gets one request further.
        transport.asked.clear()
        transport.dies_at = num_requests
        if Uploader(second, store, period_s=1.0).upload_all():
            break
    transport.dies_at = None
    assert num_requests > 3
    (other,) = [r for r in store.recordings().recordings if r.station == "desk_2"]
    assert store.recordings().num_matching == 2
    assert store.uploads().uploads == ()
    for stream, values in stored_take(store, other.recording_id).items():
        np.testing.assert_array_equal(values, SpoolReader(second / "same-1").read(stream).values)


class RefusingStore(EpisodeStoreClient):
    """A store that takes nothing and counts how often it was asked."""

    def __init__(self):
        self.num_asked = 0
        self.error = InvalidInputError("attributes: task: not in this store's list")

    def close(self):
        pass

    def create(self, attributes):
        self.num_asked += 1
        raise self.error

    def send_batch(self, recording_id, descriptor, batch, *, number):
        raise NotImplementedError

    def finish(self, recording_id, num_batches, *, success=None, ledger=(), content=None):
        raise NotImplementedError


@asynccontextmanager
async def station_of(spool, uploader):
    app = create_station(AcquisitionSettings(spool=spool, mock=True), uploader)
    async with app.router.lifespan_context(app):
        transport = httpx.ASGITransport(app)
        async with httpx.AsyncClient(transport=transport, base_url="http://127.0.0.1") as client:
            yield client


async def until(ask):
    async with asyncio.timeout(60):
        while True:
            if answer := await ask():
                return answer
            await asyncio.sleep(0.02)


async def test_a_take_that_is_refused_for_good_is_set_aside(tmp_path, monkeypatch):
    streams = [s for s in pattern.pattern_streams() if s.descriptor.name == "head"]
    monkeypatch.setattr(pattern, "pattern_streams", lambda **_: streams)
    spool = record(tmp_path, "desk_1")
    refusing = RefusingStore()
    uploader = Uploader(spool, refusing, period_s=0.001)
    looks = []
    upload_all = uploader.upload_all
    monkeypatch.setattr(uploader, "upload_all", lambda: looks.append(1) or upload_all())
    async with station_of(spool, uploader) as client:

        async def many_looks():
            return len(looks) > 50

        async def finding():
            health = (await client.get("/v1/health")).json()
            return [f for f in health["findings"] if f["code"] == "upload_refused"]

        await until(many_looks)
        # It was offered again in case the refusal was a passing one, and then no more.
        assert refusing.num_asked == 3
        (status,) = (await client.get("/v1/uploads")).json()
        assert (status["uploaded"], status["refused"]) == (False, True)
        assert "not in this store's list" in status["error"]
        (found,) = await until(finding)
        assert found["level"] == "WARN"
        assert "same-1" in found["message"]
        assert "not in this store's list" in found["message"]
        assert "send the take again" in found["advice"]
        listed = (await client.get("/v1/uploads?refused=true")).json()
        assert [take["recording_id"] for take in listed] == ["same-1"]

        missing = await client.post("/v1/uploads/another/retry")
        assert missing.status_code == 404
        retried = await client.post("/v1/uploads/same-1/retry")
        assert retried.json()["refused"] is False
        looks.clear()
        await until(many_looks)
        assert refusing.num_asked == 6
    assert SpoolReader(spool / "same-1").num_samples("head") > 0


def test_a_refused_take_stays_set_aside_until_it_is_asked_for(tmp_path, store):
    spool = record(tmp_path, "desk_1")
    refusing = RefusingStore()
    for _ in range(5):
        Uploader(spool, refusing, period_s=1.0).upload_all()
    uploader = Uploader(spool, refusing, period_s=1.0)
    for _ in range(5):
        uploader.upload_all()
    # Refusals are counted by process, so that a restart offers a take again unless it is set aside.
    assert refusing.num_asked == 8
    later = Uploader(spool, store, period_s=1.0)
    assert later.upload_all() == []
    assert list(later.refused) == ["same-1"]
    later.retry("same-1")
    assert later.upload_all() == ["same-1"]
    assert later.refused == {}
    assert store.recordings().num_matching == 1
