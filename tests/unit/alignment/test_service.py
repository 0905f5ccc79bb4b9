"""Alignments over HTTP: started once, told, listed, cancelled, refused with a reason."""

import asyncio
import shutil
import sqlite3
import threading
from contextlib import AsyncExitStack, closing

import pytest
from httpx import ASGITransport, AsyncClient

from dextouch.episodes import EpisodeStore
from dextouch.errors import UnavailableError
from services.alignment import job_runner
from services.alignment.app import create_app
from services.alignment.jobs import align_recording
from services.alignment.settings import AlignmentSettings
from services.alignment.synchronization import Progress
from tests.unit.alignment.recordings import write_recording


class FakeWorker:
    """Aligns in its thread; the test can hold it back, or let it die."""

    held = threading.Event()
    dies = False

    def __init__(self, store_url, log_level="warning"):
        self._store = EpisodeStore(store_url)
        self._killed, self._talking = threading.Event(), threading.Lock()

    def start(self):
        pass

    def run(self, recording_id, options, tell):
        with self._talking:
            tell(Progress(0.25, "dating", "head"))
            while not type(self).held.wait(0.005) and not self._killed.is_set():
                pass
            if self._killed.is_set():
                raise UnavailableError("the process died")
            if type(self).dies:
                raise UnavailableError("the process that aligned it died (killed)")
            return align_recording(self._store, recording_id, options, tell)

    def stop(self):
        self._killed.set()
        with self._talking:
            self._killed.clear()


@pytest.fixture
def worker(monkeypatch):
    kind = type("Worker", (FakeWorker,), {"held": threading.Event()})
    kind.held.set()
    monkeypatch.setattr(job_runner, "AlignmentWorker", kind)
    return kind


@pytest.fixture
def store(tmp_path):
    store = EpisodeStore(tmp_path / "store")
    write_recording(store, "take")
    write_recording(store, "other")
    write_recording(store, "handless", streams=("head",))
    return store


@pytest.fixture
def serve(store, worker):
    """Opens the service as often as a test wants to."""

    class Service:
        def __init__(self, *, align_new=False, **settings):
            settings |= {"store_url": str(store.root), "align_new": align_new}
            self._app = create_app(AlignmentSettings(**settings))

        async def __aenter__(self):
            self._lifespan = self._app.router.lifespan_context(self._app)
            await self._lifespan.__aenter__()
            transport = ASGITransport(self._app, raise_app_exceptions=False)
            self.client = AsyncClient(transport=transport, base_url="http://localhost")
            return self.client

        async def __aexit__(self, *error):
            await self.client.aclose()
            await self._lifespan.__aexit__(None, None, None)

    return Service


async def poll(client, alignment_id, wanted):
    for _ in range(2000):
        job = (await client.get(f"/v1/alignments/{alignment_id}")).json()
        if wanted(job):
            return job
        await asyncio.sleep(0.005)
    raise AssertionError(job)


async def test_alignment_runs_once_and_is_told(serve, store):
    async with serve() as client:
        started = await client.post("/v1/alignments", json={"recording_id": "take"})
        assert started.status_code == 202
        done = await client.post("/v1/alignments?wait=true", json={"recording_id": "take"})
        assert (done.status_code, done.json()["state"]) == (200, "done")
        alignment_id = started.json()["alignment_id"]
        job = (await client.get(f"/v1/alignments/{alignment_id}")).json()
        assert job == done.json()
        assert (job["progress"], job["attempts"]) == (1.0, 1)
        assert job["submitted_at"] <= job["started_at"] <= job["ended_at"]
        assert store.list(kind="episode") == [alignment_id] == [job["report"]["episode_id"]]
        assert job["report"]["num_steps"] == store.open(alignment_id).num_steps
        assert (await client.get("/v1/alignments")).json()["num_matching"] == 1
        of_two = await client.get("/v1/alignments?recording_id=take&recording_id=other")
        assert of_two.json()["num_matching"] == 1
        of_other = await client.get("/v1/alignments?recording_id=other")
        assert of_other.json()["num_matching"] == 0


async def test_many_recordings_are_all_taken_or_none(serve, store):
    async with serve(num_workers=2) as client:
        body = {"recording_ids": ["take", "handless", "nothing"]}
        refused = await client.post("/v1/alignments", json=body)
        assert refused.status_code == 422
        assert set(refused.json()["details"]["refused"]) == {"handless", "nothing"}
        assert (await client.get("/v1/alignments")).json()["num_matching"] == 0
        body = {"recording_ids": ["nothing", "nobody"]}
        assert (await client.post("/v1/alignments", json=body)).status_code == 404
        body = {"recording_ids": ["take", "other", "take"]}
        done = await client.post("/v1/alignments?wait=true", json=body)
        assert done.status_code == 200
        assert [job["state"] for job in done.json()["alignments"]] == ["done", "done"]
    assert len(store.list(kind="episode")) == 2


async def test_other_options_are_another_episode(serve, store):
    async with serve() as client:
        for rate_hz in (15, 30):
            body = {"recording_id": "take", "options": {"model_rate_hz": rate_hz}}
            answer = await client.post("/v1/alignments?wait=true", json=body)
            assert answer.status_code == 200
            assert answer.json()["options"]["model_rate_hz"] == rate_hz
    assert len(store.list(kind="episode")) == 2


@pytest.mark.long
@pytest.mark.parametrize(
    ("body", "status", "word"),
    [
        ({"recording_id": "nothing"}, 404, "nothing"),
        ({"recording_id": "handless"}, 422, "wrist_left"),
        ({"recording_id": "../etc"}, 422, "recording_id"),
        ({"recording_id": "take", "options": {"max_gap_ms": -1}}, 422, "max_gap_ms"),
        ({"recording_id": "take", "extra": 1}, 422, "extra"),
        ({"recording_id": "take", "recording_ids": ["take"]}, 422, "exactly one"),
        ({}, 422, "exactly one"),
        ({"recording_ids": []}, 422, "recording_ids"),
        ({"recording_ids": [f"take-{n}" for n in range(1001)]}, 422, "1000"),
    ],
)
async def test_bad_requests_say_why(serve, body, status, word):
    async with serve() as client:
        answer = await client.post("/v1/alignments", json=body)
    assert answer.status_code == status
    assert answer.headers["content-type"] == "application/problem+json"
    assert word in answer.json()["detail"]


async def test_failure_during_the_work_is_kept_raised_and_may_be_tried_again(serve):
    body = {"recording_id": "take", "options": {"min_num_steps": 500}}
    async with serve() as client:
        answer = await client.post("/v1/alignments?wait=true", json=body)
        assert answer.status_code == 422
        assert "without a gap" in answer.json()["detail"]
        (job,) = (await client.get("/v1/alignments?state=failed")).json()["alignments"]
        assert "without a gap" in job["problem"]["detail"]
        again = await client.post("/v1/alignments", json=body)
        assert (again.status_code, again.json()["state"]) == (202, "waiting")


async def test_dead_worker_fails_its_job_alone(serve, worker):
    worker.dies = True
    async with serve() as client:
        answer = await client.post("/v1/alignments?wait=true", json={"recording_id": "take"})
        assert answer.status_code == 503
        assert "killed" in answer.json()["detail"]
        worker.dies = False
        other = await client.post("/v1/alignments?wait=true", json={"recording_id": "other"})
        assert other.json()["state"] == "done"


async def test_unknown_alignment_is_not_found(serve):
    async with serve() as client:
        assert (await client.get("/v1/alignments/nothing")).status_code == 404
        assert (await client.post("/v1/alignments/nothing/cancel")).status_code == 404
        assert (await client.get("/v1/alignments?after=nothing")).status_code == 404


async def test_progress_moves_and_what_runs_or_waits_can_be_cancelled(serve, store, worker):
    worker.held.clear()
    async with serve(num_workers=1) as client:
        body = {"recording_ids": ["take", "other"]}
        first, second = (await client.post("/v1/alignments", json=body)).json()["alignments"]
        path = f"/v1/alignments/{first['alignment_id']}"
        job = await poll(client, first["alignment_id"], lambda job: job["progress"] > 0)
        assert (job["state"], job["stage"], job["stream"]) == ("running", "dating", "head")
        assert job["eta_s"] >= 0
        second_path = f"/v1/alignments/{second['alignment_id']}"
        assert (await client.post(f"{second_path}/cancel")).json()["state"] == "cancelled"
        assert (await client.post(f"{path}/cancel")).json()["state"] == "cancelled"
        assert (await client.post(f"{path}/cancel")).status_code == 200
        worker.held.set()
        # The worker goes on with what comes next.
        done = await client.post("/v1/alignments?wait=true", json={"recording_id": "other"})
        assert done.json()["state"] == "done"
        assert (await client.get(path)).json()["state"] == "cancelled"
        conflict = await client.post(f"{second_path}/cancel")
        assert (conflict.status_code, "done" in conflict.json()["detail"]) == (409, True)
    assert store.list(kind="episode") == [second["alignment_id"]]


async def test_pages_and_states(serve, worker):
    worker.held.clear()
    async with serve(num_workers=1) as client:
        for number in range(5):
            body = {"recording_id": "take", "options": {"min_num_steps": 10 + number}}
            await client.post("/v1/alignments", json=body)
        everything = (await client.get("/v1/alignments")).json()
        ids = [job["alignment_id"] for job in everything["alignments"]]
        await poll(client, ids[0], lambda job: job["state"] == "running")
        seen, after = [], None
        while True:
            params = {"limit": 2} | ({"after": after} if after else {})
            page = (await client.get("/v1/alignments", params=params)).json()
            assert page["num_matching"] == 5
            seen += [job["alignment_id"] for job in page["alignments"]]
            after = page["next_after"]
            if after is None:
                break
        assert seen == ids
        waiting = (await client.get("/v1/alignments?state=waiting&limit=3")).json()
        assert [job["alignment_id"] for job in waiting["alignments"]] == ids[1:4]
        assert (waiting["num_matching"], waiting["next_after"]) == (4, ids[3])
        assert (await client.get("/v1/alignments?limit=0")).status_code == 422
        worker.held.set()


async def test_queue_is_bounded(serve, worker):
    worker.held.clear()
    async with serve(num_workers=1, max_waiting=1) as client:
        bodies = [{"recording_id": "take", "options": {"min_num_steps": n}} for n in (17, 18, 19)]
        answers = [await client.post("/v1/alignments", json=body) for body in bodies]
        assert [answer.status_code for answer in answers] == [202, 202, 429]
        assert "retry-after" in answers[2].headers
        worker.held.set()
        late = await client.post("/v1/alignments?wait=true", json=bodies[1])
        assert late.json()["state"] == "done"


async def test_jobs_outlive_the_service_and_go_on_by_themselves(serve, store, worker):
    worker.held.clear()
    async with serve(num_workers=1) as client:
        body = {"recording_ids": ["take", "other"]}
        jobs = (await client.post("/v1/alignments", json=body)).json()["alignments"]
        ids = [job["alignment_id"] for job in jobs]
        await poll(client, ids[0], lambda job: job["state"] == "running")
    assert store.list(kind="episode") == []
    worker.held.set()
    async with serve(num_workers=1) as client:
        for alignment_id in ids:
            job = await poll(client, alignment_id, lambda job: job["state"] == "done")
            # Being stopped in order is no failed attempt.
            assert job["attempts"] == 1
    async with serve() as client:
        assert (await client.get("/v1/alignments?state=done")).json()["num_matching"] == 2
    assert store.list(kind="episode") == sorted(ids)


async def test_a_worker_that_starts_while_the_service_stops_is_stopped(serve, worker):
    worker.held.clear()
    stopped, run, stop = threading.Event(), worker.run, worker.stop
    worker.run = lambda self, *order: stopped.wait() and run(self, *order)
    worker.stop = lambda self: stop(self) or stopped.set()
    async with serve(num_workers=1) as client:
        started = await client.post("/v1/alignments", json={"recording_id": "take"})
        await poll(client, started.json()["alignment_id"], lambda job: job["state"] == "running")


async def test_two_services_do_not_share_jobs(serve, monkeypatch):
    monkeypatch.setattr(job_runner, "RETRY_AFTER_S", 0.01)
    async with AsyncExitStack() as stack:
        first = await stack.enter_async_context(serve())
        async with serve() as second:
            refused = await second.post("/v1/alignments", json={"recording_id": "take"})
            assert refused.status_code == 503
            assert "another alignment service" in refused.json()["detail"]
            assert (await first.get("/v1/alignments")).json()["num_matching"] == 0
            await first.post("/v1/alignments?wait=true", json={"recording_id": "take"})
            ready = await second.get("/readyz")
            assert ready.status_code == 503
            assert "another alignment service" in ready.json()["waiting_for"][0]
            await stack.aclose()
            # The jobs of the first one, once it has released them.
            for _ in range(2000):
                if (listed := await second.get("/v1/alignments")).status_code == 200:
                    break
                await asyncio.sleep(0.005)
            assert [job["state"] for job in listed.json()["alignments"]] == ["done"]


def of_another_program(path):
    path.unlink()
    with closing(sqlite3.connect(path)) as database:
        database.execute("PRAGMA journal_mode = WAL")
        database.execute("CREATE TABLE jobs (position, crc32c, job)")
        database.execute("INSERT INTO jobs VALUES (1, 2, NULL)")
        database.execute("PRAGMA user_version = 1")
        database.commit()


DAMAGES = {
    "garbage": lambda path: path.write_bytes(b"no database" * 1000),
    "cut": lambda path: path.write_bytes(path.read_bytes()[:5000]),
    "cut to a part of its header": lambda path: path.write_bytes(path.read_bytes()[:50]),
    "emptied beside its log": lambda path: (
        path.write_bytes(b""),
        path.with_name("jobs.sqlite3-wal").write_bytes(b"log"),
    ),
    "of a later version": lambda path: path.write_bytes(
        path.read_bytes()[:60] + (9).to_bytes(4, "big") + path.read_bytes()[64:]
    ),
    "of another program": of_another_program,
    "a folder": lambda path: (path.unlink(), path.mkdir()),
}


@pytest.mark.long
@pytest.mark.parametrize("damage", DAMAGES.values(), ids=DAMAGES)
async def test_damaged_jobs_are_told_left_alone_and_tried_again(
    serve, store, damage, monkeypatch, capsys
):
    monkeypatch.setattr(job_runner, "RETRY_AFTER_S", 0.01)
    async with serve() as client:
        await client.post("/v1/alignments?wait=true", json={"recording_id": "take"})
    path = store.root / ".alignments/jobs.sqlite3"
    damage(path)
    before = path.read_bytes() if path.is_file() else None
    async with serve(align_new=True) as client:
        ready = await client.get("/readyz")
        assert ready.status_code == 503
        told = ready.json()["waiting_for"][0]
        assert str(path) in told
        assert "move the file away" in told or path.is_dir()
        for refused in (
            await client.post("/v1/alignments", json={"recording_id": "take"}),
            await client.get("/v1/alignments"),
            await client.get("/v1/alignments/take-0"),
        ):
            assert refused.status_code == 503
            assert str(path) in refused.json()["detail"]
        assert (await client.get("/healthz")).status_code == 200
        assert (path.read_bytes() if path.is_file() else None) == before
        for file in path.parent.glob("jobs.sqlite3*"):
            file.rename(store.root / file.name)
        for _ in range(2000):
            if (listed := await client.get("/v1/alignments")).status_code == 200:
                break
            await asyncio.sleep(0.005)
        assert listed.status_code == 200
        assert (await client.get("/readyz")).json()["ready"]


async def test_ready_once_a_worker_is(serve):
    async with serve() as client:
        for _ in range(1000):
            answer = await client.get("/readyz")
            if answer.status_code == 200:
                break
            assert answer.json()["waiting_for"] == ["solver"]
            await asyncio.sleep(0.005)
        assert answer.json()["ready"]


@pytest.mark.parametrize("gone", ["store", "jobs"])
async def test_a_folder_that_is_gone_is_told_and_not_created_anew(serve, store, tmp_path, gone):
    folder = {"store": store.root, "jobs": tmp_path / "jobs"}[gone]
    async with serve(jobs_folder=str(tmp_path / "jobs")) as client:
        assert (await client.get("/v1/alignments")).status_code == 200
        shutil.rmtree(folder)
        for answer in (
            await client.get("/v1/alignments"),
            await client.post("/v1/alignments", json={"recording_id": "take"}),
        ):
            assert answer.status_code == 503
            assert f"{folder}: is gone" in answer.json()["detail"]
        ready = (await client.get("/readyz")).json()
        assert f"{folder}: is gone" in ready["waiting_for"][0]
    assert not folder.exists()
