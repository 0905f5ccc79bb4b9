"""Application and process that serve worlds over HTTP."""

from collections.abc import AsyncIterator, Mapping
from contextlib import asynccontextmanager
from typing import Any

from fastapi import FastAPI
from pydantic import Field

from dextouch.serving import ServiceSettings, configure_logging, create_service_app, open_state, run
from dextouch.worlds.rollouts import RolloutLimits, RolloutService
from dextouch.worlds.routes import rollout_router
from dextouch.worlds.world import World


class WorldServiceSettings(ServiceSettings):
    """Settings of a service of worlds; subclass to add those of a world."""

    state_url: str = Field(
        default="memory://",
        description="where rollouts are kept: memory:// or redis://HOST:PORT/DB",
    )
    limits: RolloutLimits = RolloutLimits()


def create_world_app(
    worlds: Mapping[str, World[Any]], settings: WorldServiceSettings, *, name: str = "worlds"
) -> FastAPI:
    """Create the application; its shutdown ends the worlds' threads."""
    store = open_state(settings.state_url)
    service = RolloutService(worlds, store, settings.limits)

    @asynccontextmanager
    async def lifespan(_: FastAPI) -> AsyncIterator[None]:
        yield
        service.close()
        await store.close()

    async def readiness() -> list[str]:
        await service.ping()
        return []

    return create_service_app(
        name=name,
        settings=settings,
        routers=[rollout_router(service)],
        lifespan=lifespan,
        readiness=readiness,
    )


def serve_worlds(
    worlds: Mapping[str, World[Any]], settings: WorldServiceSettings, *, name: str = "worlds"
) -> None:
    """Serve worlds until SIGINT or SIGTERM."""
    configure_logging(service=name, log_format=settings.log_format, level=settings.log_level)
    run(create_world_app(worlds, settings, name=name), settings)
