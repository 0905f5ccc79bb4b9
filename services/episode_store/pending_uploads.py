"""Completes uploads to a bucket that failed or were interrupted, while the service runs."""

import threading
from typing import Final

import structlog

from dextouch.episodes import EpisodeStore
from dextouch.errors import DexTouchError

logger = structlog.get_logger(__name__)

# Chosen: an operator waits no longer after an outage, and a bucket that is away gets few requests.
RETRY_PERIOD_S: Final = 30.0


class PendingUploads:
    """Uploads what waits in the outbox of a store, and removes the stages of killed writers once.

    Failures, such as a bucket that cannot be reached or a read-only folder, are logged when they
    begin or change; the service still serves everything else.
    """

    def __init__(self, store: EpisodeStore, *, period_s: float = RETRY_PERIOD_S) -> None:
        self._store, self._period_s = store, period_s
        self._is_swept = False
        self._problem = ""
        self._stopping = threading.Event()
        self._thread = threading.Thread(target=self._run, name="pending-uploads", daemon=True)

    def start(self) -> None:
        """Begin in the background."""
        self._thread.start()

    def stop(self) -> None:
        """End the thread, after an upload that is under way."""
        self._stopping.set()
        self._thread.join()

    def try_all(self) -> None:
        """Try once.

        Raises:
            StorageError, UnavailableError: something failed and waits for the next time.
        """
        for kind, item_id in self._store.complete_uploads():
            logger.warning("upload_completed", kind=kind, id=item_id)
        if not self._is_swept:
            removed = self._store.sweep()
            self._is_swept = True
            if removed:
                logger.info("unfinished_writes_removed", count=removed)

    def _run(self) -> None:
        while not self._stopping.is_set():
            try:
                self.try_all()
                self._problem = ""
            except DexTouchError as error:
                if error.message != self._problem:
                    logger.error("uploads_not_completed", reason=error.message)  # noqa: TRY400
                self._problem = error.message
            self._stopping.wait(self._period_s)
