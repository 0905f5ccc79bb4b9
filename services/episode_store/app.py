"""Settings in, the store's application out."""

from collections.abc import AsyncIterator
from contextlib import asynccontextmanager

import structlog
from fastapi import FastAPI

from dextouch import __version__
from dextouch.episodes import EpisodeStore
from dextouch.serving.app import create_service_app
from services.episode_store.catalog import Catalog
from services.episode_store.ingest import Ingest
from services.episode_store.reading import StoreReader
from services.episode_store.routes import episodes_router, recordings_router
from services.episode_store.settings import EpisodeStoreSettings

logger = structlog.get_logger(__name__)


def create_app(settings: EpisodeStoreSettings) -> FastAPI:
    """The routes over one store folder; what crashed writers left there is removed at the start.

    Args:
        settings: where the store is and what it allows.
    """
    store = EpisodeStore(settings.store_url)
    ingest = Ingest(store, sync=settings.sync_uploads, max_open_uploads=settings.max_open_uploads)
    catalog = Catalog(store)
    reader = StoreReader(
        store,
        max_window_steps=settings.max_window_steps,
        max_answer_bytes=settings.max_answer_bytes,
    )

    @asynccontextmanager
    async def lifespan(_: FastAPI) -> AsyncIterator[None]:
        removed = store.sweep()
        if removed:
            logger.info("removed_unfinished_writes", count=removed)
        try:
            yield
        finally:
            ingest.close()

    return create_service_app(
        name="episode_store",
        version=__version__,
        settings=settings,
        routers=[
            recordings_router(
                ingest=ingest, catalog=catalog, reader=reader, max_page=settings.max_page
            ),
            episodes_router(catalog=catalog, reader=reader, max_page=settings.max_page),
        ],
        lifespan=lifespan,
    )
