"""One lock per key, kept only while it is in use."""

import threading
from collections.abc import Iterator
from contextlib import contextmanager
from weakref import WeakValueDictionary

from dextouch.errors import UnavailableError

RETRY_AFTER_S = 1


class KeyedLocks:
    """One lock per recording, so that recordings do not block each other."""

    def __init__(self, *, patience_s: float) -> None:
        self._patience_s = patience_s
        self._guard = threading.Lock()
        # Those who hold or wait for a lock keep it alive, so that unknown ids cost no memory.
        self._locks: WeakValueDictionary[str, threading.Lock] = WeakValueDictionary()

    @contextmanager
    def holding(self, key: str) -> Iterator[None]:
        """Context manager that holds the lock of a key.

        Raises:
            UnavailableError: the lock was not released in `patience_s`.
        """
        with self._guard:
            lock = self._locks.setdefault(key, threading.Lock())
        if not lock.acquire(timeout=self._patience_s):
            # The traceback would keep it alive.
            del lock
            raise UnavailableError(
                f"{key}: still locked after {self._patience_s:g} s; try again later",
                retry_after_s=RETRY_AFTER_S,
            )
        try:
            yield
        finally:
            lock.release()

    def is_wanted(self, key: str) -> bool:
        """Whether a key is locked or waited for."""
        return key in self._locks
