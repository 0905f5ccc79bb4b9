"""The job queue on disk: what was saved is loaded again, and damage is refused."""

import os
import signal
import sqlite3
import subprocess
import sys

import pytest

from dextouch.errors import ConflictError, CorruptDataError, StorageFullError, UnavailableError
from services.alignment.job_queue import DATABASE_FILE, JobDatabase, JobQueue
from services.alignment.schemas import AlignmentJob
from services.alignment.settings import AlignmentOptions
from services.alignment.synchronization import Progress


def new_job(name):
    return AlignmentJob.new(f"{name}-episode", name, AlignmentOptions())


@pytest.fixture
def folder(tmp_path):
    return tmp_path / "jobs"


def load(folder):
    database = JobDatabase(folder)
    try:
        return database.load()
    finally:
        database.close()


@pytest.fixture
async def opened(folder):
    """Opens queues; each closes the one before, as a restart does."""
    queues = []

    async def open_queue(**limits):
        for queue in queues:
            queue.close()
        queue = JobQueue(**{"max_open": 100, "max_kept": 100} | limits)
        queues.append(queue)
        await queue.open(folder)
        return queue

    yield open_queue
    for queue in queues:
        queue.close()


def ids(queue):
    page = queue.page(state=None, after=None, limit=1000)
    return [job.recording_id for job in page.alignments]


async def test_last_state_of_a_job_is_loaded(opened):
    queue = await opened()
    await queue.add([new_job("a"), new_job("b")])
    started = queue.next().started()
    await queue.save(started)
    queue.set_progress(started, Progress(0.5, "dating", "head"))
    queue = await opened()
    assert ids(queue) == ["a", "b"]
    assert queue.get("a-episode") == started
    assert queue.get("b-episode").state == "waiting"


async def test_jobs_of_some_recordings_are_listed(opened):
    queue = await opened()
    await queue.add([new_job(name) for name in "abc"])
    page = queue.page(state=None, recording_ids=("c", "a", "x"), after=None, limit=1)
    assert ([job.recording_id for job in page.alignments], page.num_matching) == (["a"], 2)
    rest = queue.page(state="waiting", recording_ids=("c", "a"), after=page.next_after, limit=9)
    assert [job.recording_id for job in rest.alignments] == ["c"]


async def test_job_submitted_again_goes_to_the_end(opened):
    queue = await opened()
    await queue.add([new_job("a"), new_job("b")])
    await queue.save(queue.get("a-episode").ended("cancelled"))
    await queue.add([new_job("a"), new_job("b")])
    assert ids(queue) == ["b", "a"]
    assert ids(await opened()) == ["b", "a"]


async def test_oldest_ended_jobs_are_forgotten(opened):
    queue = await opened(max_kept=3)
    for name in "abcd":
        await queue.add([new_job(name)])
        if name != "a":
            await queue.save(queue.get(f"{name}-episode").ended("cancelled"))
    assert ids(queue) == ["a", "c", "d"]
    assert ids(await opened()) == ["a", "c", "d"]


async def test_full_disk_changes_nothing_but_facts(opened):
    queue = await opened()
    await queue.add([new_job("a")])
    queue._database._connection.execute("PRAGMA max_page_count = 1")
    large = new_job("x" * 100_000)
    with pytest.raises(StorageFullError, match="no space left"):
        await queue.add([large])
    assert ids(queue) == ["a"]
    done = queue.get("a-episode").ended("failed", error=UnavailableError("x" * 100_000))
    with pytest.raises(StorageFullError):
        await queue.save(done)
    assert queue.get("a-episode").state == "waiting"
    # It has failed, whether or not that can be saved.
    await queue.save_if_possible(done)
    assert queue.get("a-episode").state == "failed"
    queue._database._connection.execute("PRAGMA max_page_count = 1000000")
    await queue.add([new_job("b")])
    queue = await opened()
    assert ids(queue) == ["a", "b"]
    assert queue.get("a-episode").state == "waiting"


WRITER = """
import sys
from pathlib import Path
from services.alignment.job_queue import JobDatabase
from services.alignment.settings import AlignmentOptions
from services.alignment.schemas import AlignmentJob
database = JobDatabase(Path(sys.argv[1]))
for number in range(100_000):
    database.commit([], [AlignmentJob.new(f"{number}-episode", str(number), AlignmentOptions())])
    print(number, flush=True)
"""


@pytest.mark.long
def test_what_was_committed_survives_kill_9(folder):
    child = subprocess.Popen(
        [sys.executable, "-c", WRITER, str(folder)],
        stdout=subprocess.PIPE,
        env=os.environ | {"PYTHONPATH": os.pathsep.join(sys.path)},
    )
    acknowledged = []
    with child:
        for line in child.stdout:
            # Others are of the log.
            if line.strip().isdigit():
                acknowledged.append(int(line))
            if len(acknowledged) == 20:
                child.send_signal(signal.SIGKILL)
    jobs = [int(job.recording_id) for job in load(folder).values()]
    assert jobs[: len(acknowledged)] == acknowledged == list(range(len(acknowledged)))
    assert len(jobs) <= len(acknowledged) + 1


def test_pragmas_that_survive_a_power_failure(folder):
    database = JobDatabase(folder)
    read = database._connection.execute
    assert read("PRAGMA journal_mode").fetchone() == ("wal",)
    assert read("PRAGMA synchronous").fetchone() == (2,)
    database.close()


@pytest.mark.long
def test_one_process_has_the_jobs(folder):
    database = JobDatabase(folder)
    with pytest.raises(ConflictError, match="another alignment service"):
        JobDatabase(folder)
    # Another process, too; locks of one process and of several are not the same.
    child = subprocess.run(
        [sys.executable, "-c", WRITER, str(folder)],
        env=os.environ | {"PYTHONPATH": os.pathsep.join(sys.path)},
        capture_output=True,
        text=True,
        check=False,
    )
    assert "another alignment service" in child.stderr
    database.close()
    assert load(folder) == {}


def test_changed_row_is_refused_by_name(folder):
    database = JobDatabase(folder)
    database.commit([], [new_job("a"), new_job("b")])
    database.close()
    with sqlite3.connect(folder / DATABASE_FILE) as connection:
        connection.execute("UPDATE jobs SET job = replace(job, 'waiting', 'wbiting')")
    connection.close()
    with pytest.raises(CorruptDataError, match=r"job 1: .*checksum.*move the file away"):
        load(folder)


@pytest.mark.parametrize("place", [3, 4096 + 2, -100])
def test_damaged_file_is_refused(folder, place):
    database = JobDatabase(folder)
    database.commit([], [new_job(str(number)) for number in range(50)])
    database.close()
    path = folder / DATABASE_FILE
    data = bytearray(path.read_bytes())
    data[place] ^= 0xFF
    path.write_bytes(bytes(data))
    with pytest.raises(CorruptDataError, match="move the file away"):
        load(folder)
    # The lock was released.
    path.unlink()
    assert load(folder) == {}


def test_newer_schema_is_refused(folder):
    JobDatabase(folder).close()
    with sqlite3.connect(folder / DATABASE_FILE) as connection:
        connection.execute("PRAGMA user_version = 7")
    connection.close()
    with pytest.raises(CorruptDataError, match="got schema version 7, expected 1"):
        load(folder)


def test_job_that_killed_the_service_often_fails():
    job = new_job("a")
    for attempt in (1, 2):
        job = job.started().crashed(max_attempts=3)
        assert (job.state, job.attempts) == ("waiting", attempt)
    job = job.started().crashed(max_attempts=3)
    assert job.state == "failed"
    assert "died 3 times" in job.problem.detail
