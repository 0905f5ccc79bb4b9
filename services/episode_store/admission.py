"""Admission control: limits of concurrent batches and of free disk space."""

import os
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from dextouch.episodes import disk_errors
from dextouch.errors import LimitExceededError, StorageFullError

BUSY_RETRY_S = 1
FULL_RETRY_S = 30


class Admission:
    """Limits the batches in flight, by number and by the bytes of their bodies (backpressure).

    A batch is admitted before its body is read, so a refused one costs no memory. A single batch is
    always admitted.
    """

    def __init__(self, *, max_requests: int, max_bytes: int) -> None:
        self._max_requests, self._max_bytes = max_requests, max_bytes
        self._num_requests = self._num_bytes = 0
        self._guard = threading.Lock()

    @contextmanager
    def admitted(self, num_bytes: int) -> Iterator[None]:
        """Context manager that counts a body of this size while it is read and written.

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
    """Free disk space at a folder, which need not exist yet."""
    with disk_errors(f"measure free space of {folder}"):
        while not folder.exists():
            folder = folder.parent
        state = os.statvfs(folder)
    return state.f_bavail * state.f_frsize


class DiskReserve:
    """Reserves space on a folder's disk that uploads must not use, so that writes can finish."""

    def __init__(self, folder: Path, *, min_free_bytes: int) -> None:
        self._folder, self._min_free = folder, min_free_bytes

    def free_bytes(self) -> int:
        """Free bytes, including the reserve."""
        return free_bytes_of(self._folder)

    def check_upload(self, num_bytes: int) -> None:
        """Refuse an upload that would use the reserve.

        Raises:
            StorageFullError: with `retry_after_s`; nothing was written.
        """
        self._check(num_bytes, self._min_free, "upload")

    def check_commit(self, num_bytes: int) -> None:
        """Refuse a commit that exceeds the free space; it may use the reserve.

        Raises:
            StorageFullError: with `retry_after_s`; nothing was written.
        """
        self._check(num_bytes, 0, "finish")

    def _check(self, num_bytes: int, reserve: int, what: str) -> None:
        free = self.free_bytes()
        if free - num_bytes < reserve:
            raise StorageFullError(
                f"{what}: {num_bytes} bytes exceed the {free} free bytes ({reserve} reserved); "
                "acknowledged batches are kept, free space on the store's disk",
                reason="disk",
                got=free,
                expected=reserve + num_bytes,
                retry_after_s=FULL_RETRY_S,
            )
