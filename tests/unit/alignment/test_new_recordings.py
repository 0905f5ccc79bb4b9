"""Recordings that arrive are aligned by themselves: each once, and failures are listed."""

import asyncio
from contextlib import asynccontextmanager

import pytest
from httpx import ASGITransport, AsyncClient
from structlog.testing import capture_logs

from dextouch.episodes import EpisodeStore
from dextouch.errors import StorageFullError
from services.alignment import job_runner
from services.alignment.app import create_app
from services.alignment.job_queue import JobDatabase
from services.alignment.jobs import align_recording
from services.alignment.settings import AlignmentOptions, AlignmentSettings
from tests.unit.alignment.recordings import write_recording
from tests.unit.alignment.test_service import FakeWorker
from tests.unit.episodes.hostile_group import stamp_version

LOOK_PERIOD_S = 0.01
LIMIT_S = 120


@pytest.fixture
def worker(monkeypatch):
    kind = type("Worker", (FakeWorker,), {"held": asyncio.Event(), "started": []})
    kind.held.wait = lambda _: True
    run = kind.run
    kind.run = lambda self, name, *more: kind.started.append(name) or run(self, name, *more)
    monkeypatch.setattr(job_runner, "AlignmentWorker", kind)
    return kind


@pytest.fixture
def store(tmp_path):
    return EpisodeStore(tmp_path / "store")


@asynccontextmanager
async def served(store, **settings):
    """The service, as its client asks for all of its jobs."""
    settings = {"store_url": str(store.root), "look_period_s": LOOK_PERIOD_S} | settings
    app = create_app(AlignmentSettings(**settings))

    async def jobs(**query):
        answer = await client.get("/v1/alignments", params=query)
        return {job["recording_id"]: job for job in answer.json()["alignments"]}

    async with (
        app.router.lifespan_context(app),
        AsyncClient(transport=ASGITransport(app), base_url="http://localhost") as client,
    ):
        yield jobs


async def until(condition):
    """Until a condition of other tasks holds."""
    async with asyncio.timeout(LIMIT_S):
        while not await condition():  # noqa: ASYNC110 - of other tasks
            await asyncio.sleep(LOOK_PERIOD_S)


async def looked(store, jobs, name="last"):
    """Until the watcher has been through all that was in the store, and every job has ended."""
    write_recording(store, name)

    async def done():
        found = await jobs()
        return name in found and {job["state"] for job in found.values()} <= {"done", "failed"}

    await until(done)


@pytest.mark.long
async def test_recordings_that_arrive_become_episodes_once(store, worker):
    write_recording(store, "before")
    async with served(store) as jobs:
        write_recording(store, "while-it-runs")
        await looked(store, jobs)
        await looked_again(jobs)
        assert {job["state"] for job in (await jobs()).values()} == {"done"}
    async with served(store) as jobs:
        await looked_again(jobs)
    assert sorted(worker.started) == ["before", "last", "while-it-runs"]
    assert len(store.list()) == 3


async def looked_again(jobs):
    """Some more looks of the watcher."""
    for _ in range(5):
        await jobs()
        await asyncio.sleep(LOOK_PERIOD_S)


async def test_what_found_the_disk_full_is_tried_again(store, worker, monkeypatch):
    monkeypatch.setattr(job_runner, "RETRY_S", 0.5)
    run, is_full = worker.run, True

    def without_space(self, name, *more):
        if is_full:
            worker.started.append(name)
            raise StorageFullError("write episode: no space left")
        return run(self, name, *more)

    worker.run = without_space
    write_recording(store, "take")
    async with served(store) as jobs:

        async def failed_twice():
            return worker.started.count("take") > 1 and "take" in await jobs(state="failed")

        await until(failed_twice)
        (failed,) = (await jobs(state="failed")).values()
        assert (failed["problem"]["status"], failed["options"]) == (
            507,
            AlignmentOptions().model_dump(mode="json"),
        )
        is_full = False

        async def done():
            return "take" in await jobs(state="done")

        await until(done)
        assert len(await jobs()) == 1
    assert len(store.list()) == 1


async def test_what_cannot_be_aligned_is_listed_with_its_reason_and_not_tried_again(store, worker):
    write_recording(store, "handless", streams=("head",))
    async with served(store) as jobs:
        await looked(store, jobs)
        failed = await jobs(state="failed")
        assert list(failed) == ["handless"]
        assert "wrist_left" in failed["handless"]["problem"]["detail"]
        await looked_again(jobs)
        assert await jobs(state="failed") == failed
    async with served(store) as jobs:
        await looked_again(jobs)
        assert await jobs(state="failed") == failed
    assert worker.started == ["last"]


@pytest.mark.long
@pytest.mark.parametrize("deleted", [False, True])
async def test_a_recording_with_an_episode_is_left_alone_even_in_the_trash(store, worker, deleted):
    write_recording(store, "take")
    report = align_recording(store, "take", AlignmentOptions(model_rate_hz=30))
    if deleted:
        store.delete(report.episode_id)
    async with served(store) as jobs:
        await looked(store, jobs)
    assert worker.started == ["last"]


async def test_takes_of_a_calibration_are_left_alone(store, worker):
    write_recording(store, "rest", task="calibrate-glove")
    async with served(store) as jobs:
        await looked(store, jobs)
        assert list(await jobs()) == ["last"]


async def test_more_recordings_than_may_wait_are_all_aligned(store, worker):
    names = [f"take-{number}" for number in range(5)]
    for name in names:
        write_recording(store, name)
    async with served(store, num_workers=1, max_waiting=1) as jobs:

        async def done():
            return [n for n, job in (await jobs()).items() if job["state"] == "done"] == names

        await until(done)
    assert sorted(worker.started) == names


async def test_without_align_new_nothing_happens_unasked(store, worker):
    write_recording(store, "take")
    async with served(store, align_new=False) as jobs:
        await looked_again(jobs)
        assert await jobs() == {}


async def test_a_recording_that_cannot_be_read_keeps_no_other_from_being_aligned(
    store, worker, monkeypatch
):
    monkeypatch.setattr(job_runner, "RETRY_S", 0.0)
    write_recording(store, "old")
    stamp_version(store, "recording", "old", 1)
    with capture_logs() as logs:
        async with served(store) as jobs:
            await looked(store, jobs)
            await looked_again(jobs)
            assert list(await jobs()) == ["last"]
            (logged,) = [entry for entry in logs if entry.get("recording_id") == "old"]
            assert (logged["event"], logged["log_level"]) == ("alignment_failed", "warning")
            assert "format version 1, expected 2" in logged["reason"]
            stamp_version(store, "recording", "old", 2)

            async def asked():
                return "old" in await jobs()

            await until(asked)


async def test_the_watcher_goes_on_after_an_error_that_nobody_expected(store, worker, monkeypatch):
    listed, failures = EpisodeStore.list, [RuntimeError("broken")] * 3

    def list_later(*args, **kind):
        if failures:
            raise failures.pop()
        return listed(*args, **kind)

    monkeypatch.setattr(EpisodeStore, "list", list_later)
    with capture_logs() as logs:
        async with served(store) as jobs:
            await looked(store, jobs)
    assert not failures
    (logged,) = [entry for entry in logs if entry["event"] == "watcher_failed"]
    assert logged["exc_info"]


async def test_a_job_that_cannot_be_kept_is_asked_for_again(store, worker, monkeypatch):
    write_recording(store, "take")
    commit, failures = JobDatabase.commit, [StorageFullError("jobs: no space left")] * 3

    def commit_later(*args):
        if failures:
            raise failures.pop()
        return commit(*args)

    monkeypatch.setattr(JobDatabase, "commit", commit_later)
    async with served(store) as jobs:
        await looked(store, jobs)
        assert sorted(await jobs()) == ["last", "take"]


async def test_another_recording_under_the_id_of_a_deleted_one_is_aligned(store, worker):
    write_recording(store, "take")
    async with served(store) as jobs:
        await looked(store, jobs)
        store.delete("take", kind="recording")
        await looked(store, jobs, "without")
        write_recording(store, "take", seconds=3.0)

        async def aligned():
            return len([name for name in store.list() if name.startswith("take-")]) == 2

        await until(aligned)


async def test_a_recording_that_comes_back_is_not_aligned_again(store, worker):
    write_recording(store, "take")
    align_recording(store, "take", AlignmentOptions(model_rate_hz=30))
    async with served(store) as jobs:
        await looked(store, jobs)
        store.delete("take", kind="recording")
        await looked(store, jobs, "without")
        store.restore("take", kind="recording")
        await looked(store, jobs, "with")
        assert sorted(await jobs()) == ["last", "with", "without"]


@pytest.mark.parametrize(
    ("settings", "period_s"),
    [
        ({"store_url": "/data/store"}, 2.0),
        ({"store_url": "s3://takes/lab"}, 30.0),
        ({"store_url": "s3://takes/lab", "look_period_s": 5.0}, 5.0),
    ],
)
def test_a_bucket_is_listed_less_often(settings, period_s):
    assert AlignmentSettings(**settings).period_s == period_s
