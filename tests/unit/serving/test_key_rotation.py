"""Keys are exchanged while a service runs: both are valid, then the new one alone."""

import json
import os
import signal
import sys

import httpx
import pytest
from pydantic import SecretStr
from structlog.testing import capture_logs

from dextouch.errors import InvalidInputError
from dextouch.serving import AccessControl, ServiceSettings, create_service_app, service_config
from dextouch.serving.keys import ApiKey
from dextouch.serving.running import reload_keys_at_hangup
from dextouch.serving.settings import load_settings
from services.dashboard.app import create_app
from services.dashboard.settings import DashboardSettings

OLD, NEW = "the old key, 5d1f9a0c", "the new key, 83b7e2d4"


class Probed(ServiceSettings):
    """Settings of a service in a file.

    Example:
      dextouch probe
    """

    model_config = service_config("probe")


def key(text, **fields):
    return {"name": "desk", "key": text, "scopes": ["store_write"]} | fields


def test_keys_of_one_name_allow_the_same():
    settings = ServiceSettings(api_keys=(key(OLD), key(NEW)))
    access = AccessControl(settings.api_keys)
    assert [access.check(f"Bearer {text}", "store_write") for text in (OLD, NEW)] == ["desk"] * 2
    for other in ({"scopes": ["store_read"]}, {"station": "desk-2"}):
        with pytest.raises(ValueError, match="'desk' with different scopes or stations"):
            ServiceSettings(api_keys=(key(OLD), key(NEW, **other)))


@pytest.fixture
def handler():
    before = signal.getsignal(signal.SIGHUP)
    yield
    signal.signal(signal.SIGHUP, before)


@pytest.fixture
def exchange(tmp_path, monkeypatch):
    """Write keys into the file of settings, and tell the service."""
    path = tmp_path / "dextouch.toml"
    path.touch()
    monkeypatch.setenv("DEXTOUCH_CONFIG", str(path))

    def write(*keys, raw=None):
        lines = "".join(f"[[probe.api_keys]]\n{_toml(one)}" for one in keys)
        path.write_text(lines if raw is None else raw)
        # Two changes within one tick of the file system's clock are told apart.
        os.utime(path, ns=(0, write.count))
        write.count += 1
        with capture_logs() as logs:
            signal.raise_signal(signal.SIGHUP)
        return logs

    write.count = 1
    return write


def _toml(fields):
    return "".join(f"{name} = {json.dumps(value)}\n" for name, value in fields.items())


async def test_a_running_service_gets_other_keys_at_sighup(handler, exchange, monkeypatch):
    monkeypatch.setattr(sys, "stdin", None)
    settings = ServiceSettings(api_keys=(key(OLD),))
    app = create_service_app(name="probe", settings=settings, routers=[])
    reload_keys_at_hangup(app, lambda: load_settings(Probed, []))
    access = app.state.access

    def valid():
        return [text for text in (OLD, NEW) if access.find(f"Bearer {text}")]

    (said,) = exchange(key(OLD), key(NEW))
    assert (said["event"], said["names"]) == ("keys_reloaded", ["desk"])
    assert valid() == [OLD, NEW]
    assert exchange(key(NEW))[0]["event"] == "keys_reloaded"
    assert valid() == [NEW]
    # Whatever is wrong with the file, the keys of before stay.
    wrong = [{"raw": "api_keys = "}, {"raw": "[probe]\nport = 70000\n"}, {"raw": ""}]
    for change in wrong:
        (said,) = exchange(**change)
        assert said["event"] == "keys_not_reloaded"
        assert valid() == [NEW]
    (said,) = exchange(key("1111111111111111"))
    assert "repeats itself" in said["reason"]
    assert "1111111111111111" not in said["reason"]


def test_at_a_terminal_the_service_ends_with_it(handler, monkeypatch):
    class Terminal:
        def isatty(self):
            return True

    monkeypatch.setattr(sys, "stdin", Terminal())
    before = signal.getsignal(signal.SIGHUP)
    app = create_service_app(name="probe", settings=ServiceSettings(), routers=[])
    reload_keys_at_hangup(app, ServiceSettings)
    assert signal.getsignal(signal.SIGHUP) == before


async def test_a_session_ends_with_its_key(tmp_path):
    keys = [ApiKey(name=name, key=SecretStr(text), scopes=("operate",)) for name, text in
            (("ada", OLD), ("ada", NEW))]  # fmt: skip
    app = create_app(DashboardSettings(api_keys=keys), {})
    transport = httpx.ASGITransport(app, client=("127.0.0.1", 4000))
    async with httpx.AsyncClient(transport=transport, base_url="http://localhost") as client:
        assert (await client.post("/sign_in", data={"key": OLD})).status_code == 303
        overview = "/v1/overview"
        assert (await client.get(overview)).status_code == 200
        app.state.access.set_keys(keys)
        assert (await client.get(overview)).status_code == 200
        # A key that leaked is exchanged for another one of its name.
        app.state.access.set_keys(keys[1:])
        assert (await client.get(overview)).status_code == 401


def test_a_service_neither_loses_nor_gets_its_first_key_while_it_runs(
    handler, exchange, monkeypatch
):
    monkeypatch.setattr(sys, "stdin", None)
    app = create_service_app(name="probe", settings=ServiceSettings(), routers=[])
    reload_keys_at_hangup(app, lambda: load_settings(Probed, []))
    (said,) = exchange(key(NEW))
    assert said["event"] == "keys_not_reloaded"
    assert not app.state.access.has_keys
    with pytest.raises(InvalidInputError):
        load_settings(Probed, ["--port", "x"])
