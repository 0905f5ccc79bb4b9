"""Settings in, the alignment service's application out."""

from collections.abc import AsyncIterator, Sequence
from contextlib import asynccontextmanager

from fastapi import FastAPI

from dextouch import __version__
from dextouch.episodes import EpisodeStore
from dextouch.serving.app import create_service_app
from services.alignment.job_table import JobTable
from services.alignment.routes import alignments_router
from services.alignment.settings import AlignmentSettings


def create_app(settings: AlignmentSettings) -> FastAPI:
    """The service; it reads recordings from and writes episodes to the store's folder."""
    jobs = JobTable(EpisodeStore(settings.store_url), settings)

    @asynccontextmanager
    async def lifespan(_: FastAPI) -> AsyncIterator[None]:
        await jobs.start()
        try:
            yield
        finally:
            await jobs.close()

    async def readiness() -> Sequence[str]:
        return jobs.waiting_for()

    return create_service_app(
        name="alignment",
        version=__version__,
        settings=settings,
        routers=[alignments_router(jobs)],
        lifespan=lifespan,
        readiness=readiness,
    )
