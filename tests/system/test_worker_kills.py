"""Two workers share rollouts by Redis: kill -9 loses nothing; drain, restart and hot swap."""

import os
import random
import signal
import subprocess
import time

import numpy as np
import pytest
import yaml

from dextouch.clients import RolloutClient
from dextouch.errors import AccessDeniedError, UnavailableError
from tests.contracts.redis_server import running_redis
from tests.programs import needed_program
from tests.system.scaled import (
    ASKED,
    LAST,
    ROOT,
    Load,
    Service,
    free_port,
    haproxy,
    is_ready,
    noise,
    wait_until,
)
from tests.unit.worlds.fakes import actions

pytestmark = pytest.mark.system
TAKEOVER_S = 10.0  # on any machine; what an idle one needs is in docs/scaling.md


@pytest.fixture(scope="module")
def redis_url(tmp_path_factory):
    with running_redis(tmp_path_factory.mktemp("redis")) as url:
        yield url


@pytest.fixture
def one_port(tmp_path, redis_url):
    """Two workers of one parent on one port."""
    service = Service(tmp_path, redis_url, ("--workers", 2))
    wait_until(lambda: len(service.workers()) == 2, "two workers")
    yield service
    service.stop()


@pytest.fixture
def gateway(tmp_path, redis_url):
    """Two processes behind HAProxy: its address, and the processes."""
    services = [Service(tmp_path, redis_url, ("--drain-s", 60)) for _ in range(2)]
    for service in services:
        wait_until(lambda service=service: is_ready(service.url), "service")
    with haproxy(tmp_path, services) as url:
        yield url, services
    for service in services:
        service.process.kill()
        service.process.wait()


def report(load, kills_s, what):
    """What was measured around the kills; every rollout must be whole."""
    assert load.mistakes == []
    around_s = [
        1e3 * (end - begin)
        for begin, end in load.times_s
        if any(begin <= kill_s <= end for kill_s in kills_s)
    ]
    print(  # noqa: T201 - figures for docs/scaling.md
        f"\n{what}: {len(kills_s)} kills, {sum(load.num_chunks)} chunks of {len(load.num_chunks)} "
        f"rollouts, 0 lost, wrong or doubled; {len(around_s)} chunks during a kill: p50 "
        f"{np.percentile(around_s, 50):.0f} ms, p99 {np.percentile(around_s, 99):.0f} ms, max "
        f"{max(around_s):.0f} ms; all chunks: p50 "
        f"{1e3 * np.median([end - begin for begin, end in load.times_s]):.0f} ms; load "
        f"{os.getloadavg()[0]:.1f}"
    )
    assert max(around_s) < 1e3 * TAKEOVER_S


@pytest.mark.parametrize("num_kills", [2, pytest.param(20, marks=pytest.mark.slow)])
@pytest.mark.slow
def test_kills_of_workers_on_one_port(one_port, num_kills):
    rng, kills_s = random.Random(num_kills), []
    with Load(one_port.url) as load:
        for _ in range(num_kills):
            wait_until(lambda: len(one_port.workers()) == 2, "a new worker")
            load.advance()
            kills_s.append(time.monotonic())
            os.kill(rng.choice(one_port.workers()), signal.SIGKILL)
            load.advance()
    report(load, kills_s, "workers on one port")


@pytest.mark.parametrize("num_kills", [2, pytest.param(20, marks=pytest.mark.slow)])
def test_kills_of_workers_behind_the_gateway(gateway, num_kills):
    url, services = gateway
    rng, kills_s = random.Random(num_kills), []
    with Load(url) as load:
        for _ in range(num_kills):
            load.advance()
            victim = rng.choice(services)
            kills_s.append(time.monotonic())
            victim.process.kill()
            victim.process.wait()
            load.advance()
            victim.start()
            wait_until(lambda victim=victim: is_ready(victim.url), "the service again")
            time.sleep(1.0)  # the gateway looks twice a second
    report(load, kills_s, "workers behind HAProxy")


def test_the_gateway_sends_a_rollout_to_the_worker_that_has_it(gateway):
    url, services = gateway

    def num_restores():
        return [service.log_path.read_text().count("restored in [") for service in services]

    with RolloutClient(url, selector=LAST) as client:
        rollouts = [client.start(seed=seed, **ASKED) for seed in range(12)]
        for rollout in rollouts:
            rollout.step(actions(4))
        # Starts go round, so that half of the first chunks find their rollout in Redis.
        before = num_restores()
        for _ in range(4):
            for rollout in rollouts:
                rollout.step(actions(4))
        assert num_restores() == before


def test_a_drained_worker_finishes_and_begins_nothing(gateway):
    url, (first, second) = gateway
    with Load(url) as load, RolloutClient(first.url, patience_s=0.0) as direct:
        before = direct.start(seed=1, **ASKED)
        first.process.send_signal(signal.SIGTERM)
        wait_until(lambda: not is_ready(first.url), "not ready")
        assert before.step(actions(4)).first_step == 1
        for refused in (lambda: direct.start(seed=1, **ASKED), before.fork):
            with pytest.raises(UnavailableError, match="begins no rollouts") as caught:
                refused()
            assert caught.value.details["retry_after_s"] == 1
        with RolloutClient(url, patience_s=0.0) as client:
            after = client.start(seed=2, **ASKED)
            first.process.send_signal(signal.SIGTERM)
            assert first.process.wait(20) in {0, -signal.SIGTERM}
            after.step(actions(4))
        load.advance()
    assert load.mistakes == []
    assert is_ready(second.url)


@pytest.mark.slow
def test_a_new_checkpoint_by_a_restart_of_one_worker_after_another(one_port):
    with Load(one_port.url) as load, RolloutClient(one_port.url) as client:
        assert client.worlds()[0].digest == "d1"
        old = one_port.workers()
        one_port.digests.write_text("d2 d1")
        one_port.process.send_signal(signal.SIGHUP)
        wait_until(
            lambda: len(one_port.workers()) == 2 and not set(old) & set(one_port.workers()),
            "both workers anew",
        )
        load.advance()
        with RolloutClient(one_port.url) as other, other.start(seed=3, **ASKED) as rollout:
            assert rollout.info.world_digest == "d2"
            total = 3 + noise(3, 0, "d2")
            assert rollout.step(actions(4)).tactile_kpa[-1, 0, 0] == pytest.approx(total, abs=1e-4)
    # Each response was checked against the noise of the digest that its rollout began with: d1.
    assert load.mistakes == []


OLD, NEW = "the old key, 5d1f9a0c", "the new key, 83b7e2d4"


def write_keys(folder, *keys, raw=""):
    lines = "".join(
        f'[[sum.api_keys]]\nname = "lab"\nkey = "{key}"\nscopes = ["rollout"]\n' for key in keys
    )
    (folder / "dextouch.toml").write_text(lines + raw)


@pytest.mark.parametrize("num_workers", [1, 2])
def test_keys_are_exchanged_while_a_rollout_goes_on(tmp_path, redis_url, monkeypatch, num_workers):
    monkeypatch.setenv("DEXTOUCH_CONFIG", str(tmp_path / "dextouch.toml"))
    write_keys(tmp_path, OLD)
    service = Service(tmp_path, redis_url, ("--workers", num_workers))

    def reload(*keys):
        before = service.workers()
        write_keys(tmp_path, *keys)
        service.process.send_signal(signal.SIGHUP)
        if num_workers > 1:
            wait_until(
                lambda: len(now := service.workers()) == num_workers and not set(before) & set(now),
                "workers anew",
            )

    def valid(key):
        try:
            with RolloutClient(service.url, api_key=key) as client:
                return bool(client.worlds())
        except AccessDeniedError:
            return False

    try:
        wait_until(lambda: is_ready(service.url), "service")
        wait_until(lambda: len(service.workers()) == num_workers, "workers")
        assert (valid(OLD), valid(NEW)) == (True, False)
        with RolloutClient(service.url, api_key=OLD) as client:
            rollout = client.start(seed=3, **ASKED)
            reload(OLD, NEW)
            wait_until(lambda: valid(NEW), "the new key")
            rollout.step(actions(4))
        reload(NEW)
        wait_until(lambda: not valid(OLD), "the end of the old key")
        assert valid(NEW)
        # Settings with a mistake change nothing.
        write_keys(tmp_path, OLD, raw="[sum]\nclient_timeout_s = -1\n")
        service.process.send_signal(signal.SIGHUP)
        wait_until(lambda: "keys_not_reloaded" in service.log_path.read_text(), "the reason")
        if num_workers > 1:
            # One that takes the place of a dead one has the keys of now, not those of the start.
            dead, _ = service.workers()
            os.kill(dead, signal.SIGKILL)
            wait_until(lambda: len(set(service.workers()) - {dead}) == num_workers, "a new worker")
            # The kernel gives connections to either.
            assert not any(valid(OLD) for _ in range(20))
        assert (valid(OLD), valid(NEW)) == (False, True)
    finally:
        service.stop()


def test_a_worker_that_cannot_start_ends_the_service(tmp_path, redis_url):
    service = Service(tmp_path, redis_url, ("--workers", 2, "--step-s", -1))
    assert service.process.wait(60) == 1
    log = service.log_path.read_text()
    assert "step_s: got -1.0" in log
    assert "a worker could not start" in log


def start_redis(folder, port):
    """Redis as in the compose file."""
    program = needed_program("redis-server", package="redis-server")
    services = yaml.safe_load((ROOT / "docker-compose.yml").read_text())["services"]
    here = ["--port", str(port), "--bind", "127.0.0.1", "--dir", str(folder)]
    options = services["redis"]["command"][1:]
    return subprocess.Popen([program, *options, *here], stdout=subprocess.DEVNULL)


def test_rollouts_outlast_a_restart_of_redis(tmp_path):
    port = free_port()
    redis = start_redis(tmp_path, port)
    service = Service(tmp_path, f"redis://127.0.0.1:{port}/0")
    try:
        wait_until(lambda: is_ready(service.url), "service")
        with Load(service.url, num_rollouts=4) as load:
            redis.terminate()
            redis.wait(20)
            wait_until(lambda: not is_ready(service.url), "not ready")
            redis = start_redis(tmp_path, port)
            load.advance()
        assert load.mistakes == []
    finally:
        service.stop()
        redis.kill()
        redis.wait(20)
