"""Application of the episode store, with its threads in the background."""

import threading
import time
from collections.abc import AsyncIterator, Callable, Sequence
from contextlib import asynccontextmanager
from functools import partial
from typing import Final

import structlog
from fastapi import FastAPI

from dextouch.episodes import EpisodeStore
from dextouch.episodes.maintenance import DeletionRecords
from dextouch.errors import DexTouchError
from dextouch.schemas import ObjectClicks
from dextouch.serving import ServedFolder, create_service_app, serve
from services.episode_store.catalog import Catalog
from services.episode_store.deletions import deletions_router
from services.episode_store.downloads import Downloads, downloads_router
from services.episode_store.ingest import Ingest
from services.episode_store.intake import Admission, StorageLimits, UploadMetrics
from services.episode_store.keys import Enrolments, enrolment_router
from services.episode_store.reading import content_router, playback_router
from services.episode_store.routes import (
    catalog_router,
    clicks_router,
    editing_router,
    idle_uploads_router,
    notes_router,
    reviews_router,
    trash_router,
    uploads_router,
)
from services.episode_store.settings import EpisodeStoreSettings

logger = structlog.get_logger(__name__)

ENROLMENTS_FILE = "enrolments.json"
# Chosen: an operator waits no longer after an outage, and a bucket that is away gets few requests.
RETRY_PERIOD_S: Final = 30.0
SWEEP_PERIOD_S: Final = 24 * 3600.0
# Chosen: of a sweep that failed, which lists the whole bucket.
SWEEP_RETRY_S: Final = 3600.0
TRASH_PERIOD_S: Final = 3600.0
# How soon a deletion reaches an upload that nobody continues.
WATCH_PERIOD_S: Final = 1.0


class PeriodicThread:
    """Calls `work` once a period from `start` on; `stop` waits for it, at most `patience_s`.

    A failure, such as a bucket that cannot be reached or a read-only folder, is logged as `event`
    when it begins or changes; the service still serves everything else.
    """

    def __init__(
        self,
        event: str,
        period_s: float,
        work: Callable[[], None],
        *,
        patience_s: float | None = None,
    ) -> None:
        self._event, self._period_s, self._work = event, period_s, work
        self._patience_s = patience_s
        self._stopping = threading.Event()
        self._thread = threading.Thread(target=self._run, name=event, daemon=True)

    def start(self) -> None:
        """Begin in the background."""
        self._thread.start()

    def stop(self) -> None:
        """End the thread, after the work that is under way."""
        self._stopping.set()
        self._thread.join(self._patience_s)

    def _run(self) -> None:
        problem = ""
        while not self._stopping.is_set():
            try:
                self._work()
                problem = ""
            except DexTouchError as error:
                if error.message != problem:
                    logger.error(self._event, reason=error.message)  # noqa: TRY400
                problem = error.message
            except Exception as error:
                # A mistake of ours, or of a driver, must not end the thread for good.
                if repr(error) != problem:
                    logger.exception(self._event)
                problem = repr(error)
            self._stopping.wait(self._period_s)


class PendingUploads(PeriodicThread):
    """Uploads what waits in a store's outbox, and sweeps the store once a day."""

    def __init__(self, store: EpisodeStore, *, period_s: float = RETRY_PERIOD_S) -> None:
        super().__init__("uploads_not_completed", period_s, self.work)
        self._store, self._sweep_at_s = store, 0.0

    def work(self) -> None:
        """Try once.

        Raises StorageError, UnavailableError: something failed and waits for the next time.
        """
        for kind, item_id in self._store.complete_uploads():
            logger.warning("upload_completed", kind=kind, id=item_id)
        if time.monotonic() >= self._sweep_at_s:
            self._sweep_at_s = time.monotonic() + SWEEP_RETRY_S
            removed = self._store.sweep()
            self._sweep_at_s = time.monotonic() + SWEEP_PERIOD_S
            if removed:
                logger.info("unfinished_writes_removed", count=removed)


def purge_old_trash(store: EpisodeStore, keep_days: float | None) -> None:
    """Permanently delete what has been in the trash of a store in a folder for some days."""
    if keep_days is not None and store.folders:
        for entry in store.purge(older_than_s=86_400.0 * keep_days):
            logger.info("trash_purged", kind=entry.kind, id=entry.item_id)


def deletion_watch(
    records: DeletionRecords, drop: Callable[[], list[str]], ended: Callable[[str], None]
) -> Callable[[], None]:
    """What drops uploads of deleted takes if there was a deletion since the last call.

    `drop` does so and returns their ids; `ended` is called with each.
    """
    known = ""

    def work() -> None:
        nonlocal known
        revision = records.revision
        if revision != known:
            for recording_id in drop():
                ended(recording_id)
            known = revision

    return work


def create_app(settings: EpisodeStoreSettings) -> FastAPI:
    """Create the application of one store; it clears up after killed writers."""
    store = EpisodeStore(settings.store_url)
    catalog = Catalog(store)
    objects = None if settings.objects is None else ObjectClicks.load(settings.objects)
    ingest = Ingest(store, settings)
    limits = StorageLimits(ingest.folder, settings, recordings=catalog.bytes_by_station)
    admission = Admission(
        max_requests=settings.max_batches_in_flight, max_bytes=settings.max_bytes_in_flight
    )
    metrics = UploadMetrics(limits, catalog.index.num_items)
    deletions = DeletionRecords(store.root)
    index = catalog.index
    threads = (
        PendingUploads(store),
        # Reading a large store takes minutes, and can be interrupted anywhere.
        PeriodicThread("catalog_not_checked", index.check_period_s, index.check, patience_s=2.0),
        PeriodicThread(
            "fail_deletions",
            WATCH_PERIOD_S,
            deletion_watch(deletions, ingest.drop_deleted, limits.end),
        ),
        PeriodicThread(
            "trash_not_purged",
            TRASH_PERIOD_S,
            partial(purge_old_trash, store, settings.keep_trash_days),
        ),
    )
    enrolments = Enrolments(settings.enrolments or store.root / ENROLMENTS_FILE)

    @asynccontextmanager
    async def lifespan(_: FastAPI) -> AsyncIterator[None]:
        for thread in threads:
            thread.start()
        try:
            yield
        finally:
            for thread in threads:
                thread.stop()
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
            editing_router(store, catalog),
            notes_router(store),
            content_router(store, settings),
            playback_router(store, settings),
            downloads_router(Downloads(store, settings)),
            trash_router(store, max_page=settings.max_page),
            deletions_router(deletions),
            enrolment_router(enrolments),
        ],
        lifespan=lifespan,
        folders=[ServedFolder(store.root, "store folder")],
    )
    enrolments.connect(app.state.access)
    app.state.registry.register(metrics.registry)
    return app


def main(argv: Sequence[str]) -> int:
    """Serve the store until SIGINT or SIGTERM."""
    return serve("episode_store", EpisodeStoreSettings, create_app, argv)
