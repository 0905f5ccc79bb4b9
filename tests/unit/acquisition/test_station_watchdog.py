"""A station whose work stalls no longer counts as working, so that systemd restarts it."""

import threading

import httpx
import pytest

from services.acquisition import take as take_module
from services.acquisition.app import create_app
from services.acquisition.health import monitor as monitor_module
from services.acquisition.settings import AcquisitionSettings

PROMPT = {"task": "stack_bowls", "instruction": "stack the bowls"}
STALL_NS = 500_000_000
LIMIT_S = 30.0


@pytest.fixture(autouse=True)
def _short_limits(monkeypatch):
    monkeypatch.setattr(take_module, "STALL_NS", STALL_NS)
    monkeypatch.setattr(monitor_module, "STALL_NS", 20 * STALL_NS)


@pytest.fixture
async def station(tmp_path):
    """A running station with mock devices, which records."""
    settings = AcquisitionSettings(
        mock=True, mock_faults="none", spool=tmp_path / "spool", flush_period_s=0.1
    )
    app = create_app(settings)
    async with (
        app.router.lifespan_context(app),
        httpx.AsyncClient(
            transport=httpx.ASGITransport(app), base_url="http://localhost"
        ) as client,
    ):
        for action, body in (("arm", PROMPT), ("record", None)):
            answer = await client.post(f"/v1/recorder/{action}", json=body)
            assert answer.status_code == 200, answer.text
        yield app.state.is_working


def until(is_working, expected):
    waiting = threading.Event()
    for _ in range(round(LIMIT_S / 0.1)):
        if is_working() is expected:
            return
        waiting.wait(0.1)
    pytest.fail(f"is_working stayed {not expected}")


async def test_a_disk_that_blocks_the_flush_stalls_a_take(station, monkeypatch):
    until(station, expected=True)
    unblocked = threading.Event()
    monkeypatch.setattr(take_module.os, "fdatasync", lambda _: unblocked.wait(LIMIT_S))
    until(station, expected=False)
    unblocked.set()
    until(station, expected=True)


async def test_a_reader_that_blocks_in_its_write_stalls_a_take(station, monkeypatch):
    until(station, expected=True)
    unblocked = threading.Event()
    append = take_module.SpoolWriter.append_record

    def blocked(writer, record):
        unblocked.wait(LIMIT_S)
        return append(writer, record)

    monkeypatch.setattr(take_module.SpoolWriter, "append_record", blocked)
    until(station, expected=False)
    unblocked.set()
    until(station, expected=True)


async def test_a_health_evaluation_that_blocks_stalls_a_station(station, monkeypatch):
    until(station, expected=True)
    monkeypatch.setattr(monitor_module, "STALL_NS", STALL_NS)
    unblocked = threading.Event()
    kind = monitor_module.HealthMonitor
    monkeypatch.setattr(kind, "evaluate", lambda _: unblocked.wait(LIMIT_S))
    until(station, expected=False)
    unblocked.set()
