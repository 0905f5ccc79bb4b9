"""Change detection of a store: revisions of all ids, polled cheaply by folder stamps."""

import os
import re
import time

from dextouch.episodes import COMMIT_FILE, EpisodeStore, Kind, disk_errors
from dextouch.schemas import ID_PATTERN

# Stamps of a file system can be this coarse: another change may get the same stamp.
SETTLED_NS = 2_000_000_000
# Listing a bucket takes one request per 1000 objects.
BUCKET_PERIOD_NS = 5_000_000_000

Revision = tuple[int, int]


class FolderChanges:
    """Detects changes of one kind of group with a single `stat` while there are none.

    Commits and deletions rename folders, which updates the parent folder's stamp. In-place changes
    by other programs are noticed only at the next commit or deletion. A bucket is listed at most
    once per BUCKET_PERIOD_NS, by ids only: an id that is deleted and written again in between goes
    unnoticed.
    """

    def __init__(self, store: EpisodeStore, kind: Kind) -> None:
        self._store, self._kind = store, kind
        self._folder = store.root / f"{kind}s"
        self._listed_ns: int | None = None
        self._stamp_ns: int | None = None
        self._is_settled = False

    def look(self) -> dict[str, Revision] | None:
        """Revisions by sorted id; None if nothing changed since the last call."""
        with disk_errors(f"list {self._folder.name}"):
            try:
                stamp_ns = self._folder.stat().st_mtime_ns
            except FileNotFoundError:
                self._stamp_ns = None
                return self._list()
            if self._is_settled and stamp_ns == self._stamp_ns:
                return None
            now_ns = time.time_ns()
            found = self._scan()
        self._stamp_ns, self._is_settled = stamp_ns, now_ns - stamp_ns > SETTLED_NS
        return found

    def _list(self) -> dict[str, Revision] | None:
        # Listing an empty folder is free; a bucket is not listed again at once.
        now_ns = time.monotonic_ns()
        if self._listed_ns is not None and now_ns - self._listed_ns < BUCKET_PERIOD_NS:
            return None
        found = dict.fromkeys(self._store.list(kind=self._kind), (0, 0))
        self._listed_ns = now_ns if found else None
        return found

    def _scan(self) -> dict[str, Revision]:
        found = {}
        # Plain names and one stat per id: thousands of Path objects would slow down a listing.
        for name in sorted(os.listdir(self._folder)):  # noqa: PTH208
            try:
                state = os.stat(f"{self._folder}/{name}/{COMMIT_FILE}")  # noqa: PTH116
            except (FileNotFoundError, NotADirectoryError):
                continue
            except PermissionError:
                # Reading it reports the error; a name that is not an id is not an episode.
                if re.fullmatch(ID_PATTERN, name):
                    found[name] = (0, 0)
                continue
            found[name] = (state.st_mtime_ns, state.st_ino)
        return found
