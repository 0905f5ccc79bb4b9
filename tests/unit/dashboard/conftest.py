"""A dashboard on fake services."""

import importlib.util
import sys
from pathlib import Path

import httpx
import pytest

from services.dashboard.app import create_app
from services.dashboard.settings import DashboardSettings

# importlib mode has no test packages: load the fakes beside this file by path, once.
_SPEC = importlib.util.spec_from_file_location(
    "dashboard_fakes", Path(__file__).with_name("fakes.py")
)
fakes = importlib.util.module_from_spec(_SPEC)
sys.modules["dashboard_fakes"] = fakes
_SPEC.loader.exec_module(fakes)


@pytest.fixture
def services():
    return fakes.FakeServices()


@pytest.fixture
def upstreams(services):
    return {name: services.upstream(name) for name in ("acquisition", "episode_store")}


@pytest.fixture
def make_app(upstreams):
    def make(**settings):
        return create_app(DashboardSettings(**settings), upstreams)

    return make


@pytest.fixture
async def client(make_app):
    transport = httpx.ASGITransport(app=make_app())
    async with httpx.AsyncClient(transport=transport, base_url="http://127.0.0.1") as client:
        yield client
