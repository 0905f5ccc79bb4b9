"""Settings: one class gives environment and flags, refuses what it does not know, and is frozen."""

import gc
import json
import re

import pytest
from pydantic import BaseModel, ValidationError

from dextouch.errors import InvalidInputError
from dextouch.serving import (
    ServiceSettings,
    create_service_app,
    load_settings,
    run,
    service_config,
)
from dextouch.serving.settings import is_loopback
from services.cli.up_settings import UpSettings

EVERYWHERE = "0.0.0.0"  # noqa: S104 - that keys are demanded there is what is tested


class ClassifierSettings(ServiceSettings):
    """Settings of a service that exists only here."""

    model_config = service_config("probe")

    rate_hz: float = 15.0


def test_flags_stand_above_the_environment(monkeypatch):
    monkeypatch.setenv("DEXTOUCH_PROBE_PORT", "8101")
    monkeypatch.setenv("DEXTOUCH_PROBE_RATE_HZ", "30")
    settings = load_settings(ClassifierSettings, ["--rate-hz", "60"])
    assert (settings.port, settings.rate_hz) == (8101, 60.0)


def test_an_empty_variable_counts_as_not_set(monkeypatch):
    monkeypatch.setenv("DEXTOUCH_PROBE_RATE_HZ", "")
    monkeypatch.setenv("DEXTOUCH_UP_STATION", "")
    assert load_settings(ClassifierSettings, []).rate_hz == 15.0
    assert load_settings(UpSettings, []).station == "mock station"


def test_a_variable_that_is_no_json_is_named(monkeypatch):
    monkeypatch.setenv("DEXTOUCH_PROBE_ALLOWED_HOSTS", "lab.example")
    with pytest.raises(InvalidInputError, match="variable DEXTOUCH_PROBE_ALLOWED_HOSTS is no JSON"):
        load_settings(ClassifierSettings, [])


def test_unknown_flags_are_refused(capsys):
    with pytest.raises(SystemExit) as caught:
        load_settings(ClassifierSettings, ["--colour", "red"])
    assert caught.value.code == 2
    assert "--colour" in capsys.readouterr().err


def test_wrong_values_are_named():
    with pytest.raises(InvalidInputError, match=r"port: .*65535"):
        load_settings(ClassifierSettings, ["--port", "99999"])


def test_open_addresses_need_keys(monkeypatch):
    with pytest.raises(InvalidInputError, match="not loopback"):
        load_settings(ClassifierSettings, ["--host", EVERYWHERE])
    monkeypatch.setenv(
        "DEXTOUCH_PROBE_API_KEYS", '[{"name": "a", "key": "a-key-of-some-length", "scopes": ["x"]}]'
    )
    settings = load_settings(ClassifierSettings, ["--host", EVERYWHERE])
    assert settings.api_keys[0].scopes == ("x",)
    assert "a-key-of-some-length" not in repr(settings)


@pytest.mark.parametrize(
    "name", ["192.168.1.5:8080", "desk.lab:80", "[fe80::1]", "fe80::1::2", "*", "", "a b", "café"]
)
def test_host_names_that_could_never_match_are_refused(name):
    with pytest.raises(InvalidInputError, match=r"allowed_hosts.*without its port"):
        load_settings(ClassifierSettings, ["--allowed-hosts", json.dumps([name])])


@pytest.mark.parametrize(
    "origin",
    [
        "lab.example",
        "https://lab.example/",
        "http://fe80::1",
        "http://[:::]",
        "http://a:99999",
        "*",
    ],
)
def test_origins_that_could_never_match_are_refused(origin):
    with pytest.raises(InvalidInputError, match=r"allowed_origins.*got .*, expected "):
        load_settings(ClassifierSettings, ["--allowed-origins", json.dumps([origin])])


def test_settings_are_frozen_and_closed():
    settings = ClassifierSettings()
    with pytest.raises(ValidationError, match="frozen"):
        settings.port = 1
    with pytest.raises(ValidationError, match="extra"):
        ClassifierSettings(colour="red")


@pytest.mark.parametrize(
    ("host", "expected"),
    [("127.0.0.1", True), ("::1", True), ("localhost", True), (EVERYWHERE, False), ("lab", False)],
)
def test_loopback(host, expected):
    assert is_loopback(host) is expected


class Station(BaseModel):
    """A nested group of settings."""

    rate_hz: float = 15.0


class CommandSettings(ServiceSettings):
    """Count what is there.

    Example:
      dextouch probe --num-steps 3
    """

    model_config = service_config("probe", "dextouch probe")

    num_steps: int = 1
    is_mock: bool = False
    names: tuple[str, ...] = ()
    station: Station = Station()


@pytest.mark.parametrize(
    "flags",
    [
        "--num-steps 3 --is-mock --names a --names b --station.rate-hz 2",
        "--num-steps 3 --is-mock --names a,b --station.rate-hz=2",
    ],
)
def test_flags_are_read(flags):
    settings = load_settings(CommandSettings, flags.split())
    assert (settings.num_steps, settings.is_mock) == (3, True)
    assert (settings.names, settings.station.rate_hz) == (("a", "b"), 2.0)


def test_help_names_the_command_and_shows_an_example(capsys):
    with pytest.raises(SystemExit, match="0"):
        load_settings(CommandSettings, ["--help"])
    text = capsys.readouterr().out
    assert text.startswith("usage: dextouch probe [-h]")
    assert "\nExample:\n  dextouch probe --num-steps 3\n" in text
    assert "--names NAME,…" in text
    assert "--is-mock, --no-is-mock" in text
    assert not re.search(r"--\S*_|tuple\[|null|factory", text)


def test_the_garbage_collector_leaves_out_what_a_service_starts_with(monkeypatch):
    frozen = []
    monkeypatch.setattr("uvicorn.Server.run", lambda _: frozen.append(gc.get_freeze_count()))
    before = gc.get_freeze_count()
    app = create_service_app(name="x", settings=ServiceSettings(), routers=[])
    with pytest.raises(SystemExit, match="3"):  # it did not start
        run(app, ServiceSettings())
    assert frozen[0] > before


@pytest.mark.parametrize(
    ("flag", "value", "told"),
    [
        ("--port", "29.97", "port: got '29.97', expected a whole number"),
        ("--port", "99999", "port: got '99999', expected at most 65535"),
        ("--port", "-1", "port: got '-1', expected at least 0"),
        ("--rate-hz", "fast", "rate_hz: got 'fast', expected a number"),
        ("--client-timeout-s", "0", "client_timeout_s: got '0', expected more than 0.0"),
        ("--log-level", "loud", "log_level: got 'loud', expected 'debug', 'info', 'warning' or"),
    ],
)
def test_a_wrong_value_is_told_with_what_is_expected(flag, value, told):
    with pytest.raises(InvalidInputError) as caught:
        load_settings(ClassifierSettings, [f"{flag}={value}"])
    assert told in caught.value.message
    assert "Input should" not in caught.value.message


def test_rates_that_are_no_whole_numbers_are_accepted():
    assert load_settings(ClassifierSettings, ["--rate-hz", "29.97"]).rate_hz == 29.97


def test_wrong_values_of_the_environment_and_the_file_are_told_alike(monkeypatch, tmp_path):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "dextouch.toml").write_text('[probe]\nport = 1.5\ncolour = "red"\n')
    with pytest.raises(InvalidInputError) as caught:
        load_settings(ClassifierSettings, [])
    assert "port: got 1.5, expected a whole number" in caught.value.message
    assert "colour: there is no such setting" in caught.value.message
    assert "dextouch.toml:2 [probe] port" in caught.value.message
    monkeypatch.setenv("DEXTOUCH_PROBE_PORT", "many")
    with pytest.raises(InvalidInputError, match="port: got 'many', expected a whole number"):
        load_settings(ClassifierSettings, [])


def test_a_wrong_value_that_may_be_secret_is_not_repeated(monkeypatch):
    keys = '[{"name": "a", "key": "short-one", "scopes": 7}, {"name": "b", "key": 1234567890123}]'
    monkeypatch.setenv("DEXTOUCH_PROBE_API_KEYS", keys)
    with pytest.raises(InvalidInputError) as caught:
        load_settings(ClassifierSettings, [])
    assert "short-one" not in caught.value.message
    assert "1234567890123" not in caught.value.message
