"""How much is being written and how much room is left in, a refusal or nothing out."""

import os
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path

from dextouch.episodes.files import disk_errors
from dextouch.errors import LimitExceededError, StorageFullError

BUSY_RETRY_S = 1
FULL_RETRY_S = 30


class Admission:
    """Bounds the batches that are in the service at once, by number and by bytes.

    A batch is admitted before its body is read, so what is refused costs no memory.

    Args:
        max_requests: batches at once.
        max_bytes: of all their bodies together; one batch alone always fits.
    """

    def __init__(self, *, max_requests: int, max_bytes: int) -> None:
        self._max_requests, self._max_bytes = max_requests, max_bytes
        self._num_requests = self._num_bytes = 0
        self._guard = threading.Lock()

    @contextmanager
    def admitted(self, num_bytes: int) -> Iterator[None]:
        """Be counted while a body of this size is read and written.

        Raises:
            LimitExceededError: with `retry_after_s`, so the answer is 429.
        """
        with self._guard:
            full = self._num_requests >= self._max_requests or (
                self._num_requests and self._num_bytes + num_bytes > self._max_bytes
            )
            if full:
                raise LimitExceededError(
                    f"store is busy: {self._num_requests} batches with {self._num_bytes} bytes "
                    f"are being written, allowed are {self._max_requests} and {self._max_bytes}; "
                    f"send the batch again in {BUSY_RETRY_S} s",
                    reason="busy",
                    retry_after_s=BUSY_RETRY_S,
                )
            self._num_requests += 1
            self._num_bytes += num_bytes
        try:
            yield
        finally:
            with self._guard:
                self._num_requests -= 1
                self._num_bytes -= num_bytes


def free_bytes_of(folder: Path) -> int:
    """Bytes that may still be written below a folder, which need not exist yet."""
    with disk_errors(f"measure free space of {folder}"):
        while not folder.exists():
            folder = folder.parent
        state = os.statvfs(folder)
    return state.f_bavail * state.f_frsize


class DiskReserve:
    """Keeps space free that uploads do not take, so that nothing breaks off half written.

    Args:
        folder: on the disk in question.
        min_free_bytes: that stay free.
        free_bytes: another way to measure; None asks the file system.
    """

    def __init__(
        self,
        folder: Path,
        *,
        min_free_bytes: int,
        free_bytes: Callable[[Path], int] | None = None,
    ) -> None:
        self._folder, self._min_free = folder, min_free_bytes
        self._measure = free_bytes

    def free_bytes(self) -> int:
        """What is free now, the reserve included."""
        return (self._measure or free_bytes_of)(self._folder)

    def check_upload(self, num_bytes: int) -> None:
        """Refuse bytes that would go into the reserve.

        Raises:
            StorageFullError: with `retry_after_s`; nothing was written.
        """
        self._check(num_bytes, self._min_free, "upload")

    def check_commit(self, num_bytes: int) -> None:
        """Refuse a copy that does not fit at all; it may use the reserve, for its source goes then.

        Raises:
            StorageFullError: with `retry_after_s`; nothing was written.
        """
        self._check(num_bytes, 0, "finish")

    def _check(self, num_bytes: int, reserve: int, what: str) -> None:
        free = self.free_bytes()
        if free - num_bytes < reserve:
            raise StorageFullError(
                f"{what}: {num_bytes} bytes do not fit, {free} bytes are free and {reserve} stay "
                "so; what was acknowledged is kept, free space on the store's disk",
                reason="disk",
                got=free,
                expected=reserve + num_bytes,
                retry_after_s=FULL_RETRY_S,
            )
