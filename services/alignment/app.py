"""The FastAPI application of the alignment service."""

import asyncio
from collections.abc import AsyncIterator, Sequence
from contextlib import asynccontextmanager

from fastapi import FastAPI

from dextouch.episodes import EpisodeStore
from dextouch.serving import create_service_app, serve
from services.alignment.job_runner import JobRunner
from services.alignment.new_recordings import NewRecordings
from services.alignment.routes import alignments_router
from services.alignment.settings import AlignmentSettings


def create_app(settings: AlignmentSettings) -> FastAPI:
    """Create the service, which reads recordings from a store and writes episodes to it."""
    store = EpisodeStore(settings.store_url)
    jobs = JobRunner(store, settings)

    @asynccontextmanager
    async def lifespan(_: FastAPI) -> AsyncIterator[None]:
        await jobs.start()
        watch = None
        if settings.align_new:
            look = NewRecordings(store, jobs).watch(settings.period_s)
            watch = asyncio.create_task(look)
        try:
            yield
        finally:
            if watch is not None:
                watch.cancel()
                await asyncio.gather(watch, return_exceptions=True)
            await jobs.close()

    async def readiness() -> Sequence[str]:
        return [] if jobs.is_warm else ["solver"]

    return create_service_app(
        name="alignment",
        settings=settings,
        routers=[alignments_router(jobs)],
        lifespan=lifespan,
        readiness=readiness,
    )


def main(argv: Sequence[str]) -> int:
    """Serve the alignment service until SIGINT or SIGTERM."""
    return serve("alignment", AlignmentSettings, create_app, argv)
