"""A key in, the one lock of that key out, kept only while somebody wants it."""

import threading
from collections.abc import Iterator
from contextlib import contextmanager

from dextouch.errors import UnavailableError

RETRY_AFTER_S = 1


class KeyedLocks:
    """One lock a recording, so that no recording ever waits for another one.

    Args:
        patience_s: how long somebody waits for a recording that is being worked on.
    """

    def __init__(self, *, patience_s: float) -> None:
        self._patience_s = patience_s
        self._guard = threading.Lock()
        # Locks with the number of threads that hold or want them: unknown ids cost no memory.
        self._locks: dict[str, tuple[threading.Lock, int]] = {}

    @contextmanager
    def holding(self, key: str) -> Iterator[None]:
        """Be the only one who works on a key.

        Raises:
            UnavailableError: somebody else was at work all the time.
        """
        with self._guard:
            lock, num_users = self._locks.get(key, (threading.Lock(), 0))
            self._locks[key] = (lock, num_users + 1)
        try:
            if not lock.acquire(timeout=self._patience_s):
                raise UnavailableError(
                    f"{key}: still being worked on after {self._patience_s:g} s; try again later",
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
        """Whether somebody holds a key or waits for it."""
        with self._guard:
            return key in self._locks
