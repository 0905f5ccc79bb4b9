"""SQLite file of a store's catalog, which the service and commands share.

It is a cache: what is lost, damaged or of another release is read again from the items.
"""

import os
import sqlite3
import uuid
from collections.abc import Iterator
from contextlib import closing, contextmanager, suppress
from pathlib import Path
from typing import Final

import structlog

from dextouch.episodes import CATALOG_FOLDER, held_folder, remove_catalog
from services.episode_store.filters import (
    COUNTED_ATTRIBUTES,
    EARLIEST,
    NO_WEIGHT,
    SORT_COLUMNS,
    microseconds,
)

logger = structlog.get_logger(__name__)

# To be incremented with any change of the tables, or of what is read of an item.
VERSION: Final = 5
# How long a process waits for another one that writes: longer than linking 100,000 items takes.
BUSY_S: Final = 30.0
_DAMAGED: Final = (sqlite3.SQLITE_CORRUPT, sqlite3.SQLITE_NOTADB)
# Any other error is one of a query.
_UNUSABLE: Final = (
    *_DAMAGED, sqlite3.SQLITE_CANTOPEN, sqlite3.SQLITE_READONLY, sqlite3.SQLITE_FULL,
    sqlite3.SQLITE_IOERR, sqlite3.SQLITE_BUSY, sqlite3.SQLITE_PROTOCOL,
)  # fmt: skip
# Of all items of a kind, and of takes. `take_name` has all columns that takes are filtered by
# figures with.
_INDEXES: Final = "".join(
    f"CREATE INDEX kind_{name} ON item(kind, {key}, name);"
    f"CREATE INDEX take_{name} ON item({key}, name) WHERE is_take;"
    for name, key in ((name, column.format("")) for name, column in SORT_COLUMNS.items())
)
_COUNTED: Final = ("kind", "is_take", *COUNTED_ATTRIBUTES, "verdict", "take_verdict")
_ATTRIBUTE_COLUMNS: Final = ", ".join(f"{name} {kind}" for name, kind in COUNTED_ATTRIBUTES.items())
# Days begin with one of these in most time zones. They are counted from the year 1: SQLite rounds
# negative quotients up.
HALF_HOUR_US: Final = 1800 * 10**6
_HALF_HOUR: Final = "({{0}}.at_us - {0}) / {1} * {1} + {0}".format(
    microseconds(EARLIEST), HALF_HOUR_US
)
# Tables of sums by columns of `item`: what lists without other conditions are counted by and hours
# are summed by, and by what hours of days are.
_SUMS: Final = {
    "tally": {name: f"{{0}}.{name}" for name in _COUNTED},
    "half_hours": {"kind": "{0}.kind", "at_us": _HALF_HOUR, "verdict": "{0}.verdict"},
}


def _count(row: str, sign: str) -> str:
    """Statements of a trigger that add a row of `item` to its sums, or take it away."""
    duration_ns = f"CAST(round({row}.duration_s * 1e9) AS INTEGER)"
    text = ""
    for table, columns in _SUMS.items():
        values = {name: column.format(row) for name, column in columns.items()}
        same = " AND ".join(f"{name} IS {value}" for name, value in values.items())
        text += f"""INSERT INTO {table} ({", ".join(values)}) SELECT {", ".join(values.values())}
      WHERE NOT EXISTS (SELECT 1 FROM {table} WHERE {same});
    UPDATE {table} SET num = num {sign} 1, duration_ns = duration_ns {sign} {duration_ns}
      WHERE {same};
    DELETE FROM {table} WHERE {same} AND num = 0;"""
    return text


# `result` has what edits made of an item, `stands` whether one of these is stored.
# Columns after `is_dirty` are derived from other items (`catalog_rows.relink`). Triggers mark what
# a change of an item alters elsewhere: its sources, what was made from it, and its group.
_SCHEMA: Final = f"""
CREATE TABLE item (
  row INTEGER PRIMARY KEY AUTOINCREMENT, kind TEXT NOT NULL, id TEXT NOT NULL, name TEXT NOT NULL,
  folder INTEGER NOT NULL, content TEXT NOT NULL, remarks TEXT NOT NULL, sha256 TEXT NOT NULL,
  {_ATTRIBUTE_COLUMNS}, trace_id TEXT, complete INTEGER NOT NULL,
  at_us INTEGER, at_key TEXT NOT NULL, duration_s REAL NOT NULL, duration_key TEXT NOT NULL,
  size INTEGER NOT NULL, num_bytes INTEGER,
  beyond_limit INTEGER NOT NULL, in_doubt INTEGER NOT NULL,
  is_clickable INTEGER NOT NULL, own_verdict TEXT, earlier_verdict TEXT,
  is_superseded INTEGER NOT NULL, figures BLOB NOT NULL, grp INTEGER NOT NULL,
  text TEXT NOT NULL, is_dirty INTEGER NOT NULL DEFAULT 1,
  is_take INTEGER NOT NULL DEFAULT 0, stands INTEGER NOT NULL DEFAULT 1, aligned INTEGER,
  verdict TEXT, is_whole INTEGER,
  is_compared INTEGER NOT NULL DEFAULT 0, fixed REAL NOT NULL DEFAULT 0,
  weight TEXT NOT NULL DEFAULT '{NO_WEIGHT}',
  take_verdict TEXT, take_weight TEXT NOT NULL DEFAULT '{NO_WEIGHT}', UNIQUE (kind, id));
CREATE TABLE body (
  row INTEGER PRIMARY KEY, summary TEXT NOT NULL, item TEXT NOT NULL, consent INTEGER,
  incomplete_cause TEXT NOT NULL, review TEXT, clicks TEXT);
CREATE TABLE lineage (
  row INTEGER, position INTEGER, kind TEXT NOT NULL, source TEXT NOT NULL, sha256 TEXT,
  PRIMARY KEY (row, position)) WITHOUT ROWID;
CREATE TABLE result (
  row INTEGER, id TEXT NOT NULL, PRIMARY KEY (row, id)) WITHOUT ROWID;
CREATE TABLE figure_name (number INTEGER PRIMARY KEY, name TEXT UNIQUE NOT NULL);
CREATE TABLE figure (
  number INTEGER, row INTEGER, value REAL NOT NULL, PRIMARY KEY (number, row)) WITHOUT ROWID;
CREATE TABLE grp (
  number INTEGER PRIMARY KEY, task TEXT, domain TEXT, origin TEXT, kind TEXT,
  is_stale INTEGER NOT NULL DEFAULT 1, num_items INTEGER NOT NULL DEFAULT 0, spread BLOB,
  UNIQUE (task, domain, origin, kind));
CREATE TABLE tally (
  kind TEXT NOT NULL, is_take INTEGER NOT NULL, {_ATTRIBUTE_COLUMNS}, verdict TEXT,
  take_verdict TEXT, num INTEGER NOT NULL DEFAULT 0, duration_ns INTEGER NOT NULL DEFAULT 0);
CREATE INDEX tally_key ON tally({", ".join(_COUNTED)});
CREATE TABLE half_hours (
  kind TEXT NOT NULL, at_us INTEGER, verdict TEXT,
  num INTEGER NOT NULL DEFAULT 0, duration_ns INTEGER NOT NULL DEFAULT 0);
CREATE INDEX half_hours_key ON half_hours(kind, at_us, verdict, num, duration_ns);
CREATE TABLE fact (name TEXT PRIMARY KEY, value INTEGER NOT NULL) WITHOUT ROWID;
CREATE TABLE announced (name TEXT PRIMARY KEY) WITHOUT ROWID;
CREATE INDEX lineage_source ON lineage(source, kind);
CREATE INDEX result_id ON result(id);
CREATE INDEX item_dirty ON item(is_dirty) WHERE is_dirty;
CREATE INDEX item_group ON item(grp, is_compared, figures, fixed, weight);
CREATE INDEX item_aligned ON item(aligned) WHERE aligned IS NOT NULL;
CREATE INDEX item_hours ON item(kind, at_us, verdict, duration_s);
CREATE INDEX item_text ON item(text);
CREATE INDEX item_clickable ON item(id) WHERE is_clickable;
CREATE INDEX kind_name ON item(kind, name);
CREATE INDEX take_name ON item(name, aligned, is_take) WHERE is_take;
CREATE INDEX kind_findings ON item(kind, weight, name);
CREATE INDEX take_verdict ON item(take_verdict, name) WHERE is_take;
CREATE INDEX take_findings ON item(take_weight, name) WHERE is_take;
{_INDEXES}
CREATE TRIGGER item_gone AFTER DELETE ON item BEGIN
  UPDATE item SET is_dirty = 1 FROM lineage l
    WHERE l.row = old.row AND item.kind = l.kind AND item.id = l.source;
  UPDATE item SET is_dirty = 1
    WHERE row IN (SELECT row FROM lineage WHERE source = old.id AND kind = old.kind);
  UPDATE item SET is_dirty = 1
    WHERE row IN (SELECT row FROM result WHERE id = old.id) AND kind = old.kind;
  UPDATE grp SET is_stale = 1 WHERE number = old.grp;
  {_count("old", "-")}
  DELETE FROM body WHERE row = old.row;
  DELETE FROM result WHERE row = old.row;
  DELETE FROM lineage WHERE row = old.row;
  DELETE FROM figure WHERE row = old.row AND number IN (SELECT number FROM figure_name);
END;
CREATE TRIGGER item_judged AFTER UPDATE OF is_take, verdict, take_verdict ON item
  WHEN (old.is_take, old.verdict, old.take_verdict)
    IS NOT (new.is_take, new.verdict, new.take_verdict) BEGIN
  {_count("old", "-")}
  {_count("new", "+")}
END;
CREATE TRIGGER item_made AFTER INSERT ON item BEGIN
  {_count("new", "+")}
  UPDATE item SET is_dirty = 1
    WHERE row IN (SELECT row FROM lineage WHERE source = new.id AND kind = new.kind);
  UPDATE item SET is_dirty = 1
    WHERE row IN (SELECT row FROM result WHERE id = new.id) AND kind = new.kind;
END;
CREATE TRIGGER item_reviewed
  AFTER UPDATE OF own_verdict, earlier_verdict, is_superseded ON item BEGIN
  UPDATE item SET is_dirty = 1
    WHERE row IN (SELECT row FROM lineage WHERE source = new.id AND kind = new.kind);
END;
PRAGMA user_version = {VERSION};
"""


class CatalogFile:
    """The catalog of a store below its folder `root`, in memory where it cannot be written.

    Each new file has a name of its own: a process that still has a removed one open never touches
    its successor. `tag` names the store, where `root` is only a work folder.
    """

    def __init__(self, root: Path, tag: str = "") -> None:
        self._root, self._folder, self._is_bucket = root, root / CATALOG_FOLDER, bool(tag)
        self._prefix = f"v{VERSION}-{tag}-" if tag else f"v{VERSION}-"
        # None for a catalog in memory.
        self.path: Path | None = None
        self._connection: sqlite3.Connection | None = None
        self._is_given_up = False

    def connection(self) -> tuple[sqlite3.Connection, bool]:
        """The connection, and whether it is a new one: the file may have been removed."""
        if self._connection is not None and self._is_valid():
            return self._connection, False
        self.close()
        self._connection = self._open()
        return self._connection, True

    def _is_valid(self) -> bool:
        if self.path is None:
            # The store's folder may have been made since.
            return self._is_given_up or not (self._is_bucket or self._root.is_dir())
        return self.path.exists()

    def _open(self) -> sqlite3.Connection:
        if not self._is_given_up and (self._is_bucket or self._root.is_dir()):
            try:
                self._folder.mkdir(exist_ok=True, parents=self._is_bucket)
                self._give_to_owner(self._folder)
                # No other process opens or creates a file meanwhile.
                with held_folder(self._folder):
                    return self._open_file()
            except (OSError, sqlite3.Error) as error:
                self.give_up(error)
        self.path = None
        return _created(":memory:")

    def _open_file(self) -> sqlite3.Connection:
        for path in sorted(self._folder.glob(f"{self._prefix}*.sqlite")):
            try:
                connection = _connected(path)
                (version,) = connection.execute("PRAGMA user_version").fetchone()
                if version == VERSION:
                    self.path = path
                    return connection
                connection.close()
            except sqlite3.DatabaseError as error:
                if not _is_damage(error):
                    raise
                logger.warning("catalog_damaged", path=str(path), reason=str(error))
            # A process was killed while it made this one, or it is damaged.
            remove_catalog(path)
        self.path = self._folder / f"{self._prefix}{uuid.uuid4().hex[:12]}.sqlite"
        connection = _created(str(self.path))
        self._give_to_owner(self.path)
        for other in self._folder.glob("v*.sqlite"):
            if not other.name.startswith(f"v{VERSION}-"):
                remove_catalog(other)
        return connection

    def _give_to_owner(self, path: Path) -> None:
        """What an administrator makes is for the user of the service."""
        if os.geteuid() == 0:
            owner = self._root.stat()
            os.chown(path, owner.st_uid, owner.st_gid)

    def give_up(self, error: Exception) -> None:
        """After an error: begin a damaged file anew; keep the catalog in memory otherwise."""
        path = self.path
        self.close()
        if _is_damage(error) and path is not None:
            logger.warning("catalog_damaged", path=str(path), reason=str(error))
            remove_catalog(path)
            return
        logger.warning(
            "catalog_not_used",
            folder=str(self._folder),
            reason=str(error),
            instead="all items are read; let this user write to the folder, or end what locks it",
        )
        self._is_given_up = True

    def __del__(self) -> None:
        # Commands end without closing anything.
        self.close()

    def close(self) -> None:
        """Close the file."""
        if self._connection is not None:
            with suppress(sqlite3.Error):
                self._connection.close()
        self._connection = None


def _is_damage(error: Exception) -> bool:
    return (getattr(error, "sqlite_errorcode", 0) & 0xFF) in _DAMAGED


def is_unusable(error: sqlite3.Error) -> bool:
    """Whether an error is one of the file: damage, no space, no permission, a lock that stays."""
    return (getattr(error, "sqlite_errorcode", 0) & 0xFF) in _UNUSABLE


def _connected(path: Path | str) -> sqlite3.Connection:
    # A user who may only read the folder could not take part in WAL mode.
    connection = sqlite3.connect(
        path, timeout=BUSY_S, isolation_level=None, check_same_thread=False, cached_statements=256
    )
    try:
        # A lost transaction is read again from the items; erased pseudonyms are overwritten.
        for pragma in ("journal_mode = WAL", "synchronous = NORMAL", "secure_delete = ON"):
            connection.execute(f"PRAGMA {pragma}")
        connection.execute("PRAGMA cache_size = -65536")
        connection.execute("PRAGMA temp_store = MEMORY")
        with transaction(connection):
            """Refused for a file that may only be read."""
    except sqlite3.Error:
        connection.close()
        raise
    return connection


def _created(path: str) -> sqlite3.Connection:
    connection = _connected(path)
    connection.executescript(f"BEGIN IMMEDIATE; {_SCHEMA} COMMIT;")
    return connection


@contextmanager
def transaction(connection: sqlite3.Connection) -> Iterator[None]:
    """Write everything or, after an exception, nothing."""
    connection.execute("BEGIN IMMEDIATE")
    try:
        yield
        connection.execute("COMMIT")
    except BaseException:
        with suppress(sqlite3.Error):
            connection.execute("ROLLBACK")
        raise


@contextmanager
def snapshot(connection: sqlite3.Connection) -> Iterator[None]:
    """Read from one state of the file, whatever others write meanwhile."""
    connection.execute("BEGIN")
    try:
        yield
    finally:
        with suppress(sqlite3.Error):
            connection.execute("ROLLBACK")


def check_file(path: Path) -> str:
    """What SQLite finds wrong with a file; empty if it is whole."""
    try:
        with closing(sqlite3.connect(path, timeout=BUSY_S)) as connection:
            (found,) = connection.execute("PRAGMA integrity_check(1)").fetchone()
    except sqlite3.Error as error:
        return str(error)
    return "" if found == "ok" else str(found)
