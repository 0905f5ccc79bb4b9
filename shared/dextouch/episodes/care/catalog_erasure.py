"""Erasure of deleted data from the catalog of a store, a cache of its service and commands.

The catalog's tables are those of `services.episode_store`; any other file is removed as a whole,
since the catalog is made anew from the items.
"""

import sqlite3
from collections.abc import Callable, Iterable, Iterator
from contextlib import closing
from pathlib import Path
from typing import Final

from dextouch.episodes.files import disk_errors

CATALOG_FOLDER: Final = ".catalog"
Search = Callable[[str], list[str]]
_BUSY_S: Final = 10.0
_JOURNALS: Final = ("-wal", "-shm", "-journal")


def remove_catalog(path: Path) -> None:
    """Remove a database with its journals; processes that have it open do not notice."""
    for suffix in ("", *_JOURNALS):
        path.with_name(path.name + suffix).unlink(missing_ok=True)


def erase_from_catalog(root: Path, search: Search) -> None:
    """Delete the rows in which a search finds something, from the free pages and journals, too.

    What is not a catalog of this release, is damaged or stays locked is removed, and so are other
    files there, such as the journal of a catalog that is gone.
    """
    with disk_errors("erase from the catalog"):
        for path in _other_files(root):
            path.unlink(missing_ok=True)
        for path in _databases(root):
            try:
                _erase(path, search)
            except sqlite3.Error:
                remove_catalog(path)


def _erase(path: Path, search: Search) -> None:
    with closing(sqlite3.connect(path, timeout=_BUSY_S, isolation_level=None)) as connection:
        connection.execute("PRAGMA secure_delete = ON")
        connection.execute("BEGIN IMMEDIATE")
        rows = connection.execute("SELECT item.row, * FROM item LEFT JOIN body USING (row)")
        found = [(row,) for row, *values in rows if _named(values, search)]
        connection.executemany("DELETE FROM item WHERE row = ?", found)
        connection.execute("COMMIT")
        connection.execute("VACUUM")
        (is_busy, *_) = connection.execute("PRAGMA wal_checkpoint(TRUNCATE)").fetchone()
    if is_busy:
        raise sqlite3.OperationalError("its journal is in use")


def search_catalog(root: Path, search: Search) -> Iterator[tuple[str, tuple[str, ...]]]:
    """Tables in which a search finds something, with what it finds."""
    with disk_errors("search the catalog"):
        for path in _other_files(root):
            yield f"{CATALOG_FOLDER}/{path.name} is of no catalog; remove it, and repeat", ()
        for path in _databases(root):
            where = f"{CATALOG_FOLDER}/{path.name}"
            try:
                for table, found in _search(path, search):
                    yield f"{where} {table}", found
            except sqlite3.Error as error:
                # It held nothing that could be erased when this began.
                yield f"{where} cannot be searched ({error}); remove it, and repeat", ()


def _search(path: Path, search: Search) -> Iterator[tuple[str, tuple[str, ...]]]:
    with closing(sqlite3.connect(path, timeout=_BUSY_S)) as connection:
        tables = connection.execute("SELECT name FROM sqlite_master WHERE type = 'table'")
        for (table,) in tables.fetchall():
            columns = connection.execute(f'PRAGMA table_info("{table}")').fetchall()
            texts = ", ".join(f'"{name}"' for _, name, kind, *_ in columns if kind == "TEXT")
            if texts:
                rows = connection.execute(f'SELECT {texts} FROM "{table}"')  # noqa: S608
                if found := {name for row in rows for name in _named(row, search)}:
                    yield table, tuple(sorted(found))


def _named(values: Iterable[object], search: Search) -> set[str]:
    texts = (value for value in values if isinstance(value, str))
    return {name for text in texts for name in search(text)}


def _databases(root: Path) -> list[Path]:
    return sorted((root / CATALOG_FOLDER).glob("*.sqlite"))


def _other_files(root: Path) -> list[Path]:
    """Files in the folder that are neither a database nor one of its journals."""
    folder, found = root / CATALOG_FOLDER, []
    for path in sorted(folder.iterdir()) if folder.is_dir() else []:
        base, dash, _ = path.name.rpartition("-")
        owner = base if dash and path.name.removeprefix(base) in _JOURNALS else path.name
        if path.is_file() and not (owner.endswith(".sqlite") and (folder / owner).is_file()):
            found.append(path)
    return found
