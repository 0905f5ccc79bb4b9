"""Workers of `sum_service` as processes, alone or behind HAProxy, and policies that use them."""

import hashlib
import os
import re
import signal
import socket
import subprocess
import sys
import threading
import time
import urllib.error
import urllib.request
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
import psutil

from dextouch.clients import RolloutClient
from dextouch.schemas import ReturnSelector
from tests.programs import needed_program
from tests.unit.worlds.fakes import actions

ROOT = Path(__file__).parents[2]
ASKED = {"world": "sum", "task": "stand_bottle", "instruction": "stand the bottle up"}
LAST = ReturnSelector(cameras=(), steps="last")
NUM_STEPS = 4
READY_TIMEOUT_S = 120.0


def free_port():
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        return probe.getsockname()[1]


def wait_until(condition, what, timeout_s=READY_TIMEOUT_S):
    deadline_s = time.monotonic() + timeout_s
    while not condition():
        assert time.monotonic() < deadline_s, f"{what} not within {timeout_s} s"
        time.sleep(0.02)


def is_ready(url):
    try:
        with urllib.request.urlopen(url + "/readyz", timeout=2) as answer:  # noqa: S310
            return answer.status == 200
    except (OSError, urllib.error.URLError):
        return False


@dataclass
class Service:
    """One process of the service, which may be the parent of several workers."""

    folder: Path
    redis_url: str
    flags: tuple = ()
    port: int = field(default_factory=free_port)

    def __post_init__(self):
        self.digests = self.folder / "digests"
        if not self.digests.exists():
            self.digests.write_text("d1")
        self.log_path = self.folder / f"service_{self.port}.log"
        self.url = f"http://127.0.0.1:{self.port}"
        self.start()

    def start(self):
        # More chunks than a rollout takes on a fast machine.
        own = ("--digests", self.digests, "--port", self.port, "--state-url", self.redis_url)
        own += ("--limits.max-chunks", 10**6)
        command = [sys.executable, "-m", "tests.system.sum_service", *own, *self.flags]
        environment = os.environ | {"PYTHONPATH": f"{ROOT}:{ROOT / 'shared'}"}
        with self.log_path.open("ab") as log:
            self.process = subprocess.Popen(
                [str(word) for word in command],
                env=environment,
                cwd=ROOT,
                stdin=subprocess.DEVNULL,
                stdout=log,
                stderr=subprocess.STDOUT,
            )

    def workers(self):
        """Processes that serve, without those that start."""
        started = re.findall(r"restored in \[(\d+)\]", self.log_path.read_text())
        found = [self.process.pid, *(child.pid for child in self._children())]
        return [pid for pid in found if str(pid) in started]

    def stop(self):
        children = self._children()
        if self.process.poll() is None:
            self.process.send_signal(signal.SIGTERM)
        try:
            return self.process.wait(30)
        finally:
            self.process.kill()
            for child in children:
                if child.is_running():
                    child.kill()

    def _children(self):
        if self.process.poll() is not None:
            return []
        return psutil.Process(self.process.pid).children()


@contextmanager
def haproxy(folder, services):
    """The gateway's own configuration, with these services in place of those of compose."""
    program = needed_program("haproxy", package="haproxy")
    text = (ROOT / "deploy/haproxy/haproxy.cfg").read_text()
    port = free_port()
    head, _, _ = text.partition("frontend world_model")
    servers = "\n".join(f"  server s{s.port} 127.0.0.1:{s.port}" for s in services)
    head = head.replace("bind :8084", f"bind 127.0.0.1:{port}")
    head, count = re.subn(r"  server-template .*", servers, head)
    assert count == 1
    path = folder / "haproxy.cfg"
    path.write_text(head)
    with (
        (folder / "haproxy.log").open("wb") as log,
        subprocess.Popen([program, "-f", path], stdout=log, stderr=log) as process,
    ):
        try:
            url = f"http://127.0.0.1:{port}"
            wait_until(lambda: is_ready(url), "haproxy")
            yield url
        finally:
            process.terminate()
            process.wait(10)


@dataclass
class Load:
    """Policies that advance one rollout each until told to stop, and check every response.

    What must come is counted from the interface's description: every chunk once, in order, with
    the noise of its number and of the digest that the rollout began with.
    """

    url: str
    num_rollouts: int = 16

    def __post_init__(self):
        self.stopping = threading.Event()
        self.num_chunks = [0] * self.num_rollouts
        self.mistakes = []
        # When each chunk was asked for and answered.
        self.times_s = []
        self.threads = [
            threading.Thread(target=self._run, args=(index,)) for index in range(self.num_rollouts)
        ]

    def __enter__(self):
        for thread in self.threads:
            thread.start()
        self.advance()
        return self

    def __exit__(self, *_):
        self.stopping.set()
        for thread in self.threads:
            thread.join(120)

    def advance(self, by=3):
        """Wait until every rollout has got further."""
        goals = [count + by for count in self.num_chunks]
        wait_until(
            lambda: (
                self.mistakes or all(n >= g for n, g in zip(self.num_chunks, goals, strict=True))
            ),
            "progress of all rollouts",
        )

    def _run(self, index):
        try:
            with RolloutClient(self.url, selector=LAST) as client:
                self._play(client, index)
        except Exception as error:  # noqa: BLE001 - of any kind it is a lost rollout
            self.mistakes.append(f"rollout {index}: {type(error).__name__}: {error}")

    def _play(self, client, index):
        total = float(index)
        with client.start(seed=index, **ASKED) as rollout:
            while not self.stopping.is_set():
                chunk = rollout.info.next_chunk
                rows = actions(NUM_STEPS, 0.01 * index)
                asked_s = time.monotonic()
                seen = rollout.step(rows)
                self.times_s.append((asked_s, time.monotonic()))
                total += NUM_STEPS * 0.01 * index + noise(index, chunk, rollout.info.world_digest)
                expected = (chunk + 1, NUM_STEPS * (chunk + 1), np.float32(total))
                got = (rollout.info.next_chunk, seen.first_step, seen.tactile_kpa[-1, 0, 0])
                if got[:2] != expected[:2] or abs(got[2] - expected[2]) > 1e-4:
                    self.mistakes.append(f"rollout {index}: got {got}, expected {expected}")
                    return
                self.num_chunks[index] += 1


def noise(seed, chunk, digest):
    """Sum of a chunk's noise, seeded as docs/rollout_api.md says."""
    text = f"{seed}/{chunk}/{digest}".encode()
    chunk_seed = int.from_bytes(hashlib.sha256(text).digest()[:8], "big") & (2**63 - 1)
    return np.random.default_rng(chunk_seed).normal(size=NUM_STEPS).sum()
