"""Index of a store's items: rows that looks at the store bring up to date, for all processes.

What is noticed when:

- a look, before each query: items that were committed, deleted, restored or replaced. It costs one
  `stat` while the folder of a kind is unchanged, one listing without a `stat` of each item
  otherwise; a look that lists the same although the folder changed is a check: numbers of folders
  are used again. In a bucket, at most once per BUCKET_PERIOD_NS, it lists the changes that programs
  have announced, and looks at items of new ones. All ids are listed where no change was announced,
  as in a bucket that earlier releases wrote, and once per BUCKET_CHECK_PERIOD_S;
- a check: also reviews and clicks by other processes, files of an item that were exchanged or
  edited by hand (time, size, inode; in a bucket the entity tag), and items of a bucket that were
  deleted and written again, and those that could not be read at the last one. Each process checks
  at its first look, the service also once per `check_period_s`, and in a folder of at most
  ALWAYS_CHECKED items each look that lists it.
"""

import hashlib
import json
import sqlite3
import threading
import time
from collections.abc import Callable, Iterable, Mapping
from functools import partial
from itertools import islice
from typing import Final, TypeVar

import structlog

from dextouch.episodes import COMMIT_FILE, KINDS, EpisodeStore, GroupFingerprint, Kind, disk_errors
from dextouch.errors import CorruptDataError, DexTouchError, NotFoundError, StorageError
from services.episode_store.catalog_file import (
    CatalogFile,
    check_file,
    is_unusable,
    snapshot,
    transaction,
)
from services.episode_store.catalog_rows import (
    read_remarks,
    read_row,
    relink,
    write_remarks,
    write_row,
)

logger = structlog.get_logger(__name__)

T = TypeVar("T")
# Stamps of a file system can be this coarse: another change may get the same stamp.
SETTLED_NS: Final = 2_000_000_000
# Listing changes or ids of a bucket takes one request per 1000, checking it one per 1000 objects.
BUCKET_PERIOD_NS: Final = 5_000_000_000
BUCKET_CHECK_PERIOD_S: Final = 600.0
# Chosen: 10,000 items take 0.1 s of a processor.
CHECK_PERIOD_S: Final = 60.0
# Chosen: so many items are compared in 6 ms.
ALWAYS_CHECKED: Final = 500
# Items of one transaction: others can write in between, and a kill loses little.
BATCH: Final = 200
# Whether rows were changed that do not fit each other yet.
_IS_DIRTY: Final = """SELECT EXISTS (SELECT 1 FROM item WHERE is_dirty)
  OR EXISTS (SELECT 1 FROM grp WHERE is_stale)"""
# A fingerprint as it is in a row; of many rows, names of its parts would take as long as the query.
Known = tuple[int, str, str]
_NONE: Final[Known] = (-1, "", "")
Progress = Callable[[list[str], str, int], Iterable[str]]
Write = Callable[[sqlite3.Connection], None]


class CatalogIndex:
    """The rows of a store's items; thread-safe.

    An item that cannot be read is omitted until the next check, and logged once by each process;
    `verify` reports damage. `progress` shows how many of many items were read.
    """

    def __init__(self, store: EpisodeStore, progress: Progress | None = None) -> None:
        self._store, self._is_local = store, bool(store.folders)
        self.check_period_s = CHECK_PERIOD_S if self._is_local else BUCKET_CHECK_PERIOD_S
        tag = "" if self._is_local else hashlib.sha256(store.url.encode()).hexdigest()[:8]
        self._file = CatalogFile(store.root, tag)
        self._progress = progress or (lambda items, _what, _total: items)
        self._guard = threading.RLock()
        # Of this connection: fingerprints of the rows and of omitted items, and when it looked; a
        # mark is forgotten where something is left to the next look.
        self._known: dict[Kind, dict[str, Known]] = {kind: {} for kind in KINDS}
        self._omitted: dict[Kind, dict[str, GroupFingerprint]] = {kind: {} for kind in KINDS}
        self._stale: set[Kind] = set()
        self._is_checked: dict[Kind, bool] = dict.fromkeys(KINDS, False)
        self._marks: dict[Kind, int | None] = dict.fromkeys(KINDS, None)
        self._listed: dict[Kind, tuple[int, Mapping[str, int]]] = {kind: (0, {}) for kind in KINDS}
        # Of a bucket.
        self._looked_ns: int | None = None
        self._reported: set[tuple[Kind, str, str]] = set()
        self._data_version = 0

    def num_items(self, kind: Kind) -> int:
        """Items at the last look, without another one."""
        return len(self._known[kind])

    def read(self, query: Callable[[sqlite3.Connection], T], kind: Kind | None = None) -> T:
        """The result of a query, after a look at the store.

        With a `kind` only at its items, for what others do not change.
        """

        def look_and_read(connection: sqlite3.Connection) -> T:
            self._look(connection, KINDS if kind is None else (kind,))
            if kind is not None:
                return query(connection)
            with snapshot(connection):
                (is_dirty,) = connection.execute(_IS_DIRTY).fetchone()
                if not is_dirty:
                    return query(connection)
            # What was changed, or a check, a killed process or an erasure has left to do.
            with transaction(connection):
                relink(connection)
                return query(connection)

        return self._run(look_and_read)

    def check(self) -> None:
        """Compare all items with their rows; others may read meanwhile."""
        for kind in KINDS:
            known = dict(self._run(partial(self._rows, kind=kind)))
            current = self._store.fingerprints(self._store.folder_numbers(kind=kind), kind=kind)
            self._run(partial(self._apply, kind=kind, before=known, current=current, again=True))
            with self._guard:
                self._sort(kind, current)
            self._is_checked[kind] = True
        if not self._is_local:
            self._run(partial(_note, names=("listed", "checked")))

    def reread(self, kind: Kind, item_id: str) -> None:
        """Take over remarks on an item that were changed just now."""

        def reread(connection: sqlite3.Connection) -> None:
            if (before := self._rows(connection, kind).get(item_id)) is not None:
                self._compare_some(connection, kind, {item_id: before[0]})

        self._run(reread)

    def verify(self) -> list[str]:
        """What is wrong with the file: damage, and rows of other content than their items."""
        rows = self.read(lambda c: c.execute("SELECT kind, id, sha256 FROM item").fetchall())
        path, problems = self._file.path, []
        if path is not None and (damage := check_file(path)):
            problems.append(f"is damaged ({damage})")
        for kind, name, sha256 in rows:
            try:
                commit = self._store.files(name, kind=kind).get_now(COMMIT_FILE) or b"{}"
                if json.loads(commit).get("sha256") != sha256:
                    problems.append(f"has a row of {kind} {name} that is not of its content")
            except (DexTouchError, ValueError):
                # Deleted or damaged meanwhile: the next look or check finds that.
                continue
        advice = f"; remove the folder {path.parent}, it is made anew" if path else ""
        return [f"catalog {problem}{advice}" for problem in problems]

    def _run(self, work: Callable[[sqlite3.Connection], T]) -> T:
        """Work on the rows, and again after a file that cannot be used was given up."""
        with self._guard:
            for is_last in (False, False, True):
                try:
                    return work(self._connection())
                except sqlite3.Error as error:
                    if is_last or not is_unusable(error):
                        raise
                    self._file.give_up(error)
        raise AssertionError("unreachable")

    def _connection(self) -> sqlite3.Connection:
        """A connection; `_rows` are read again if another one has written."""
        connection, is_new = self._file.connection()
        (version,) = connection.execute("PRAGMA data_version").fetchone()
        if is_new:
            self._is_checked = dict.fromkeys(KINDS, False)
            self._marks, self._looked_ns = dict.fromkeys(KINDS, None), None
        if is_new or version != self._data_version:
            self._stale.update(KINDS)
        self._data_version = version
        return connection

    def _rows(self, connection: sqlite3.Connection, kind: Kind) -> dict[str, Known]:
        """The fingerprints that are in the rows of a kind now."""
        if kind in self._stale:
            text = "SELECT id, folder, content, remarks FROM item WHERE kind = ?"
            rows = connection.execute(text, (kind,))
            known: dict[str, Known] = {row[0]: row[1:] for row in rows}
            if self._known[kind].keys() - known.keys():
                # An erasure removes rows of items that stay.
                self._marks[kind] = None
            self._known[kind] = known
            self._stale.remove(kind)
        return self._known[kind]

    def _look(self, connection: sqlite3.Connection, kinds: Iterable[Kind]) -> None:
        """Find what changed since the last look; see the module."""
        if not self._is_local:
            self._look_at_bucket(connection)
            return
        for kind in kinds:
            # Before the listing: what changes meanwhile is found by the next look.
            mark, known = self._mark(kind), self._rows(connection, kind)
            is_check = not self._is_checked[kind]
            if mark == self._marks[kind] and not is_check:
                continue
            found = self._store.folder_numbers(kind=kind)
            last_mark, last_found = self._listed[kind]
            is_odd = mark != last_mark and found == last_found
            self._listed[kind] = mark, found
            is_check = is_check or is_odd or len(known) <= ALWAYS_CHECKED
            is_done = self._compare(connection, kind, found, is_check=is_check)
            is_settled = time.time_ns() - mark > SETTLED_NS
            self._marks[kind] = mark if is_settled and is_done else None

    def _compare(
        self,
        connection: sqlite3.Connection,
        kind: Kind,
        found: Mapping[str, int],
        *,
        is_check: bool,
    ) -> bool:
        """Bring rows up to date with the ids that were found; returns as `_apply`."""
        known, wanted = self._rows(connection, kind), found
        if not is_check:
            before = known.get
            wanted = {n: number for n, number in found.items() if before(n, _NONE)[0] != number}
        current = self._store.fingerprints(wanted, kind=kind)
        is_done = True
        if not is_check or current != known:
            names = set(wanted)
            # Otherwise all that are known were found.
            if len(found) - len(names - known.keys()) < len(known):
                names |= known.keys() - found.keys()
            compared = {name: known[name] for name in names if name in known}
            is_done = self._apply(connection, kind, compared, current, again=is_check)
        if is_check:
            self._sort(kind, current)
        self._is_checked[kind] |= is_check
        return is_done

    def _sort(self, kind: Kind, current: Mapping[str, GroupFingerprint]) -> None:
        """Keep fingerprints in the order of listings, in which comparing them takes a third."""
        if self._known[kind] == current:
            self._known[kind] = dict[str, Known](current)

    def _compare_some(
        self, connection: sqlite3.Connection, kind: Kind, numbers: Mapping[str, int]
    ) -> None:
        known, current = self._rows(connection, kind), self._store.fingerprints(numbers, kind=kind)
        before = {name: known[name] for name in numbers if name in known}
        self._apply(connection, kind, before, current)

    def _mark(self, kind: Kind) -> int:
        """Stamp of the folder of a kind, 0 without it."""
        with disk_errors(f"list {kind}s"):
            try:
                return (self._store.root / f"{kind}s").stat().st_mtime_ns
            except FileNotFoundError:
                return 0

    def _look_at_bucket(self, connection: sqlite3.Connection) -> None:
        now_ns = time.monotonic_ns()
        if self._looked_ns is not None and now_ns - self._looked_ns < BUCKET_PERIOD_NS:
            return
        # Before anything is listed: what is announced meanwhile is left to the next look.
        changes, is_empty = self._store.changes(), False
        seen = {name for (name,) in connection.execute("SELECT name FROM announced")}
        new = {name: changes[name] for name in changes.keys() - seen}
        last_s = dict(connection.execute("SELECT name, value FROM fact"))
        is_check = not all(self._is_checked.values()) and not _is_recent(last_s.get("checked"))
        if is_check or not changes or not _is_recent(last_s.get("listed")):
            numbers = {kind: self._store.folder_numbers(kind=kind) for kind in KINDS}
            for kind, found in numbers.items():
                self._compare(connection, kind, found, is_check=is_check)
            _note(connection, ("listed", "checked") if is_check else ("listed",))
            gone = [(name,) for name in seen - changes.keys()]
            connection.executemany("DELETE FROM announced WHERE name = ?", gone)
            is_empty = not any(numbers.values())
        for kind in () if is_check else KINDS:
            some = {item_id: 0 for what, item_id in new.values() if what == kind}
            self._compare_some(connection, kind, some)
        # Items that could not be read are left to the next look of any process.
        done = [(n,) for n, (kind, item_id) in new.items() if item_id not in self._omitted[kind]]
        if done:
            with transaction(connection):
                connection.executemany("INSERT OR IGNORE INTO announced VALUES (?)", done)
        self._looked_ns = None if is_empty else now_ns

    def _apply(
        self,
        connection: sqlite3.Connection,
        kind: Kind,
        before: Mapping[str, Known],
        current: Mapping[str, GroupFingerprint],
        *,
        again: bool = False,
    ) -> bool:
        """Bring rows that were as `before` up to date; they are linked before the next query.

        `again` also tries those that could not be read at the last check. Returns whether nothing
        is left to the next look.
        """
        if again:
            self._omitted[kind].clear()
        known, omitted = self._rows(connection, kind), self._omitted[kind]
        # What another thread or process has changed since is left to the next look.
        gone = [
            name for name, one in before.items() if name not in current and known.get(name) == one
        ]
        changed = [
            name
            for name, one in current.items()
            if known.get(name) == before.get(name) != one and omitted.get(name) != one
        ]
        many = len(changed) > BATCH
        names = iter(self._progress(changed, f"read {kind}s", len(changed)) if many else changed)
        is_done = True
        while some := list(islice(names, BATCH)):
            found_now = {name: self._read(kind, name, current[name]) for name in some}
            gone += [n for n, write in found_now.items() if write is _no_row and n in known]
            writes = {n: write for n, write in found_now.items() if write and write is not _no_row}
            is_done &= self._write(connection, kind, {n: current[n] for n in writes}, writes)
        if gone:
            with transaction(connection):
                text = "DELETE FROM item WHERE kind = ? AND id = ?"
                connection.executemany(text, [(kind, name) for name in gone])
            for name in gone:
                known.pop(name, None)
        return is_done

    def _write(
        self,
        connection: sqlite3.Connection,
        kind: Kind,
        current: Mapping[str, GroupFingerprint],
        writes: Mapping[str, Write],
    ) -> bool:
        """Write rows of items that are still as they were read; returns whether all were."""
        if not writes:
            return True
        numbers = {name: one.folder for name, one in current.items()}
        with transaction(connection):
            # What was deleted since must not get a row, after its erasure from this file.
            now = self._store.fingerprints(numbers, kind=kind) if self._is_local else current
            done = {name: one for name, one in current.items() if now.get(name) == one}
            for name in done:
                writes[name](connection)
        self._known[kind] |= done
        return len(done) == len(writes)

    def _read(self, kind: Kind, name: str, fingerprint: GroupFingerprint) -> Write | None:
        """What writes the row of an item; `_no_row`, or None for one that is left as it is."""
        before, store = self._known[kind].get(name), self._store
        try:
            if before is None or before[:2] != fingerprint[:2]:
                return partial(write_row, row=read_row(store, kind, name, fingerprint))
            review, clicks = read_remarks(store, kind, name)
        except NotFoundError:
            # Deleted while we were listing; one that comes back is read again.
            return _no_row
        except StorageError as error:
            self._omitted[kind][name] = fingerprint
            problem = (kind, name, error.message)
            if problem not in self._reported:
                self._reported.add(problem)
                logger.warning("omitted_from_catalog", kind=kind, id=name, reason=error.message)
            # A disk or a limit of the system changes nothing of what was read before.
            return _no_row if isinstance(error, CorruptDataError) else None
        return partial(
            write_remarks, name=(kind, name), fingerprint=fingerprint, review=review, clicks=clicks
        )


def _no_row(_: sqlite3.Connection) -> None:
    """Stands for an item that has no row."""


def _note(connection: sqlite3.Connection, names: Iterable[str]) -> None:
    """Keep that a bucket was listed or checked just now."""
    facts = [(name, int(time.time())) for name in names]
    connection.executemany("INSERT OR REPLACE INTO fact VALUES (?, ?)", facts)


def _is_recent(time_s: int | None) -> bool:
    # A clock that went back makes the time one of the future.
    return time_s is not None and 0 <= time.time() - time_s < BUCKET_CHECK_PERIOD_S
