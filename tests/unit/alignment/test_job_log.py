"""The jobs' file: what was kept is there again, torn ends are cut off, damage is refused."""

import errno
import os

import pytest

from dextouch.errors import ConflictError, CorruptDataError, StorageFullError
from services.alignment import job_log, job_steps
from services.alignment.job_log import LOG_FILE, JobLog
from services.alignment.options import AlignmentOptions


def new_job(name):
    return job_steps.submitted(f"{name}-episode", name, AlignmentOptions())


@pytest.fixture
def folder(tmp_path):
    return tmp_path / "jobs"


def reopened(folder):
    log = JobLog(folder)
    log.close()
    return log.jobs


def test_the_last_line_of_a_job_counts(folder):
    first, second = new_job("a"), new_job("b")
    log = JobLog(folder)
    log.append([first, second])
    log.append([job_steps.begun(first)])
    log.close()
    jobs = reopened(folder)
    assert list(jobs) == ["a-episode", "b-episode"]
    assert jobs["a-episode"].state == "running"
    assert jobs["b-episode"] == second


def test_what_is_asked_for_again_stands_last(folder):
    first, second = new_job("a"), new_job("b")
    log = JobLog(folder)
    log.append([first, second, job_steps.cancelled(first), first])
    log.close()
    assert list(reopened(folder)) == ["b-episode", "a-episode"]


@pytest.mark.parametrize("cut", [1, 2, 40])
def test_torn_end_is_cut_off(folder, cut):
    log = JobLog(folder)
    log.append([new_job("a")])
    log.append([new_job("b")])
    log.close()
    path = folder / LOG_FILE
    path.write_bytes(path.read_bytes()[:-cut])
    log = JobLog(folder)
    assert list(log.jobs) == ["a-episode"]
    log.append([new_job("c")])
    log.close()
    assert list(reopened(folder)) == ["a-episode", "c-episode"]


@pytest.mark.parametrize("place", [3, 30, 100])
def test_damage_in_the_middle_is_refused_and_named(folder, place):
    log = JobLog(folder)
    log.append([new_job("a"), new_job("b")])
    log.close()
    path = folder / LOG_FILE
    data = bytearray(path.read_bytes())
    data[place] ^= 4
    path.write_bytes(bytes(data))
    with pytest.raises(CorruptDataError, match=r"line 1 of 2.*move the file away"):
        JobLog(folder)
    # The lock was given back.
    path.unlink()
    assert reopened(folder) == {}


def test_one_process_has_the_jobs(folder):
    log = JobLog(folder)
    with pytest.raises(ConflictError, match="another alignment service"):
        JobLog(folder)
    log.close()
    assert reopened(folder) == {}


def test_full_disk_leaves_no_half_line(folder, monkeypatch):
    log = JobLog(folder)
    log.append([new_job("a")])
    size = (folder / LOG_FILE).stat().st_size

    def half(descriptor, data):
        os.write(descriptor, data[: len(data) // 2])
        raise OSError(errno.ENOSPC, "no space")

    monkeypatch.setattr(job_log, "write_all", half)
    with pytest.raises(StorageFullError):
        log.append([new_job("b")])
    monkeypatch.undo()
    assert (folder / LOG_FILE).stat().st_size == size
    log.append([new_job("c")])
    log.close()
    assert list(reopened(folder)) == ["a-episode", "c-episode"]


def test_a_long_file_is_written_anew(folder, monkeypatch):
    monkeypatch.setattr(job_log, "MIN_LINES", 10)
    job = new_job("a")
    log = JobLog(folder)
    for _ in range(20):
        log.append([job_steps.begun(job)])
        log.shorten([job])
    assert len((folder / LOG_FILE).read_bytes().splitlines()) <= 11
    log.append([new_job("b")])
    log.close()
    assert list(reopened(folder)) == ["a-episode", "b-episode"]


def test_a_job_that_killed_the_service_often_is_failed():
    job = new_job("a")
    for attempt in (1, 2):
        job = job_steps.interrupted(job_steps.begun(job), max_attempts=3)
        assert (job.state, job.attempts) == ("waiting", attempt)
    job = job_steps.interrupted(job_steps.begun(job), max_attempts=3)
    assert job.state == "failed"
    assert "died 3 times" in job.problem.detail
