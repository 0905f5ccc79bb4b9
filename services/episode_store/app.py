"""Application of the episode store."""

import threading
from collections.abc import AsyncIterator, Sequence
from contextlib import asynccontextmanager

import structlog
from fastapi import FastAPI

from dextouch.episodes import EpisodeStore
from dextouch.episodes.care import DeletionRecords
from dextouch.errors import DexTouchError
from dextouch.schemas import load_object_clicks
from dextouch.serving import ServedFolder, create_service_app, serve
from services.episode_store.background import DeletionWatch, PendingUploads
from services.episode_store.catalog import Catalog
from services.episode_store.deletions import deletions_router
from services.episode_store.ingest import Ingest
from services.episode_store.intake import Admission, StorageLimits, UploadMetrics
from services.episode_store.keys import Enrolments, enrolment_router
from services.episode_store.reading import content_router, playback_router
from services.episode_store.routes import (
    catalog_router,
    clicks_router,
    idle_uploads_router,
    reviews_router,
    trash_router,
    uploads_router,
)
from services.episode_store.settings import EpisodeStoreSettings

logger = structlog.get_logger(__name__)

ENROLMENTS_FILE = "enrolments.json"


def create_app(settings: EpisodeStoreSettings) -> FastAPI:
    """Create the application of one store; it clears up after killed writers."""
    store = EpisodeStore(settings.store_url)
    catalog = Catalog(store)
    objects = None if settings.objects is None else load_object_clicks(settings.objects)
    ingest = Ingest(store, settings)
    limits = StorageLimits(ingest.folder, settings, recordings=catalog.bytes_by_station)
    admission = Admission(
        max_requests=settings.max_batches_in_flight, max_bytes=settings.max_bytes_in_flight
    )
    metrics = UploadMetrics()
    deletions = DeletionRecords(store.root)
    watch = DeletionWatch(deletions, ingest.drop_deleted, limits.end)
    pending = PendingUploads(store)
    enrolments = Enrolments(settings.enrolments or store.root / ENROLMENTS_FILE)

    @asynccontextmanager
    async def lifespan(_: FastAPI) -> AsyncIterator[None]:
        pending.start()
        # The first listing of a large store takes seconds, so it is warmed up in the background.
        threading.Thread(target=_warm_up, args=(catalog,), name="warm-up", daemon=True).start()
        watch.start()
        try:
            yield
        finally:
            pending.stop()
            watch.stop()
            ingest.close()

    app = create_service_app(
        name="episode_store",
        settings=settings,
        routers=[
            uploads_router(ingest, limits, admission, metrics),
            idle_uploads_router(ingest, limits),
            catalog_router(catalog, max_page=settings.max_page),
            reviews_router(catalog),
            clicks_router(store, catalog, objects),
            content_router(store, settings),
            playback_router(store, settings),
            trash_router(store, max_page=settings.max_page),
            deletions_router(deletions),
            enrolment_router(enrolments),
        ],
        lifespan=lifespan,
        folders=[ServedFolder(store.root, "store folder")],
    )
    enrolments.connect(app.state.access)
    metrics.register(app.state.registry, limits, catalog.num_items())
    return app


def _warm_up(catalog: Catalog) -> None:
    try:
        catalog.warm_up()
    except DexTouchError as error:
        logger.warning("warm_up_failed", reason=error.message)


def main(argv: Sequence[str]) -> int:
    """Serve the store until SIGINT or SIGTERM."""
    return serve("episode_store", EpisodeStoreSettings, create_app, argv)
