"""Killed, stopped and starved containers: no acknowledged sample is lost, and errors say why."""

import os
import signal
import socket
import time

import httpx
import pytest

from tests.system.compose_processes import record_take, wait_for

pytestmark = pytest.mark.containers
TAKE_S = 3.0
ARRIVAL_TIMEOUT_S = 120.0
STOP_LIMIT_S = 10.0


@pytest.fixture
def arrived(composed, ask):
    """Wait until the store has exactly the samples of a take that the station counted."""

    def arrived(recording_id, num_samples):
        def stored():
            try:
                found = ask("GET", "episode_store", "/v1/recordings")["recordings"]
            except httpx.TransportError:
                return False
            return [item for item in found if item["recording_id"] == recording_id]

        wait_for("upload", ARRIVAL_TIMEOUT_S, stored, composed.logs)
        (found,) = stored()
        assert found["num_samples"] == num_samples

    return arrived


@pytest.fixture
def uploading(composed, ask):
    """Wait until a part of a take is in the store."""

    def uploading(recording_id):
        def begun():
            open_ones = ask("GET", "episode_store", "/v1/uploads")["uploads"]
            return [item for item in open_ones if item["recording_id"] == recording_id]

        deadline_s = time.monotonic() + ARRIVAL_TIMEOUT_S
        while not begun():
            assert time.monotonic() < deadline_s, composed.logs()

    return uploading


def start_again(composed, engine, name, old_pid):
    """As the daemon does for `restart: unless-stopped`, if podman has not done it by itself."""

    def gone():
        return composed.pid(name) != old_pid

    wait_for(f"end of {name}", 30, gone, composed.logs)
    if not engine.inspect(name, ".State.Running"):
        engine.podman("start", name)
    composed.wait_healthy(name)


@pytest.mark.parametrize("name", ["episode_store", "acquisition"])
def test_killed_during_an_upload(composed, engine, ask, uploading, arrived, name):
    recording_id, num_samples = record_take(ask, TAKE_S, composed.logs)
    uploading(recording_id)
    pid = composed.pid(name)
    os.kill(pid, signal.SIGKILL)
    start_again(composed, engine, name, pid)
    arrived(recording_id, num_samples)


def test_a_station_killed_while_recording_keeps_the_take(composed, engine, ask):
    prompt = {"task": "stand_bottle", "instruction": "stand the bottle up", "consent": True}
    ask("POST", "acquisition", "/v1/recorder/arm", json=prompt)
    recording_id = ask("POST", "acquisition", "/v1/recorder/record")["recording_id"]
    wait_for(
        "samples",
        30,
        lambda: ask("GET", "acquisition", "/v1/recorder")["duration_s"] > TAKE_S,
        composed.logs,
    )
    before = ask("GET", "acquisition", "/v1/recorder")["num_samples"]
    time.sleep(1.0)  # flush_period_s is 0.5: what was counted before is on the disk
    pid = composed.pid("acquisition")
    os.kill(pid, signal.SIGKILL)
    start_again(composed, engine, "acquisition", pid)

    def stored():
        found = ask("GET", "episode_store", "/v1/recordings")["recordings"]
        return [item for item in found if item["recording_id"] == recording_id]

    wait_for("upload", ARRIVAL_TIMEOUT_S, stored, composed.logs)
    (found,) = stored()
    assert found["recovered"]
    assert {n: found["num_samples"][n] >= count for n, count in before.items()} == dict.fromkeys(
        before, True
    )


def test_a_store_that_stands_still_delays_uploads_only(composed, ask, arrived):
    pid = composed.pid("episode_store")
    os.kill(pid, signal.SIGSTOP)
    try:
        began_s = time.monotonic()
        recording_id, num_samples = record_take(ask, TAKE_S, composed.logs)
        assert ask("GET", "acquisition", "/v1/recorder")["state"] in {"idle", "saved"}
        assert time.monotonic() - began_s < 5 * TAKE_S
        time.sleep(3.0)
        sent = {
            item["recording_id"]: item["uploaded"]
            for item in ask("GET", "acquisition", "/v1/uploads")
        }
        assert sent[recording_id] is False
    finally:
        os.kill(pid, signal.SIGCONT)
    arrived(recording_id, num_samples)


def test_a_taken_port_is_named(composed):
    with socket.create_server(("127.0.0.1", 0)) as taken:
        port = taken.getsockname()[1]
        environment = {"DEXTOUCH_DASHBOARD_PORT": str(port), "DEXTOUCH_DASHBOARD_HOST": "127.0.0.1"}
        done = composed.run_once("dashboard", network="host", environment=environment)
    assert done.returncode != 0
    text = done.stdout + done.stderr
    assert str(port) in text
    assert "Traceback" not in text


# Last: it ends the services.
def test_all_end_in_time_and_without_error(composed, note):
    ended = {name: composed.stop(name) for name in reversed(list(composed.started_s))}
    for name, (time_s, status) in ended.items():
        note(f"{name}: ended {time_s:.1f} s after SIGTERM with status {status}")
    assert {name: status for name, (_, status) in ended.items() if status != 0} == {}
    assert {name: time_s for name, (time_s, _) in ended.items() if time_s > STOP_LIMIT_S} == {}
