"""Jobs: results, errors and killed workers; worker processes end with the one that made them."""

import os
import pickle
import signal
import subprocess
import sys
import time
from dataclasses import replace
from functools import partial
from importlib.metadata import version
from pathlib import Path

import pytest

from dextouch import jobs as jobs_module
from dextouch.errors import (
    ConflictError,
    EndedError,
    NotFoundError,
    UnavailableError,
    UnknownNameError,
)
from dextouch.jobs import Workers, results_of, run_jobs, worker_pool

PARENT = """
import os, sys, time
from dextouch.jobs import worker_pool

if __name__ == "__main__":
    with worker_pool(1) as pool:
        print(pool.submit(os.getpid).result(), flush=True)
        pool.submit(time.sleep, 600).result()
"""


def is_running(pid):
    try:
        state = Path(f"/proc/{pid}/stat").read_text().rsplit(")", 1)[1].split()[0]
    except (FileNotFoundError, ProcessLookupError):
        return False
    # A zombie waits for nothing but its parent.
    return state != "Z"


@pytest.mark.long
@pytest.mark.parametrize("number", [signal.SIGTERM, signal.SIGKILL])
def test_workers_end_with_a_parent_that_is_killed(tmp_path, number):
    script = tmp_path / "parent.py"
    script.write_text(PARENT)
    with subprocess.Popen([sys.executable, script], stdout=subprocess.PIPE, text=True) as parent:
        worker = int(parent.stdout.readline())
        assert is_running(worker)
        parent.send_signal(number)
    deadline_s = time.monotonic() + 30
    while is_running(worker) and time.monotonic() < deadline_s:
        time.sleep(0.05)
    assert not is_running(worker)


def test_results_and_errors_come_back():
    with worker_pool(2, os.getpid) as pool:
        assert list(pool.map(abs, [-1, 2, -3])) == [1, 2, 3]
        with pytest.raises(ValueError, match="invalid literal"):
            pool.submit(int, "x").result()


def square(number):
    return number**2


def refuse_odd(number):
    if number % 2:
        raise UnknownNameError("number", str(number), ["0", "2"])
    return number


def broken(number):
    raise ZeroDivisionError(number)


def end_the_first_time(order):
    """Kill the worker at the first attempt, then give the number of attempts."""
    folder, name = order
    attempts = Path(folder, name)
    with attempts.open("a") as file:
        file.write("x")
    if (name.startswith("once") and len(attempts.read_text()) == 1) or name == "always":
        os.kill(os.getpid(), signal.SIGKILL)
    return len(attempts.read_text())


def noted(value):
    Path(os.environ["NOTED"], f"{os.getpid()}-{value}").touch()


@pytest.mark.long
@pytest.mark.parametrize("num_processes", [1, 2])
def test_jobs_give_their_results_and_errors(num_processes):
    jobs = list(run_jobs(refuse_odd, range(5), Workers(num_processes)))
    assert sorted(job.item for job in jobs) == list(range(5))
    assert {job.item: job.value for job in jobs if job.error is None} == {0: 0, 2: 2, 4: 4}
    errors = [job.error for job in jobs if job.error is not None]
    assert {type(error) for error in errors} == {UnknownNameError}
    assert all("0, 2" in error.message for error in errors)
    with pytest.raises(UnknownNameError):
        jobs[[job.item for job in jobs].index(1)].result()
    seen, results = [], results_of(jobs)
    with pytest.raises(UnknownNameError):
        seen.extend(results)
    assert sorted(seen) == [0, 2, 4]


@pytest.mark.parametrize("num_processes", [1, 2])
def test_a_bug_ends_the_run(num_processes):
    with pytest.raises(ZeroDivisionError):
        list(run_jobs(broken, range(3), Workers(num_processes)))


@pytest.mark.long
def test_a_job_whose_worker_is_killed_is_repeated_and_others_are_not(tmp_path):
    names = ["a", "once-1", "b", "always", "c", "once-2", "d"]
    jobs = list(run_jobs(end_the_first_time, [(str(tmp_path), n) for n in names], Workers(2)))
    by_name = {job.item[1]: job for job in jobs}
    assert len(jobs) == len(names) == len(by_name)
    lost = by_name.pop("always")
    assert isinstance(lost.error, UnavailableError)
    assert "killed again" in lost.error.message
    assert all(job.error is None for job in by_name.values())
    assert by_name["once-1"].value == by_name["once-2"].value == 2
    # Only the neighbours of jobs that end their workers may have been begun twice.
    assert sum(by_name[name].value for name in "abcd") <= 4 + 3


@pytest.mark.long
def test_workers_are_prepared(tmp_path, monkeypatch):
    monkeypatch.setenv("NOTED", str(tmp_path))
    jobs = run_jobs(square, range(6), Workers(2), prepare=partial(noted, "ready"))
    assert sorted(results_of(jobs)) == [0, 1, 4, 9, 16, 25]
    assert 1 <= len(list(tmp_path.iterdir())) <= 2


def test_a_machine_that_does_not_see_the_folder_or_has_another_version_refuses_jobs(
    tmp_path, monkeypatch
):
    here = version("dextouch-wm")
    with jobs_module._marked([tmp_path / "store"]) as marks:
        monkeypatch.chdir(tmp_path)
        seen = jobs_module._Here(marks, here, tmp_path / "store")
        assert jobs_module._attempt(square, None, seen, 3) == (9, None)
        assert Path.cwd() == tmp_path / "store"
        for other in (
            replace(seen, marks=(tmp_path / "elsewhere/x",)),
            replace(seen, folder=tmp_path / "elsewhere"),
        ):
            _, error = jobs_module._attempt(square, None, other, 3)
            assert isinstance(error, NotFoundError)
            assert "mount it" in error.message
        _, error = jobs_module._attempt(square, None, replace(seen, version="0.0.1"), 3)
        assert isinstance(error, ConflictError)
        assert "expected 0.0.1" in error.message
    assert list((tmp_path / "store").iterdir()) == []


@pytest.mark.parametrize(
    "error",
    [
        UnknownNameError("task", "x", ["a"]),
        ConflictError("is there", episodes=["a"]),
        EndedError("is over", reason="deadline"),
    ],
)
def test_errors_pass_between_processes(error):
    copy = pickle.loads(pickle.dumps(error))  # noqa: S301 - our own
    assert (type(copy), copy.message, copy.details) == (type(error), error.message, error.details)
    assert str(copy) == str(error)
