"""When a draining server ends: after its time, at a second signal, or at once without a drain."""

import signal

import pytest
import uvicorn
from fastapi import FastAPI

from dextouch.serving.workers import DrainingServer


def server(drains, drain_s, *, has_drain=True):
    drain = (lambda: drains.append(True)) if has_drain else None
    return DrainingServer(uvicorn.Config(FastAPI(), log_config=None), drain=drain, drain_s=drain_s)


async def test_it_ends_after_its_time():
    for drain_s, is_over in ((0.0, True), (1e6, False)):
        drains = []
        made = server(drains, drain_s)
        assert not await made.on_tick(1)
        made.handle_exit(signal.SIGTERM, None)
        assert drains == [True]
        assert not made.should_exit
        assert await made.on_tick(1) is is_over
        assert drains == [True]


@pytest.mark.parametrize("second", [signal.SIGTERM, signal.SIGINT])
async def test_a_second_signal_ends_the_drain(second):
    drains = []
    made = server(drains, 1e6)
    made.handle_exit(signal.SIGTERM, None)
    made.handle_exit(second, None)
    assert drains == [True]
    assert await made.on_tick(1)


@pytest.mark.parametrize(
    ("signal_number", "has_drain"), [(signal.SIGINT, True), (signal.SIGTERM, False)]
)
async def test_ctrl_c_and_services_without_a_drain_end_at_once(signal_number, has_drain):
    drains = []
    made = server(drains, 1e6, has_drain=has_drain)
    made.handle_exit(signal_number, None)
    assert drains == []
    assert await made.on_tick(1)
