"""A station from its one-time token to its revocation, over a store that is a real process."""

import json
import os
import re
import signal
import stat
import subprocess
import sys
import time
from contextlib import contextmanager

import httpx
import pytest

from services.acquisition.app import create_app
from services.acquisition.mocks import pattern
from services.acquisition.settings import AcquisitionSettings, with_enrolment
from services.cli.main import main
from services.pipelines.servers import served

PATIENCE_S = 120
ADMIN_KEY = "key-of-an-administrator"
ADMIN = {"name": "admin", "key": ADMIN_KEY, "scopes": ["enrol", "store_read"]}
AS_ADMIN = {"authorization": f"Bearer {ADMIN_KEY}"}
PROMPT = {"task": "stand_bottle", "instruction": "stand the bottle up"}


def until(found, what):
    end_s = time.monotonic() + PATIENCE_S
    while not (value := found()):
        assert time.monotonic() < end_s, what
        time.sleep(0.1)
    return value


@contextmanager
def store_process(folder, port=0):
    """A store with keys; its address."""
    log = folder / "store.log"
    keys = {"DEXTOUCH_EPISODE_STORE_API_KEYS": json.dumps([ADMIN])}
    command = [sys.executable, "-m", "services.cli.main", "store", "serve"]
    command += ["--store-url", str(folder / "store"), "--port", str(port), "--log-level", "debug"]
    with (
        log.open("ab") as output,
        subprocess.Popen(command, stderr=output, env=os.environ | keys) as process,
    ):
        try:
            begin = log.stat().st_size
            url = until(
                lambda: re.search(r"http://127\.0\.0\.1:\d+", log.read_text()[begin:]),
                "the store did not start",
            )[0]
            yield url
        finally:
            process.send_signal(signal.SIGTERM)
            process.wait(PATIENCE_S)


@pytest.fixture
def station(tmp_path, monkeypatch):
    """Serve the enrolled station with one mock tracker."""
    streams = [s for s in pattern.pattern_streams() if s.descriptor.name == "head"]
    monkeypatch.setattr(pattern, "pattern_streams", lambda **_: streams)

    def start():
        settings = AcquisitionSettings(
            mock=True,
            spool=tmp_path / "spool",
            enrolment=tmp_path / "enrolment.json",
            upload_period_s=0.1,
        )
        return served({"station": create_app(settings)})

    return start


def save_a_take(station):
    def act(action, **body):
        answer = station.post(f"/v1/recorder/{action}", json=body)
        assert answer.is_success, answer.text
        return answer.json()

    act("arm", **PROMPT)
    recording_id = act("record")["recording_id"]
    until(lambda: station.get("/v1/recorder").json()["duration_s"] > 0.3, "no samples")
    act("stop")
    # A busy machine may leave gaps.
    act("save", success=True, accept_incomplete=True)
    return recording_id


def upload_of(station, recording_id):
    return station.get(f"/v1/uploads/{recording_id}").json()


@pytest.fixture
def run(capsys):
    """Run a command of `dextouch`, and return what it printed."""

    def start(*words, status=0):
        assert main(list(words)) == status
        return capsys.readouterr()

    return start


def enrol(run, url, path):
    """Enrol desk_7 as an administrator and the station do; its token and key."""
    shown = run("store", "enrol", "desk_7", "--url", url, "--key", ADMIN_KEY).out
    command = re.search(r"^  dextouch (station enrol \S+ (\S+))$", shown, re.MULTILINE)
    given = run(*command[1].split(), "--output", str(path), "--json", "-")
    expected = {"station": "desk_7", "episode_store_url": url, "path": str(path)}
    assert json.loads(given.out) == expected
    assert stat.S_IMODE(path.stat().st_mode) == 0o600
    kept = path.read_text()
    key = json.loads(kept)["episode_store_key"]
    assert command[2] not in given.out + given.err
    assert key not in given.out + given.err
    assert "used before" in run(*command[1].split(), "--output", str(path), status=3).err
    assert path.read_text() == kept
    return command[2], key


def test_a_station_enrols_uploads_and_is_revoked(tmp_path, station, run):
    with store_process(tmp_path) as url:
        assert "no key" in run("store", "enrol", "desk_7", "--url", url, status=3).err
        token, key = enrol(run, url, tmp_path / "enrolment.json")
        with station() as urls, httpx.Client(base_url=urls["station"], timeout=60) as client:
            take = save_a_take(client)
            until(lambda: upload_of(client, take)["uploaded"], "not uploaded")
    with (
        store_process(tmp_path, url.rpartition(":")[2]),
        station() as urls,
        httpx.Client(base_url=urls["station"], timeout=60) as client,
    ):
        second = save_a_take(client)
        until(lambda: upload_of(client, second)["uploaded"], "not uploaded after a restart")
        listed = httpx.get(f"{url}/v1/recordings", headers=AS_ADMIN).json()["recordings"]
        stored = {one["recording_id"]: one["station"] for one in listed}
        assert stored == {take: "desk_7", second: "desk_7"}
        administration = ("--url", url, "--key", ADMIN_KEY)
        assert "desk_7" in run("store", "stations", *administration).out
        # The station's log, which is printed here, too, may say that its key is refused.
        printed = run("store", "revoke", "desk_7", *administration).out.splitlines()
        assert printed.count("revoked: desk_7") == 1
        as_station = {"authorization": f"Bearer {key}"}
        refused = httpx.post(f"{url}/v1/recordings", json={}, headers=as_station)
        assert refused.status_code == 401
        last = save_a_take(client)
        assert "unknown key" in until(lambda: upload_of(client, last)["error"], "not refused")
        # It waits for another key.
        assert not upload_of(client, last)["refused"]
    log = (tmp_path / "store.log").read_text()
    for event in ("issue_enrolment_token", "enrol_station", "revoke_station"):
        assert event in log
    assert not [one for one in (token, key, ADMIN_KEY) if one in log]


def test_the_place_of_the_key_is_checked_before_the_token_is_used(tmp_path, capsys):
    (tmp_path / "file").write_text("in the way")
    place = str(tmp_path / "file" / "enrolment.json")
    # Nobody listens there: the command does not get as far.
    command = ["station", "enrol", "http://127.0.0.1:9", "t" * 43, "--output", place]
    assert main(command) == 3
    assert "enrolment.json" in capsys.readouterr().err


KEPT = {"station": "desk_7", "episode_store_url": "http://store:1", "episode_store_key": "k" * 43}


@pytest.mark.parametrize(
    ("given", "expected"),
    [
        ({}, ("http://store:1", "k" * 43, "desk_7")),
        ({"station": "mine"}, ("http://store:1", "k" * 43, "mine")),
        ({"episode_store_url": "http://store:1/"}, ("http://store:1", "k" * 43, "desk_7")),
        ({"episode_store_url": "http://other:1"}, ("http://other:1", None, "station")),
        (
            {"episode_store_url": "http://store:1", "episode_store_key": "s" * 20},
            ("http://store:1", "s" * 20, "station"),
        ),
    ],
)
def test_settings_come_before_the_enrolment(tmp_path, given, expected):
    path = tmp_path / "enrolment.json"
    path.write_text(json.dumps(KEPT))
    settings = with_enrolment(AcquisitionSettings(enrolment=path, **given))
    key = settings.episode_store_key
    found = (settings.episode_store_url, key and key.get_secret_value(), settings.station)
    assert found == expected
    assert "kkkk" not in repr(settings)
