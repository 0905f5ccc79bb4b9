"""One lock per key, kept only while it is in use."""

import threading
from collections.abc import Iterator
from contextlib import contextmanager

from dextouch.errors import UnavailableError

RETRY_AFTER_S = 1


class KeyedLocks:
    """One lock per recording, so that recordings do not block each other."""

    def __init__(self, *, patience_s: float) -> None:
        self._patience_s = patience_s
        self._guard = threading.Lock()
        # Locks with their number of users, so that unknown ids cost no memory.
        self._locks: dict[str, tuple[threading.Lock, int]] = {}

    @contextmanager
    def holding(self, key: str) -> Iterator[None]:
        """Context manager that holds the lock of a key.

        Raises:
            UnavailableError: the lock was not released in `patience_s`.
        """
        with self._guard:
            lock, num_users = self._locks.get(key, (threading.Lock(), 0))
            self._locks[key] = (lock, num_users + 1)
        try:
            if not lock.acquire(timeout=self._patience_s):
                raise UnavailableError(
                    f"{key}: still locked after {self._patience_s:g} s; try again later",
                    retry_after_s=RETRY_AFTER_S,
                )
            try:
                yield
            finally:
                lock.release()
        finally:
            with self._guard:
                lock, num_users = self._locks[key]
                if num_users == 1:
                    del self._locks[key]
                else:
                    self._locks[key] = (lock, num_users - 1)

    def is_wanted(self, key: str) -> bool:
        """Whether a key is locked or waited for."""
        with self._guard:
            return key in self._locks
