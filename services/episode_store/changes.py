"""A store in, the revision of every committed id out, or word that nothing changed."""

import os
import re
import time

from dextouch.episodes import EpisodeStore
from dextouch.episodes.files import disk_errors
from dextouch.episodes.format import COMMIT_FILE, Kind
from dextouch.schemas.episodes import ID_PATTERN

# Stamps of a file system can be this coarse: a change as young may have a twin with its stamp.
SETTLED_NS = 2_000_000_000
# Listing a bucket takes a request for every thousand files in it.
BUCKET_PERIOD_NS = 5_000_000_000

Revision = tuple[int, int]


class FolderChanges:
    """Looks at one kind of a store with one `stat` while nothing comes or goes.

    Committing and deleting rename folders in and out, which sets the stamp of the folder above.
    What was changed in place behind the store's back shows at the next coming or going only.

    A store that is no folder is listed, at most once in BUCKET_PERIOD_NS, and by ids alone: one
    that is deleted and written again between two looks goes unnoticed there.
    """

    def __init__(self, store: EpisodeStore, kind: Kind) -> None:
        self._store, self._kind = store, kind
        self._folder = store.root / f"{kind}s"
        self._listed_ns: int | None = None
        self._stamp_ns: int | None = None
        self._is_settled = False

    def look(self) -> dict[str, Revision] | None:
        """Revisions by id, in order; None when nothing changed since the last look."""
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
        # An empty folder's list costs nothing; a bucket's is not asked for again at once.
        now_ns = time.monotonic_ns()
        if self._listed_ns is not None and now_ns - self._listed_ns < BUCKET_PERIOD_NS:
            return None
        found = dict.fromkeys(self._store.list(kind=self._kind), (0, 0))
        self._listed_ns = now_ns if found else None
        return found

    def _scan(self) -> dict[str, Revision]:
        found = {}
        # Plain names, one stat an id: thousands of Path objects would be in the way of a list.
        for name in sorted(os.listdir(self._folder)):  # noqa: PTH208
            try:
                state = os.stat(f"{self._folder}/{name}/{COMMIT_FILE}")  # noqa: PTH116
            except (FileNotFoundError, NotADirectoryError):
                continue
            except PermissionError:
                # Reading it says why; what has no id is no episode.
                if re.fullmatch(ID_PATTERN, name):
                    found[name] = (0, 0)
                continue
            found[name] = (state.st_mtime_ns, state.st_ino)
        return found
