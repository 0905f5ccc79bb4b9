"""Background threads of a store: complete uploads to a bucket, drop uploads of deleted takes."""

import threading
from collections.abc import Callable
from typing import Final

import structlog

from dextouch.episodes import EpisodeStore
from dextouch.episodes.care import DeletionRecords
from dextouch.errors import DexTouchError

logger = structlog.get_logger(__name__)

# Chosen: an operator waits no longer after an outage, and a bucket that is away gets few requests.
RETRY_PERIOD_S: Final = 30.0
# How soon a deletion reaches an upload that nobody continues.
WATCH_PERIOD_S: Final = 1.0


class PeriodicThread:
    """Calls `work` again and again, between `start` and `stop`.

    A failure, such as a bucket that cannot be reached or a read-only folder, is logged as `event`
    when it begins or changes; the service still serves everything else.
    """

    def __init__(self, event: str, period_s: float) -> None:
        self._event, self._period_s = event, period_s
        self._stopping = threading.Event()
        self._thread = threading.Thread(target=self._run, name=event, daemon=True)

    def work(self) -> None:
        """What is done once a period."""
        raise NotImplementedError

    def start(self) -> None:
        """Begin in the background."""
        self._thread.start()

    def stop(self) -> None:
        """End the thread, after the work that is under way."""
        self._stopping.set()
        self._thread.join()

    def _run(self) -> None:
        problem = ""
        while not self._stopping.is_set():
            try:
                self.work()
                problem = ""
            except DexTouchError as error:
                if error.message != problem:
                    logger.error(self._event, reason=error.message)  # noqa: TRY400
                problem = error.message
            self._stopping.wait(self._period_s)


class PendingUploads(PeriodicThread):
    """Uploads what waits in a store's outbox, and removes the stages of killed writers once."""

    def __init__(self, store: EpisodeStore, *, period_s: float = RETRY_PERIOD_S) -> None:
        super().__init__("uploads_not_completed", period_s)
        self._store, self._is_swept = store, False

    def work(self) -> None:
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


class DeletionWatch(PeriodicThread):
    """Drops uploads of deleted takes that nobody continues, soon after the deletion.

    Args:
        records: of the store.
        drop: drops uploads of deleted takes, and returns their ids.
        ended: called with the id of each dropped upload.
    """

    def __init__(
        self, records: DeletionRecords, drop: Callable[[], list[str]], ended: Callable[[str], None]
    ) -> None:
        super().__init__("fail_deletions", WATCH_PERIOD_S)
        self._records, self._drop, self._ended = records, drop, ended
        self._revision = ""

    def work(self) -> None:
        """Drop uploads if there was a deletion since the last time."""
        revision = self._records.revision
        if revision != self._revision:
            for recording_id in self._drop():
                self._ended(recording_id)
            self._revision = revision
