"""sd_notify against a socket of the test, which plays systemd."""

import asyncio
import os
import socket

import pytest
import uvicorn

from dextouch.serving.app import create_service_app
from dextouch.serving.settings import ServiceSettings
from dextouch.serving.workers import DrainingServer, ServiceManager

LIMIT_S = 30.0


@pytest.fixture
def systemd(tmp_path):
    """A socket as systemd has it."""
    with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as receiver:
        receiver.bind(str(tmp_path / "notify"))
        receiver.settimeout(0)
        yield receiver


def environment(systemd, watchdog_s=0.1, **more):
    usec = str(round(watchdog_s * 1e6))
    return {"NOTIFY_SOCKET": systemd.getsockname(), "WATCHDOG_USEC": usec} | more


async def message(systemd):
    loop = asyncio.get_running_loop()
    return (await asyncio.wait_for(loop.sock_recv(systemd, 4096), LIMIT_S)).decode()


async def test_nothing_is_sent_without_a_manager():
    manager = ServiceManager({})
    manager.send("READY=1")
    await manager.feed_watchdog(lambda: pytest.fail("asked"))


async def test_a_watchdog_of_another_process_is_not_fed(systemd):
    manager = ServiceManager(environment(systemd, WATCHDOG_PID="1"))
    await manager.feed_watchdog(None)
    manager.send("READY=1")
    assert await message(systemd) == "READY=1"


async def test_an_abstract_socket_and_one_that_is_gone(systemd):
    with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as receiver:
        name = f"dextouch-test-{os.getpid()}"
        receiver.bind(f"\0{name}")
        receiver.settimeout(0)
        ServiceManager({"NOTIFY_SOCKET": f"@{name}"}).send("READY=1")
        assert await message(receiver) == "READY=1"
    ServiceManager({"NOTIFY_SOCKET": f"@{name}"}).send("READY=1")


async def test_the_watchdog_is_fed_only_while_work_goes_on(systemd):
    works = True
    asked = asyncio.Event()
    loop = asyncio.get_running_loop()

    def is_working():
        loop.call_soon_threadsafe(asked.set)
        return works

    manager = ServiceManager(environment(systemd, WATCHDOG_PID=str(os.getpid())))
    feeding = asyncio.create_task(manager.feed_watchdog(is_working))
    for _ in range(3):
        assert await message(systemd) == "WATCHDOG=1"
    works = False
    for _ in range(3):
        asked.clear()
        await asyncio.wait_for(asked.wait(), LIMIT_S)
    while True:
        try:
            systemd.recv(4096)
        except BlockingIOError:
            break
    asked.clear()
    await asyncio.wait_for(asked.wait(), LIMIT_S)
    with pytest.raises(BlockingIOError):
        systemd.recv(4096)
    works = True
    assert await message(systemd) == "WATCHDOG=1"
    feeding.cancel()


async def test_a_server_reports_when_its_port_is_open_and_when_it_stops(systemd, monkeypatch):
    for name, value in environment(systemd, watchdog_s=3600).items():
        monkeypatch.setenv(name, value)
    app = create_service_app(name="x", settings=ServiceSettings(), routers=[])
    config = uvicorn.Config(app, host="127.0.0.1", port=0, log_config=None)
    server = DrainingServer(config, drain=None, drain_s=0.0)
    serving = asyncio.create_task(server.serve())
    assert await message(systemd) == "READY=1"
    (listener,) = server.servers[0].sockets
    _, writer = await asyncio.open_connection(*listener.getsockname())
    writer.close()
    assert await message(systemd) == "WATCHDOG=1"
    server.should_exit = True
    assert await message(systemd) == "STOPPING=1"
    await serving
