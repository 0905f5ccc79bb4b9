"""Services whose address cannot be used say so in one line, before anything is opened."""

import os
import socket

import pytest

from services.cli import main

SERVICES = {
    "store serve": "DEXTOUCH_EPISODE_STORE_PORT",
    "station serve": "DEXTOUCH_ACQUISITION_PORT",
    "align serve": "DEXTOUCH_ALIGNMENT_PORT",
    "twin serve": "DEXTOUCH_TWIN_PORT",
    "serve": "DEXTOUCH_WORLD_MODEL_PORT",
    "study serve": "DEXTOUCH_STUDIES_PORT",
    "rate serve": "DEXTOUCH_RATING_PORT",
    "dashboard": "DEXTOUCH_DASHBOARD_PORT",
}
KEY = '[{"name": "a", "key": "a-key-of-some-length", "scopes": ["store_read"]}]'


@pytest.fixture
def taken_port():
    with socket.socket() as taken:
        taken.bind(("127.0.0.1", 0))
        taken.listen()
        yield taken.getsockname()[1]


@pytest.fixture
def refusal(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)

    def run(*words):
        assert main.main([*words]) == main.EXIT_REFUSED
        assert list(tmp_path.iterdir()) == []
        told = capsys.readouterr()
        assert told.out == ""
        assert len(told.err.splitlines()) == 1
        return told.err

    return run


@pytest.mark.parametrize(("command", "variable"), SERVICES.items())
def test_a_taken_port_is_one_line_with_what_to_do(refusal, taken_port, command, variable):
    told = refusal(*command.split(), "--port", str(taken_port))
    assert f"cannot listen on 127.0.0.1:{taken_port}" in told
    assert "another program uses this port" in told
    assert f"--port (or {variable})" in told


@pytest.mark.parametrize("host", ["192.0.2.7", "no.such.host.invalid", "2001:db8::7", "a..b"])
def test_a_host_of_another_machine_is_one_line(refusal, host, monkeypatch):
    monkeypatch.setattr(socket, "getaddrinfo", None)
    told = refusal("store", "serve", "--host", host, "--api-keys", KEY)
    assert f"{host!r} is not an address of this machine" in told
    assert "127.0.0.1" in told


@pytest.mark.skipif(os.getuid() == 0, reason="root may use every port")
def test_a_port_that_needs_rights_is_one_line(refusal):
    assert "take one of 1024 or above" in refusal("store", "serve", "--port", "80")


def test_a_port_without_rights_is_told_as_such(refusal, monkeypatch):
    def refuse(*_):
        raise PermissionError(13, "Permission denied")

    monkeypatch.setattr(socket.socket, "bind", refuse)
    assert "take one of 1024 or above" in refusal("store", "serve", "--port", "80")
