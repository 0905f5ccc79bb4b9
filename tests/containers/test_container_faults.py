"""Killed, stopped and starved containers: no acknowledged sample is lost, and errors say why."""

import os
import signal
import socket
import time

import pytest

from tests.system.compose_processes import record_take, wait_for

pytestmark = pytest.mark.containers
TAKE_S = 3.0
ARRIVAL_TIMEOUT_S = 120.0


@pytest.mark.parametrize("name", ["episode_store", "acquisition"])
def test_killed_during_an_upload(composed, ask, uploading, arrived, name):
    recording_id, num_samples = record_take(ask, TAKE_S, composed.logs)
    uploading(recording_id)
    composed.kill(name)
    composed.wait_healthy(name)
    arrived(recording_id, num_samples)


def test_a_station_killed_while_recording_keeps_the_take(composed, ask):
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
    composed.kill("acquisition")
    composed.wait_healthy("acquisition")

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
