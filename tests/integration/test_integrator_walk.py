"""An integrator backs up, destroys and restores a store behind TLS, and exchanges a key."""

import json
import os
import shutil
import signal
import subprocess
import sys
from contextlib import contextmanager

import httpx
import pytest

from services.acquisition.app import create_app
from services.acquisition.mocks import pattern
from services.acquisition.settings import AcquisitionSettings
from services.cli.main import main
from services.pipelines.servers import served
from tests.integration.test_station_enrolment import PATIENCE_S, save_a_take, until, upload_of
from tests.integration.tls_proxies import running_proxy, trusted_certificates
from tests.system.compose_processes import free_port

STATION_KEY, OLD, NEW = "station's key 4f8a13c2", "the old key, 5d1f9a0c", "the new key, 83b7e2d4"


def key(name, text, scope):
    fields = {"name": name, "key": text, "scopes": [scope]}
    return "".join(f"{one} = {json.dumps(value)}\n" for one, value in fields.items())


class Store:
    """A store as a process on one port, whose settings are in a file."""

    def __init__(self, folder):
        self.folder, self.port = folder, free_port()
        self.url = f"http://127.0.0.1:{self.port}"
        self.config, self.log = folder / "dextouch.toml", folder / "store.log"

    def configure(self, place, *keys):
        text = f'[episode_store]\nstore_url = "{place}"\nport = {self.port}\n'
        text += 'trusted_proxies = ["127.0.0.1"]\nlog_format = "json"\n'
        entries = [key("desk_7", STATION_KEY, "store_write")]
        entries += [key("reader", one, "store_read") for one in keys]
        self.config.write_text(text + "".join(f"[[episode_store.api_keys]]\n{e}" for e in entries))

    @contextmanager
    def running(self):
        command = [sys.executable, "-m", "services.cli.main", "store", "serve"]
        environment = os.environ | {"DEXTOUCH_CONFIG": str(self.config)}
        with (
            self.log.open("ab") as log,
            subprocess.Popen(
                command, stderr=log, stdin=subprocess.DEVNULL, env=environment
            ) as process,
        ):
            try:
                until(self._is_ready, "the store did not start")
                yield process
            finally:
                process.kill()
                process.wait(PATIENCE_S)

    def _is_ready(self):
        try:
            return httpx.get(f"{self.url}/readyz", trust_env=False).status_code == 200
        except httpx.HTTPError:
            return False


@pytest.fixture
def address(tmp_path, monkeypatch):
    """A store, and its address behind TLS."""
    store, folder, port = Store(tmp_path), tmp_path / "tls", free_port()
    trusted_certificates(folder, monkeypatch)
    with running_proxy("nginx", folder, {"store.lab": store.url}, port, free_port()):
        yield store, f"https://store.lab:{port}"


def test_an_integrator_keeps_a_store(address, tmp_path, monkeypatch):
    store, url = address
    streams = [s for s in pattern.pattern_streams() if s.descriptor.name == "head"]
    monkeypatch.setattr(pattern, "pattern_streams", lambda **_: streams)
    settings = AcquisitionSettings(
        mock=True,
        station="desk_7",
        spool=tmp_path / "spool",
        episode_store_url=url,
        episode_store_key=STATION_KEY,
        upload_period_s=0.1,
        enrolment=tmp_path / "none.json",
    )
    first, second = tmp_path / "first", tmp_path / "second"
    with (
        served({"station": create_app(settings)}) as urls,
        httpx.Client(base_url=urls["station"], timeout=60) as desk,
    ):
        takes = back_up_and_lose(store, desk, first, tmp_path / "backup")
        words = ["store", "restore-backup", str(tmp_path / "backup"), "--store", str(second)]
        assert main(words) == 0
        assert main(["store", "verify", "--store", str(second)]) == 0
        store.configure(second, OLD)
        with store.running() as process:
            assert read(url, OLD) == takes[:1]
            # The take after the backup is in the spool.
            for note in (tmp_path / "spool").glob("*/uploaded.json"):
                note.unlink()
            until(lambda: upload_of(desk, takes[1])["uploaded"], "not sent again")
            assert read(url, OLD) == sorted(takes)
            exchange_a_key(store, process, url, second)
            third = save_a_take(desk)
            until(lambda: upload_of(desk, third)["uploaded"], "not uploaded")
    assert main(["store", "verify", "--store", str(second)]) == 0


def back_up_and_lose(store, desk, place, backup):
    """Record a take before and one after the backup, then lose the store; ids of both."""
    store.configure(place, OLD)
    takes = []
    with store.running():
        for _ in range(2):
            takes.append(save_a_take(desk))
            until(lambda: upload_of(desk, takes[-1])["uploaded"], "not uploaded")
            if len(takes) == 1:
                assert main(["store", "backup", str(backup), "--store", str(place)]) == 0
    shutil.rmtree(place)
    return takes


def exchange_a_key(store, process, url, place):
    """Exchange a key in three steps; the process goes on, and nobody is refused on the way."""
    reloaded = "keys_reloaded"
    for number, keys in enumerate(((OLD, NEW), (NEW,)), start=1):
        assert read(url, OLD)
        store.configure(place, *keys)
        process.send_signal(signal.SIGHUP)
        until(lambda: store.log.read_text().count(reloaded) == number, "not reloaded")  # noqa: B023
        assert read(url, NEW)
    assert httpx.get(f"{url}/v1/recordings", headers=bearer(OLD)).status_code == 401
    assert process.poll() is None


def bearer(text):
    return {"authorization": f"Bearer {text}"}


def read(url, text):
    """Ids of the recordings that a key may list."""
    answer = httpx.get(f"{url}/v1/recordings", headers=bearer(text), timeout=60)
    assert answer.status_code == 200, answer.text
    return sorted(one["recording_id"] for one in answer.json()["recordings"])
