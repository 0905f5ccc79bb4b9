"""kill -9 of the alignment service and of its workers: every job ends once, none is forgotten."""

import os
import signal
import subprocess
import sys
import time

import httpx
import psutil
import pytest

from dextouch.episodes import EpisodeStore
from services.pipelines.servers import bind
from tests.unit.alignment.recordings import write_recording

# Compiling the solver for the first time takes half a minute, on a busy machine many of them.
TIMEOUT_S = 900
NUM_TAKES = 6
pytestmark = pytest.mark.system


class Service:
    """The service in a process of its own, which a test may kill and start again."""

    def __init__(self, store, tmp_path, *, max_attempts=2):
        place = bind("alignment", host="127.0.0.1", port=0)
        self.url = place.url
        place.socket.close()
        self._arguments = [
            "serve",
            f"--store-url={store.root}",
            f"--port={self.url.rsplit(':', 1)[1]}",
            "--num-workers=1",
            f"--max-attempts={max_attempts}",
            # Jobs are those that the tests ask for.
            "--no-align-new",
        ]
        self._log = (tmp_path / "service.log").open("ab")
        self.process = None

    def start(self):
        self.process = subprocess.Popen(
            [sys.executable, "-m", "services.cli.main", "align", *self._arguments],
            stdout=self._log,
            stderr=self._log,
        )
        self.until(lambda: self.get("/readyz")["ready"])

    def get(self, path, **params):
        return httpx.get(f"{self.url}{path}", params=params, timeout=30, trust_env=False).json()

    def post(self, path, body=None):
        answer = httpx.post(f"{self.url}{path}", json=body, timeout=30, trust_env=False)
        answer.raise_for_status()
        return answer.json()

    def jobs(self):
        return self.get("/v1/alignments", limit=1000)["alignments"]

    def states(self):
        return [job["state"] for job in self.jobs()]

    def until(self, wanted):
        end = time.monotonic() + TIMEOUT_S
        while time.monotonic() < end:
            assert self.process.poll() is None, "the service ended"
            try:
                if wanted():
                    return
            except httpx.TransportError:
                pass
            time.sleep(0.02)
        raise AssertionError("waited in vain")

    @property
    def worker(self):
        (worker,) = psutil.Process(self.process.pid).children()
        return worker

    def hold_worker(self):
        """Stop the worker, so that the next job stays at work until somebody is killed."""
        worker = self.worker
        worker.suspend()
        return worker

    def kill(self):
        self.process.kill()
        self.process.wait()

    def close(self):
        if self.process is not None and self.process.poll() is None:
            self.process.terminate()
            self.process.wait(60)
        self._log.close()


@pytest.fixture
def store(tmp_path):
    store = EpisodeStore(tmp_path / "store")
    for number in range(NUM_TAKES):
        write_recording(store, f"take-{number}", seconds=20.0)
    return store


@pytest.fixture
def service(store, tmp_path):
    service = Service(store, tmp_path)
    yield service
    service.close()


def takes(*numbers):
    return {"recording_ids": [f"take-{number}" for number in numbers]}


def test_killed_services_and_workers_lose_no_job(service, store):
    service.start()
    worker = service.hold_worker()
    service.post("/v1/alignments", takes(*range(NUM_TAKES)))
    service.until(lambda: service.states()[0] == "running")
    service.kill()
    # An orphan ends by itself as soon as it has something to say.
    worker.resume()
    psutil.wait_procs([worker], timeout=TIMEOUT_S)
    assert not worker.is_running()

    service.start()
    service.until(lambda: set(service.states()) == {"done"})
    jobs = service.jobs()
    assert [job["recording_id"] for job in jobs] == takes(*range(NUM_TAKES))["recording_ids"]
    assert [job["attempts"] for job in jobs] == [2] + [1] * (NUM_TAKES - 1)
    assert store.list() == sorted(job["alignment_id"] for job in jobs)
    assert store.sweep() == 0


def test_a_killed_worker_fails_its_job_alone(service, store):
    service.start()
    worker = service.hold_worker()
    service.post("/v1/alignments", takes(0, 1))
    service.until(lambda: service.states()[0] == "running")
    os.kill(worker.pid, signal.SIGKILL)
    service.until(lambda: service.states() == ["failed", "done"])
    problem = service.jobs()[0]["problem"]
    assert problem["status"] == 503
    assert "killed" in problem["detail"]
    again = service.post("/v1/alignments", {"recording_id": "take-0"})
    assert again["state"] in {"waiting", "running", "done"}
    service.until(lambda: set(service.states()) == {"done"})


@pytest.mark.slow
def test_a_job_that_kills_the_service_is_not_tried_for_ever(store, tmp_path):
    service = Service(store, tmp_path, max_attempts=1)
    try:
        service.start()
        worker = service.hold_worker()
        service.post("/v1/alignments", takes(0, 1))
        service.until(lambda: service.states()[0] == "running")
        service.kill()
        worker.kill()
        service.start()
        service.until(lambda: service.states() == ["failed", "done"])
        assert "died 1 times" in service.jobs()[0]["problem"]["detail"]
        # Whoever asks for it again gets it.
        service.post("/v1/alignments", takes(0))
        service.until(lambda: set(service.states()) == {"done"})
    finally:
        service.close()
