"""Services run on uvloop, however they are started, and on versions that were tested."""

import asyncio
import re
import tomllib
from importlib.metadata import version
from pathlib import Path

import httpx
import pytest
from fastapi import APIRouter
from packaging.requirements import Requirement

from dextouch.serving import ServiceSettings, create_service_app
from services.pipelines.servers import bind, run_on_event_loop, serve_all, served


@pytest.fixture
def app():
    router = APIRouter()

    @router.get("/v1/loop")
    async def loop() -> str:
        return type(asyncio.get_running_loop()).__module__

    return create_service_app(name="probe", settings=ServiceSettings(), routers=[router])


def test_services_in_threads_run_on_uvloop(app):
    with served({"probe": app}) as urls:
        assert httpx.get(f"{urls['probe']}/v1/loop", trust_env=False).json() == "uvloop"


def test_all_services_of_up_run_on_uvloop(app):
    place, answers = bind("probe", host="127.0.0.1", port=0), []

    async def main():
        stop, ready = asyncio.Event(), asyncio.Event()
        serving = asyncio.create_task(serve_all([(place, app)], stop=stop, on_ready=ready.set))
        await ready.wait()
        async with httpx.AsyncClient(trust_env=False) as client:
            answers.append((await client.get(f"{place.url}/v1/loop")).json())
        stop.set()
        await serving

    run_on_event_loop(main())
    assert answers == ["uvloop"]


@pytest.mark.parametrize("name", ["uvicorn", "websockets"])
def test_versions_that_were_not_tested_are_not_installed(name):
    # Limits of connections subclass and set what is not public and may change in any release.
    text = (Path(__file__).parents[3] / "pyproject.toml").read_text(encoding="utf-8")
    asked = map(Requirement, tomllib.loads(text)["project"]["optional-dependencies"]["serve"])
    (wanted,) = [one.specifier for one in asked if one.name == name]
    assert wanted.contains(version(name))
    major, minor = map(int, re.match(r"(\d+)\.(\d+)", version(name)).groups())
    assert not wanted.contains(f"{major}.{minor + 1}.0")
