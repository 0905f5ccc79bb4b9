"""Permanent deletion of all data of an operator or a recording, with a receipt as proof.

The plan is journaled first (`.deletions/`), so that repeating an interrupted deletion completes it,
even when the recordings that led to derived episodes are already gone. What was deleted is
remembered (`dextouch.episodes.maintenance.deletion_records`), so that stations remove their copies.
"""

import json
import os
import re
import sqlite3
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import closing, suppress
from dataclasses import asdict, dataclass
from datetime import UTC, datetime
from pathlib import Path
from typing import Final

from pydantic import BaseModel, Field, ValidationError

from dextouch.episodes.files import disk_errors, held_folder, replace_file, try_lock
from dextouch.episodes.format import Kind, sha256_hex
from dextouch.episodes.maintenance.deletion_records import DeletionRecords, TakeFacts
from dextouch.episodes.maintenance.item_facts import (
    PLACES,
    SIGNED_FILES,
    Facts,
    all_facts,
    authors_in,
    read_dict,
    small_files,
    without_author,
)
from dextouch.episodes.staging import (
    CATALOG_FOLDER,
    DOWNLOADS,
    JOURNALS,
    remove_catalog,
    sweep_stages,
)
from dextouch.episodes.trash import TRASH, put_into_trash, remove_for_good
from dextouch.errors import CorruptDataError, InvalidInputError, NotFoundError
from dextouch.free_text import texts_in
from dextouch.frozen_model import FrozenModel
from dextouch.schemas import MERGED, OutstandingTakes

RECEIPT_VERSION = 1
INTENTS = ".deletions"
# Rounds of search and removal; more are needed only under constant uploads.
_MAX_ROUNDS = 5
_MAX_HEADER_BYTES = 64 << 20
# Those that earlier releases completed after a crash are named `recovered`.
_VERSION = re.compile(r"-(salvaged|recovered)-[0-9]+")
_WORD = "A-Za-z0-9_-"


class IdentifierSearch:
    """Search for identifiers (a pseudonym, ids, hashes), at least one, as whole words."""

    def __init__(self, words: set[str]) -> None:
        self._words = words
        # Longest first, so that of two words with a common prefix the longer one matches.
        either = "|".join(re.escape(word) for word in sorted(words, key=len, reverse=True))
        self._pattern = re.compile(rf"(?<![{_WORD}])(?:{either})(?![{_WORD}])")

    def found_in(self, data: bytes) -> list[str]:
        """Identifiers in bytes of JSON or text."""
        try:
            texts = "\0".join(texts_in(json.loads(data)))
        except (ValueError, RecursionError):
            text = data.decode(errors="replace")
            escaped = {word for word in self._words if json.dumps(word)[1:-1] in text}
            return sorted(escaped.union(self.in_text(text)))
        return self.in_text(texts)

    def in_column(self, text: str) -> list[str]:
        """Identifiers in a text that may be JSON."""
        return self.found_in(text.encode()) if text.startswith("{") else self.in_text(text)

    def in_text(self, text: str) -> list[str]:
        """Identifiers in a text."""
        return sorted(set(self._pattern.findall(text)))


@dataclass(frozen=True)
class DeletionRequest:
    """Scope of a deletion: an operator or a recording, with all data derived from it.

    Raises InvalidInputError if both or neither were given.
    """

    operator: str | None = None
    recording: str | None = None
    derived: bool = True

    def __post_init__(self) -> None:
        if bool(self.operator) == bool(self.recording):
            raise InvalidInputError(
                f"deletion: got operator {self.operator!r} and recording {self.recording!r}, "
                "expected exactly one of them"
            )

    @property
    def name(self) -> str:
        """The operator or the recording."""
        return self.operator or self.recording or ""


@dataclass(frozen=True)
class Victim:
    """One item to delete, and the reason; of a recording also its station and `take_start`."""

    kind: str
    id: str
    place: str
    folder: str
    sha256: str | None
    reason: str
    station: str | None = None
    started: str = ""

    def as_take(self) -> TakeFacts | None:
        """By what a station recognises a recording; None of other items."""
        if self.kind != "recording" or self.station is None:
            return None
        return TakeFacts(self.id, self.station, self.started)


class _Intent(BaseModel):
    """Journal of a deletion: the plan, and what the store held before."""

    request: DeletionRequest
    started_at: str
    before: dict[str, list[str]]
    victims: list[Victim]


@dataclass(frozen=True)
class Reference:
    """A file or folder that still refers to deleted data."""

    where: str
    names: tuple[str, ...]


class DeletionReceipt(FrozenModel):
    """Record of a deletion: deleted items, time, and files searched afterwards; saved as JSON.

    `unnamed_reviews` are places of other people's items whose review lost its reviewer's name.
    `outstanding` are takes that stations may still hold in their spools; they remove them when they
    next ask the store, and `dextouch store deletions` shows what is left.
    """

    request: DeletionRequest
    started_at: str
    finished_at: str
    before: dict[str, list[str]]
    after: dict[str, list[str]]
    deleted: tuple[Victim, ...]
    remaining: tuple[Reference, ...]
    unreadable: tuple[str, ...]
    num_files_searched: int
    unnamed_reviews: tuple[str, ...] = ()
    outstanding: tuple[OutstandingTakes, ...] = ()
    receipt_version: int = RECEIPT_VERSION
    counts: dict[str, int] = Field(default={})

    @property
    def complete(self) -> bool:
        """Whether no readable file of the store refers to the deleted data any more."""
        return not self.remaining and not self.unreadable


def plan_deletion(
    root: Path, request: DeletionRequest, *, known: Sequence[Victim] = ()
) -> list[Victim]:
    """List everything in a store that a request covers, direct matches first.

    An interrupted deletion has found the `known` items already.
    """
    waiting = all_facts(root)
    spreads = request.derived or request.operator is not None
    wanted = _Wanted(waiting)
    for victim in known if spreads else ():
        wanted.add(victim.kind, victim.id, victim.sha256)
    if spreads and request.recording is not None:
        # Derived data may outlive its source.
        for one in wanted.stored("recording", request.recording) or [None]:
            wanted.add("recording", request.recording, one)
    found: list[Victim] = []
    grown = True
    while grown:
        grown = False
        for facts in list(waiting):
            reason = _reason(facts, request) or _reason_of_kin(facts, request, wanted)
            if reason is None:
                continue
            waiting.remove(facts)
            of_take = (facts.station, facts.started) if facts.kind == "recording" else (None, "")
            identity = (facts.kind, facts.item_id, facts.place, facts.folder.name, facts.sha256)
            found.append(Victim(*identity, reason, *of_take))
            if spreads:
                grown = True
                wanted.add(facts.kind, facts.item_id, facts.sha256)
                # And earlier versions, left behind by a repair or an edit.
                for kind, item_id, digest, operation in facts.lineage:
                    if kind == facts.kind and (operation or _is_version(facts, kind, item_id)):
                        is_id = operation != MERGED and not wanted.is_other(kind, item_id, digest)
                        wanted.add(kind, item_id if is_id else None, digest)
    return found


class _Wanted:
    """Items that a deletion has found, whose products go, too.

    A hash names an item for certain. An id may since have become that of another item, or be that
    of one in the store which this one was merged from.
    """

    def __init__(self, stored: Iterable[Facts]) -> None:
        self._stored: dict[tuple[str, str], set[str]] = {}
        for facts in stored:
            if facts.sha256 is not None:
                self._stored.setdefault((facts.kind, facts.item_id), set()).add(facts.sha256)
        self.hashes: set[str] = set()
        # Hashes by kind and id; none where those are not known.
        self.names: dict[tuple[str, str], set[str]] = {}

    def add(self, kind: str, item_id: str | None, sha256: str | None) -> None:
        """Follow an item by its hash and its id, if these are known."""
        known = set() if sha256 is None else {sha256}
        self.hashes |= known
        if item_id is not None:
            self.names.setdefault((kind, item_id), set()).update(known)

    def stored(self, kind: str, item_id: str) -> set[str]:
        return self._stored.get((kind, item_id), set())

    def is_other(self, kind: str, item_id: str, sha256: str | None) -> bool:
        """Whether an id is, in the store, that of another item than the one of a hash."""
        return sha256 is not None and bool(self.stored(kind, item_id) - {sha256})

    def has(self, kind: str, item_id: str, sha256: str | None) -> bool:
        """Whether a source is one of the items."""
        if sha256 in self.hashes:
            return True
        hashes = self.names.get((kind, item_id))
        if hashes is None or sha256 is None:
            return hashes is not None
        # The hash of the item is not known, and this is not the one of another stored item.
        return not hashes and sha256 not in self.stored(kind, item_id)


def reviews_by(root: Path, request: DeletionRequest) -> list[Facts]:
    """Items with a review or notes by the operator of a request."""
    if request.operator is None:
        return []
    return [facts for facts in all_facts(root) if request.operator in facts.authors]


def _reason(facts: Facts, request: DeletionRequest) -> str | None:
    if request.operator is None:
        is_it = (facts.kind, facts.item_id) == ("recording", request.recording)
        return "recording" if is_it else None
    if facts.operator == request.operator:
        return "operator"
    files = ((path.name, path) for path in small_files(facts.folder))
    named = not facts.readable and _references(IdentifierSearch({request.operator}), files)
    return "damaged, names the operator" if named else None


def _reason_of_kin(facts: Facts, request: DeletionRequest, wanted: _Wanted) -> str | None:
    for kind, item_id, sha256, _ in facts.lineage:
        if wanted.has(kind, item_id, sha256):
            return f"made from {kind} {item_id}"
    if facts.sha256 in wanted.hashes:
        return "same content"
    # An id that was reused by another operator is a different item.
    named = (facts.kind, facts.item_id) in wanted.names
    if named and facts.operator in {None, request.operator}:
        return "same id"
    return None


def _is_version(facts: Facts, kind: str, item_id: str) -> bool:
    if kind != facts.kind:
        return False
    rest = facts.item_id.removeprefix(item_id[:112])
    return facts.item_id == item_id or bool(_VERSION.fullmatch(rest))


def delete_for_good(
    root: Path,
    request: DeletionRequest,
    receipt_path: Path,
    *,
    checkpoints: Path | None = None,
    unsent: bool = False,
) -> DeletionReceipt:
    """Delete all that a request covers, search the remaining files, and write the receipt.

    What the service of the store must refuse from now on is remembered before anything is removed.

    Uploads and stages locked by a writer are kept and listed as remaining: stop the writer and
    repeat. Reviews that the operator wrote of other people's items lose their name. `checkpoints`,
    whose models may have been trained on the deleted data, are only searched. With `unsent` an
    operator is deleted of whom the store holds nothing, but a station may.

    Raises:
        NotFoundError: nothing in the store matches, and the operator reviewed nothing.
        InvalidInputError: a receipt path inside the store, where the search would find it.
    """
    if receipt_path.resolve().is_relative_to(root.resolve()):
        raise InvalidInputError(
            f"deletion: receipt {receipt_path} lies in the store, expected a file outside of it"
        )
    path = _intent_path(root, request)
    intent = _read_intent(path, root, request)
    records = DeletionRecords(root)
    key = records.key_of(operator=request.operator, recording=request.recording)
    known = intent.victims

    def remember() -> None:
        with disk_errors("write down what is to be deleted"):
            path.parent.mkdir(parents=True, exist_ok=True)
            replace_file(path, json.dumps(intent.model_dump()).encode())
        takes = [take for take in (victim.as_take() for victim in known) if take is not None]
        records.add(key, takes, operator=request.operator)

    reviewed = _remove_all(root, request, known, remember, unsent=unsent)
    words = {v.id for v in known} | {v.sha256 for v in known if v.sha256} | {request.name}
    wanted = IdentifierSearch(words)
    erase_from_catalog(root, wanted.in_column)
    with disk_errors("remove downloads"):
        sweep_stages(root, [DOWNLOADS])
    remaining, unreadable, num_files = _search(root, wanted, checkpoints, skip=path)
    deleted = [v for v in known if not (root / v.place / v.folder).exists()]
    receipt = DeletionReceipt(
        request=request,
        started_at=intent.started_at,
        finished_at=_now(),
        before=intent.before,
        after=_listing(root),
        deleted=tuple(deleted),
        remaining=tuple(remaining),
        unreadable=tuple(unreadable),
        num_files_searched=num_files,
        unnamed_reviews=tuple(f"{facts.place}/{facts.folder.name}" for facts in reviewed),
        outstanding=records.outstanding(key),
        counts={p: sum(v.place == p for v in deleted) for p in PLACES},
    )
    with disk_errors(f"write {receipt_path}"):
        replace_file(
            receipt_path, json.dumps(receipt.model_dump(mode="json"), indent=2).encode() + b"\n"
        )
        if len(deleted) == len(known):
            path.unlink()
            with suppress(OSError):
                path.parent.rmdir()
    return receipt


def _remove_all(
    root: Path,
    request: DeletionRequest,
    known: list[Victim],
    remember: Callable[[], None],
    *,
    unsent: bool,
) -> list[Facts]:
    """Remove what a request covers until nothing more appears; returns the reviews without names.

    `known` grows, and `remember` is called before anything is removed.
    """
    reviewed = list[Facts]()
    for _ in range(_MAX_ROUNDS):
        known += [v for v in plan_deletion(root, request, known=known) if v not in known]
        if not (known or reviewed or unsent or reviews_by(root, request)):
            raise NotFoundError(_nothing(root, request))
        remember()
        went = [_remove(root, victim) for victim in known]
        for facts in reviews_by(root, request):
            _unsign(facts, request.operator)
            reviewed.append(facts)
        if not any(went):
            break
    return reviewed


def _unsign(facts: Facts, operator: str | None) -> None:
    """Remove a name from a review and from notes, whose verdict and texts stay."""
    what = f"remove the author of remarks on {facts.item_id}"
    # Deleted meanwhile: the next round looks at what is left of it.
    with disk_errors(what), suppress(FileNotFoundError), held_folder(facts.folder):
        for path in (facts.folder / name for name in SIGNED_FILES):
            if operator in set(authors_in(fields := read_dict(path))):
                replace_file(path, json.dumps(without_author(fields, operator)).encode())


def _nothing(root: Path, request: DeletionRequest) -> str:
    text = f"deletion: nothing in {root} stems from {request.name!r}"
    if request.operator is None:
        return text
    return (
        f"{text}; expected the pseudonym as takes have it. --unsent also deletes takes of it that "
        "stations have not uploaded, and `dextouch store deletions` shows what is outstanding"
    )


def _search(
    root: Path, wanted: IdentifierSearch, checkpoints: Path | None, *, skip: Path
) -> tuple[list[Reference], list[str], int]:
    """What still refers to identifiers, what cannot be read, and the number of files searched.

    Searched are attributes files, names of folders, the catalog, and of checkpoints JSON and
    safetensors' headers.
    """
    found, files = [], []
    facts = all_facts(root)
    for item in facts:
        where = f"{item.place}/{item.folder.name}"
        if named := wanted.in_text(item.item_id):
            found.append(Reference(where, tuple(named)))
        files += [(f"{where}/{path.name}", path) for path in small_files(item.folder)]
    if checkpoints is not None:
        with disk_errors(f"search {checkpoints}"):
            paths = [p for p in checkpoints.rglob("*") if p.suffix in {".safetensors", ".json"}]
            files += [(str(path), path) for path in sorted(paths) if path.is_file()]
    with disk_errors(f"list {DOWNLOADS}"):
        lists = sorted((root / DOWNLOADS).glob("*/items.json"))
    files += [(path.relative_to(root).as_posix(), path) for path in lists]
    others = ((f"{INTENTS}/{p.name}", p) for p in small_files(root / INTENTS) if p != skip)
    found += _references(wanted, [*files, *others])
    found += [Reference(*named) for named in search_catalog(root, wanted.in_column)]
    unreadable = [f"{item.place}/{item.folder.name}" for item in facts if not item.readable]
    return found, unreadable, len(files)


def _references(wanted: IdentifierSearch, files: Iterable[tuple[str, Path]]) -> list[Reference]:
    found = []
    for where, path in files:
        with disk_errors(f"search {path.name}"), path.open("rb") as file:
            is_weights = path.suffix == ".safetensors"
            size = int.from_bytes(file.read(8), "little") if is_weights else _MAX_HEADER_BYTES
            data = file.read(min(size, _MAX_HEADER_BYTES))
        if named := wanted.found_in(data):
            found.append(Reference(where, tuple(named)))
    return found


def _remove(root: Path, victim: Victim) -> bool:
    """Remove one item unless a writer holds its lock; returns whether it was removed."""
    folder = root / victim.place / victim.folder
    if not folder.exists() and not folder.is_symlink():
        return False
    if victim.place == TRASH or folder.is_symlink() or not folder.is_dir():
        remove_for_good(folder)
        return True
    with disk_errors(f"delete {victim.folder}"):
        lock = try_lock(folder)
    if lock is None:
        return False
    try:
        if victim.place in {"episodes", "recordings"}:
            # The rename makes it invisible at once, whatever happens to this process afterwards.
            kind: Kind = "episode" if victim.place == "episodes" else "recording"
            folder = put_into_trash(root, kind, victim.folder)
        remove_for_good(folder)
    finally:
        os.close(lock)
    return True


def _listing(root: Path) -> dict[str, list[str]]:
    listing: dict[str, list[str]] = {place: [] for place in PLACES}
    for facts in all_facts(root):
        listing[facts.place].append(facts.folder.name)
    return listing


def _now() -> str:
    return datetime.now(UTC).isoformat(timespec="seconds")


def _intent_path(root: Path, request: DeletionRequest) -> Path:
    # A hash, so that no file name contains a pseudonym.
    return root / INTENTS / f"{sha256_hex(json.dumps(asdict(request)).encode())[:32]}.json"


def _read_intent(path: Path, root: Path, request: DeletionRequest) -> _Intent:
    with disk_errors("read what a deletion had planned"):
        if not path.is_file():
            return _Intent(request=request, started_at=_now(), before=_listing(root), victims=[])
        data = path.read_bytes()
    try:
        return _Intent.model_validate_json(data)
    except ValidationError as error:
        raise CorruptDataError(
            f"deletion: {path} is damaged ({error}); remove it and repeat the deletion"
        ) from error


Search = Callable[[str], list[str]]
_BUSY_S: Final = 10.0


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
                _erase_rows(path, search)
            except sqlite3.Error:
                remove_catalog(path)


def _erase_rows(path: Path, search: Search) -> None:
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
                for table, found in _search_tables(path, search):
                    yield f"{where} {table}", found
            except sqlite3.Error as error:
                # It held nothing that could be erased when this began.
                yield f"{where} cannot be searched ({error}); remove it, and repeat", ()


def _search_tables(path: Path, search: Search) -> Iterator[tuple[str, tuple[str, ...]]]:
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
        owner = base if dash and path.name.removeprefix(base) in JOURNALS else path.name
        if path.is_file() and not (owner.endswith(".sqlite") and (folder / owner).is_file()):
            found.append(path)
    return found
