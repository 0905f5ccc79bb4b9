"""Too much at once, a full disk, a station above its quota: told before anything is read."""

import asyncio
import os
import threading

import pytest
from httpx import ASGITransport, AsyncClient
from prometheus_client import generate_latest

from dextouch.episodes import EpisodeStore
from dextouch.errors import LimitExceededError, StorageFullError, UnavailableError
from dextouch.schemas import BatchReceipt, FinishRecording, Problem
from dextouch.streams import encode_batch
from services.episode_store import ingest as ingest_module
from services.episode_store import intake as intake_module
from services.episode_store.app import create_app
from services.episode_store.ingest import Ingest, KeyedLocks
from services.episode_store.intake import CREATE_BYTES, Admission, StorageLimits

PATH = "/v1/recordings/take-1/streams/glove_left/batches/0"


@pytest.fixture
def glove_data(attributes, batch_of):
    return encode_batch(attributes.streams[0], batch_of(0, 20), number=0)


def post(app, path, num_bytes, receive):
    """A request to be awaited: (status, headers, body)."""
    scope = {
        "type": "http",
        "asgi": {"version": "3.0"},
        "http_version": "1.1",
        "method": "POST",
        "scheme": "http",
        "path": path,
        "raw_path": path.encode(),
        "query_string": b"",
        "headers": [
            (b"host", b"localhost"),
            (b"content-type", b"application/octet-stream"),
            (b"content-length", str(num_bytes).encode()),
        ],
        "client": ("127.0.0.1", 1),
        "server": ("store", 80),
        "state": {},
    }
    sent = []

    async def send(message):
        sent.append(message)

    async def answer():
        await app(scope, receive, send)
        headers = {key.decode(): value.decode() for key, value in sent[0]["headers"]}
        return sent[0]["status"], headers, sent[1]["body"]

    return answer()


async def unread():
    """A body that nobody may ask for."""
    raise AssertionError("the body was read")


def test_admission_bounds_requests_and_bytes():
    admission = Admission(max_requests=2, max_bytes=100)
    with admission.admitted(90):
        with pytest.raises(LimitExceededError, match="busy") as caught, admission.admitted(20):
            pass
        assert caught.value.details["retry_after_s"] == 1
        full = pytest.raises(LimitExceededError)
        with admission.admitted(10), full, admission.admitted(0):
            pass
    # One batch alone always fits, and everything was given back.
    with admission.admitted(1000):
        pass
    with admission.admitted(60), admission.admitted(40):
        pass


def test_the_reserve_stays_free_but_for_finishing(tmp_path, settings, monkeypatch, attributes):
    folder = tmp_path / "not" / "there" / ".uploads"
    changed = settings.model_copy(update={"min_free_bytes": 1000})
    limits = StorageLimits(folder, changed, recordings=dict)
    assert limits.free_bytes() > 0
    monkeypatch.setattr(intake_module, "free_bytes_of", lambda _: 1500)
    limits.check_batch("take-1", 500)
    with pytest.raises(StorageFullError, match="bytes exceed the") as caught:
        limits.check_batch("take-1", 501)
    assert caught.value.details["retry_after_s"] > 1
    limits.begin(attributes)
    limits.add("take-1", 1500)
    limits.check_finish("take-1")
    limits.add("take-1", 1)
    with pytest.raises(StorageFullError):
        limits.check_finish("take-1")


@pytest.mark.parametrize("bound", [{"max_batches_in_flight": 1}, {"max_bytes_in_flight": 1024}])
async def test_a_busy_store_answers_before_it_reads(settings, attributes, glove_data, bound):
    app = create_app(settings.model_copy(update=bound))
    async with AsyncClient(transport=ASGITransport(app), base_url="http://localhost") as http:
        created = await http.post("/v1/recordings", json=attributes.model_dump(mode="json"))
        assert created.status_code == 201
    asked, arrived = asyncio.Event(), asyncio.Event()

    async def slow():
        asked.set()
        await arrived.wait()
        return {"type": "http.request", "body": glove_data, "more_body": False}

    first = asyncio.create_task(post(app, PATH, len(glove_data), slow))
    await asked.wait()
    status, headers, body = await post(app, PATH, 500, unread)
    assert (status, headers["retry-after"]) == (429, "1")
    assert headers["content-type"] == "application/problem+json"
    assert Problem.model_validate_json(body).details["retry_after_s"] == 1
    assert b'dextouch_store_refused_total{reason="busy"} 1.0' in generate_latest(app.state.registry)
    arrived.set()
    assert (await first)[0] == 200

    async def quick():
        return {"type": "http.request", "body": glove_data, "more_body": False}

    status, _, body = await post(app, PATH, len(glove_data), quick)
    assert (status, BatchReceipt.model_validate_json(body).replayed) == (200, True)


@pytest.fixture
def disk(monkeypatch):
    """A disk whose free bytes a test chooses."""
    free = {"bytes": 10**9}
    monkeypatch.setattr(intake_module, "free_bytes_of", lambda _: free["bytes"])
    return free


def test_a_full_disk_refuses_uploads_and_reads_go_on(start, attributes, batch_of, disk):
    client = start(min_free_bytes=10**6)
    client.create(attributes)
    glove = attributes.streams[0]
    client.send_batch("take-1", glove, batch_of(0, 20), number=0)
    disk["bytes"] = 10**6 + 100
    with pytest.raises(StorageFullError, match="free space") as caught:
        client.send_batch("take-1", glove, batch_of(20, 20), number=1)
    assert caught.value.details["retry_after_s"] == 30
    new = PATH.removesuffix("0") + "1"
    status, headers, _ = asyncio.run(post(client._http._transport.app, new, 500, unread))
    assert (status, headers["retry-after"]) == (507, "30")
    with pytest.raises(StorageFullError):
        client.create(attributes.model_copy(update={"recording_id": "take-2"}))
    # What is here can be finished and read, and more can come when there is room again.
    assert client.status("take-1").next_batch["glove_left"] == 1
    client.finish("take-1", {"glove_left": 1, "wrist_left": 0})
    assert len(client.recording_samples("take-1", "glove_left")) == 20
    disk["bytes"] = 10**9
    assert client.create(attributes.model_copy(update={"recording_id": "take-2"})).state == "open"


def test_a_finish_that_cannot_fit_is_refused_before_it_begins(
    start, attributes, batch_of, disk, settings
):
    client = start(min_free_bytes=0)
    client.create(attributes)
    client.send_batch("take-1", attributes.streams[0], batch_of(0, 20), number=0)
    disk["bytes"] = 100
    counts = {"glove_left": 1, "wrist_left": 0}
    with pytest.raises(StorageFullError, match="finish"):
        client.finish("take-1", counts)
    assert EpisodeStore(settings.store_url).list(kind="recording") == []
    disk["bytes"] = 10**9
    assert client.finish("take-1", counts).state == "finished"


def test_a_station_keeps_to_its_quota(start, attributes, batch_of, settings):
    quota = 200_000
    client = start(quota_bytes_per_station=quota)
    client.create(attributes)

    def send(name, number):
        batch = batch_of(60 * number, 60)
        return client.send_batch(name, attributes.streams[0], batch, number=number)

    # A batch has some 45 kB: four of them fit.
    for number in range(4):
        assert send("take-1", number).num_samples == 60
    with pytest.raises(StorageFullError, match="station 'bench'") as caught:
        send("take-1", 4)
    assert caught.value.details["reason"] == "quota"
    assert caught.value.details["expected"] == quota
    # Another station is not concerned, and a service that starts now counts the same.
    client.create(attributes.model_copy(update={"recording_id": "take-2", "station": "other"}))
    send("take-2", 0)
    store = EpisodeStore(settings.store_url)
    folder = store.root / ".uploads"
    changed = settings.model_copy(update={"quota_bytes_per_station": quota})
    limits = StorageLimits(folder, changed, recordings=dict)
    with pytest.raises(StorageFullError):
        limits.check_batch("take-1", 45_000)
    limits.check_batch("take-2", 45_000)
    # Finished recordings count, too, until they are deleted.
    client.finish("take-1", {"glove_left": 4, "wrist_left": 0})
    used = client.recordings(station="bench").recordings[0].num_bytes
    third = attributes.model_copy(update={"recording_id": "take-3"})
    bound = used + CREATE_BYTES - 1
    with pytest.raises(StorageFullError):
        start(quota_bytes_per_station=bound).create(third)
    store.delete("take-1", kind="recording")
    assert start(quota_bytes_per_station=bound).create(third).state == "open"


def test_stale_uploads_go_only_when_told_to(start, attributes, batch_of, settings):
    client = start()
    for name in ("take-1", "take-2"):
        client.create(attributes.model_copy(update={"recording_id": name}))
    client.send_batch("take-1", attributes.streams[0], batch_of(0, 20), number=0)
    listed = client.uploads().uploads
    assert [upload.recording_id for upload in listed] == ["take-1", "take-2"]
    assert listed[0].num_bytes > listed[1].num_bytes > 0
    assert listed[0].station == "bench"
    assert client.uploads(idle_s=3600.0).uploads == ()
    assert client.expire_uploads(idle_s=3600.0).uploads == ()
    client.finish("take-1", {"glove_left": 1, "wrist_left": 0})
    folder = EpisodeStore(settings.store_url).root / ".uploads" / "take-2"
    for path in (*folder.iterdir(), folder):
        os.utime(path, (0, 0))
    gone = client.expire_uploads(idle_s=600.0).uploads
    assert [upload.recording_id for upload in gone] == ["take-2"]
    assert client.uploads().uploads == ()
    store = EpisodeStore(settings.store_url)
    assert store.list(kind="recording") == ["take-1"]
    assert not (store.root / ".uploads" / "take-2").exists()
    # The station begins anew.
    assert client.create(attributes.model_copy(update={"recording_id": "take-2"})).state == "open"


def test_metrics_tell_what_came(attributes, start, batch_of):
    client = start()
    client.create(attributes)
    for _ in range(2):
        client.send_batch("take-1", attributes.streams[0], batch_of(0, 20), number=0)
    text = client._http.get("/metrics").text
    assert 'dextouch_store_batches_total{replayed="false"} 1.0' in text
    assert 'dextouch_store_batches_total{replayed="true"} 1.0' in text
    assert "dextouch_store_open_uploads 1.0" in text
    assert "dextouch_store_ack_seconds_count 2.0" in text
    lines = dict(line.rsplit(" ", 1) for line in text.splitlines() if line[0] != "#")
    assert float(lines["dextouch_store_batch_bytes_total"]) > 20 * 720
    assert float(lines["dextouch_store_free_bytes"]) > 0


def test_recordings_never_wait_for_each_other():
    locks = KeyedLocks(patience_s=0.05)
    names = [f"take-{number}" for number in range(300)]
    held = [locks.holding(name) for name in names]
    for lock in held:
        lock.__enter__()
    late = pytest.raises(UnavailableError, match="try again later")
    with late as caught, locks.holding("take-7"):
        pass
    assert caught.value.details["retry_after_s"] == 1
    assert locks.is_wanted("take-7")
    for lock in held:
        lock.__exit__(None, None, None)
    assert not locks.is_wanted("take-7")
    assert locks._locks == {}


def test_a_recording_that_is_being_finished_says_come_again(
    settings, attributes, batch_of, monkeypatch
):
    monkeypatch.setattr(ingest_module, "PATIENCE_S", 0.05)
    began, go_on = threading.Event(), threading.Event()

    def slow_commit(spool, attributes, announced):
        began.set()
        assert go_on.wait(30)
        return {}

    ours = Ingest(EpisodeStore(settings.store_url), settings, commit=slow_commit)
    for name in ("take-1", "take-2"):
        ours.create(attributes.model_copy(update={"recording_id": name}))
    data = [encode_batch(attributes.streams[0], batch_of(5 * n, 5), number=n) for n in range(2)]
    ours.put_batch("take-1", "glove_left", 0, data[0])
    body = FinishRecording(num_batches={"glove_left": 1, "wrist_left": 0})
    thread = threading.Thread(target=ours.finish, args=("take-1", body))
    thread.start()
    try:
        assert began.wait(30)
        with pytest.raises(UnavailableError, match="take-1"):
            ours.put_batch("take-1", "glove_left", 1, data[1])
        # Another station's batches go on meanwhile.
        assert ours.put_batch("take-2", "glove_left", 0, data[0]).num_samples == 5
    finally:
        go_on.set()
        thread.join()
        ours.close()
