"""A folder that a service keeps its data in, which is never created anew behind its back.

A folder can be removed, unmounted or become read-only while a service runs. A new, empty one in its
place would look like a store that never held anything, and would hide the data of a disk that is
mounted over it later.
"""

import os
import weakref
from contextlib import suppress
from pathlib import Path
from typing import Final

from fastapi import Request

from dextouch.errors import UnavailableError

READING: Final = frozenset({"GET", "HEAD", "OPTIONS"})


class ServedFolder:
    """A folder that must stay the one that it was when the service started.

    `name` is that in messages, such as `store folder`; one that `is_written` is created at the
    start.
    """

    def __init__(self, path: Path, name: str, *, is_written: bool = True) -> None:
        self.path, self._name, self._is_written = path, name, is_written
        self._identity: tuple[int, int] | None = None
        self._is_open = False
        self._failure: str | None = None

    def open(self) -> None:
        """Create the folder if there is none, and remember which one it is; raises as `check`."""
        if self._is_written and not self._is_open and self._identity is None:
            try:
                self.path.mkdir(parents=True, exist_ok=True)
            except OSError as error:
                self._failure = (
                    f"{self._name} {self.path}: cannot be created ({error.strerror}); create it "
                    "where this user may write, or name another one"
                )
            else:
                self._is_open, self._failure = True, None
        self.check(writing=False)

    def problem(self, *, writing: bool) -> str | None:
        """What is wrong with the folder; None if it can be read, or also written if `writing`."""
        where = f"{self._name} {self.path}"
        try:
            found = self.path.stat()
        except OSError as error:
            if self._identity is None and not self._is_open:
                return self._failure
            return (
                f"{where}: is gone ({error.strerror}), and is not created anew; put it back or "
                "mount its disk"
            )
        identity = found.st_dev, found.st_ino
        if self._identity is None:
            self._identity = identity
            # Held until the end: the number of a removed folder could become that of a new one.
            with suppress(PermissionError):
                held = os.open(self.path, os.O_RDONLY | os.O_DIRECTORY)
                weakref.finalize(self, os.close, held)
        if identity != self._identity:
            return (
                f"{where}: is another folder than at the start; put the first one back or mount "
                "its disk, or restart the service to use this one"
            )
        # Asks the kernel, which also knows of file systems that are mounted read-only.
        if writing and self._is_written and not os.access(self.path, os.W_OK | os.X_OK):
            return f"{where}: is read-only; mount its disk for writing, or give this user access"
        return None

    def check(self, *, writing: bool) -> None:
        """Raise UnavailableError for a folder that is gone, another one, or read-only."""
        problem = self.problem(writing=writing)
        if problem is not None:
            raise UnavailableError(problem)

    async def required(self, request: Request) -> None:
        """Dependency of routes that use the folder; reading ones need no write access."""
        self.check(writing=request.method not in READING)
