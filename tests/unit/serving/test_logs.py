"""Logging: one JSON line an event in a container, also for the standard library's loggers."""

import json
import logging

import pytest
import structlog

from dextouch.serving import configure_logging


@pytest.fixture
def lines(capsys):
    """What is written to stderr, as lines."""

    def written() -> list[str]:
        return capsys.readouterr().err.splitlines()

    return written


def test_events_and_foreign_records_are_json_lines(lines):
    configure_logging(service="twin", log_format="auto", level="info")
    structlog.get_logger("a").info("rollout_started", rollout_id="r1", duration_ns=5)
    logging.getLogger("uvicorn.error").warning("foreign %s", "text")
    structlog.get_logger("a").debug("hidden")
    first, second = [json.loads(line) for line in lines()]
    assert first["event"] == "rollout_started"
    assert (first["service"], first["level"], first["rollout_id"]) == ("twin", "info", "r1")
    assert first["timestamp"].endswith("Z")
    assert (second["event"], second["logger"]) == ("foreign text", "uvicorn.error")


def test_an_exception_is_one_line_with_its_trace(lines):
    configure_logging(service="twin", log_format="json", level="info")
    try:
        int("seven")
    except ValueError:
        structlog.get_logger("a").exception("step_failed")
    (line,) = lines()
    assert "ValueError: invalid literal" in json.loads(line)["exception"]


def test_console_format_is_for_people(lines):
    configure_logging(service="twin", log_format="console", level="debug")
    structlog.get_logger("a").debug("rollout_started", rollout_id="r1")
    (line,) = lines()
    assert "rollout_started" in line
    assert not line.startswith("{")
