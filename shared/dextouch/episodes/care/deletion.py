"""Permanent deletion of all data of an operator or a recording, with a receipt as proof.

The plan is journaled first (`.deletions/`), so that repeating an interrupted deletion completes it,
even when the recordings that led to derived episodes are already gone.
"""

import fcntl
import json
import os
import re
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import asdict, dataclass, field
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

from dextouch.episodes.care.store_facts import PLACES, Facts, Wanted, all_facts, small_files
from dextouch.episodes.files import disk_errors, replace_file
from dextouch.episodes.format import sha256_hex
from dextouch.episodes.trash import HOMES, TRASH, TrashKind, put_into_trash, remove_for_good
from dextouch.errors import CorruptDataError, InvalidInputError, NotFoundError

RECEIPT_VERSION = 1
INTENTS = ".deletions"
# Rounds of search and removal; more are needed only under constant uploads.
_MAX_ROUNDS = 5
_MAX_HEADER_BYTES = 64 << 20
_VERSION = re.compile(r"-(salvaged|recovered)-[0-9]+")


@dataclass(frozen=True)
class DeletionRequest:
    """Scope of a deletion: an operator or a recording, with all data derived from it.

    Raises:
        InvalidInputError: both or neither were given.
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


@dataclass(frozen=True)
class Victim:
    """One item to delete, and the reason."""

    kind: str
    id: str
    place: str
    folder: str
    sha256: str | None
    reason: str


@dataclass(frozen=True)
class Reference:
    """A file or folder that still refers to deleted data."""

    where: str
    names: tuple[str, ...]


@dataclass(frozen=True)
class DeletionReceipt:
    """Record of a deletion: deleted items, time, and files searched afterwards; saved as JSON."""

    request: DeletionRequest
    started_at: str
    finished_at: str
    before: dict[str, list[str]]
    after: dict[str, list[str]]
    deleted: tuple[Victim, ...]
    remaining: tuple[Reference, ...]
    unreadable: tuple[str, ...]
    num_files_searched: int
    receipt_version: int = RECEIPT_VERSION
    counts: dict[str, int] = field(default_factory=dict)

    @property
    def complete(self) -> bool:
        """Whether no readable file refers to the deleted data any more."""
        return not self.remaining and not self.unreadable


def plan_deletion(
    root: Path, request: DeletionRequest, *, known: Sequence[Victim] = ()
) -> list[Victim]:
    """List everything in a store that a request covers, direct matches first.

    Args:
        root: of the store.
        request: operator or recording.
        known: items found by an interrupted deletion.
    """
    waiting = all_facts(root)
    spreads = request.derived or request.operator is not None
    names = {(victim.kind, victim.id) for victim in known if spreads}
    hashes = {victim.sha256 for victim in known if spreads} - {None}
    if spreads and request.recording is not None:
        # Derived data may outlive its source.
        names.add(("recording", request.recording))
    found: list[Victim] = []
    grown = True
    while grown:
        grown = False
        for facts in list(waiting):
            reason = _reason(facts, request, names, hashes)
            if reason is None:
                continue
            waiting.remove(facts)
            found.append(
                Victim(
                    facts.kind,
                    facts.item_id,
                    facts.place,
                    facts.folder.name,
                    facts.content_sha256,
                    reason,
                )
            )
            if spreads:
                grown = True
                names.add((facts.kind, facts.item_id))
                hashes |= {facts.content_sha256} - {None}
                # Earlier versions, left behind by a repair or a migration.
                names |= {(k, i) for k, i, _ in facts.lineage if _is_version(facts, k, i)}
                hashes |= {h for k, i, h in facts.lineage if h and _is_version(facts, k, i)}
    return found


def _reason(
    facts: Facts, request: DeletionRequest, names: set[tuple[str, str]], hashes: set[str | None]
) -> str | None:
    if request.operator is not None:
        if facts.operator == request.operator:
            return "operator"
        wanted = Wanted({request.operator})
        if not facts.readable and any(_words(wanted, path) for path in small_files(facts.folder)):
            return "damaged, names the operator"
    elif (facts.kind, facts.item_id) == ("recording", request.recording):
        return "recording"
    return _reason_of_kin(facts, names, hashes, request.operator)


def _reason_of_kin(
    facts: Facts, names: set[tuple[str, str]], hashes: set[str | None], operator: str | None
) -> str | None:
    for kind, item_id, sha256 in facts.lineage:
        if (kind, item_id) in names or (sha256 is not None and sha256 in hashes):
            return f"made from {kind} {item_id}"
    if facts.content_sha256 is not None and facts.content_sha256 in hashes:
        return "same content"
    # An id that was reused by another operator is a different item.
    if (facts.kind, facts.item_id) in names and facts.operator in {None, operator}:
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
) -> DeletionReceipt:
    """Delete all that a request covers, search the remaining files, and write the receipt.

    Uploads and stages locked by a writer are kept and listed as remaining: stop the writer and
    repeat. Checkpoints are only searched.

    Args:
        root: of the store.
        request: operator or recording.
        receipt_path: new file outside the store.
        checkpoints: folder with models that may have been trained on the deleted data.

    Raises:
        NotFoundError: nothing in the store matches.
        InvalidInputError: a receipt path inside the store, where the search would find it.
    """
    if receipt_path.resolve().is_relative_to(root.resolve()):
        raise InvalidInputError(
            f"deletion: receipt {receipt_path} lies in the store, expected a file outside of it"
        )
    intent = _intent_path(root, request)
    started_at, before, known = _read_intent(intent, root)
    for _ in range(_MAX_ROUNDS):
        victims = [v for v in plan_deletion(root, request, known=known) if v not in known]
        known += victims
        if not known:
            raise NotFoundError(f"deletion: nothing in {root} stems from {_asked(request)!r}")
        _write_intent(intent, request, started_at, before, known)
        went = [victim for victim in known if _remove(root, victim)]
        if not went:
            break
    words = {v.id for v in known} | {v.sha256 for v in known if v.sha256} | {_asked(request)}
    remaining, unreadable, num_files = search(root, words, skip=intent)
    if checkpoints is not None:
        more, num_more = search_checkpoints(checkpoints, words)
        remaining, num_files = remaining + more, num_files + num_more
    left = {(v.place, v.folder) for v in known if (root / v.place / v.folder).exists()}
    deleted = tuple(v for v in known if (v.place, v.folder) not in left)
    receipt = DeletionReceipt(
        request=request,
        started_at=started_at,
        finished_at=_now(),
        before=before,
        after=_listing(root),
        deleted=deleted,
        remaining=tuple(remaining),
        unreadable=tuple(unreadable),
        num_files_searched=num_files,
        counts={p: sum(v.place == p for v in deleted) for p in PLACES},
    )
    with disk_errors(f"write {receipt_path}"):
        replace_file(receipt_path, json.dumps(asdict(receipt), indent=2).encode() + b"\n")
        if not left:
            intent.unlink()
            with suppress(OSError):
                intent.parent.rmdir()
    return receipt


def search(
    root: Path, words: set[str], *, skip: Path | None = None
) -> tuple[list[Reference], list[str], int]:
    """Find remaining references to identifiers, in every attributes file and in folder names.

    Returns:
        The references, the unreadable files, and the number of files searched.
    """
    wanted, found, num_files = Wanted(words), [], 0
    facts = all_facts(root)
    for item in facts:
        where = f"{item.place}/{item.folder.name}"
        named = wanted.in_text(item.item_id)
        if named:
            found.append(Reference(where, tuple(named)))
        for path in small_files(item.folder):
            num_files += 1
            if names := _words(wanted, path):
                found.append(Reference(f"{where}/{path.name}", tuple(names)))
    others = {p: _words(wanted, p) for p in small_files(root / INTENTS) if p != skip}
    found += [
        Reference(f"{INTENTS}/{p.name}", tuple(names)) for p, names in others.items() if names
    ]
    unreadable = [f"{item.place}/{item.folder.name}" for item in facts if not item.readable]
    return found, unreadable, num_files


def search_checkpoints(folder: Path, words: set[str]) -> tuple[list[Reference], int]:
    """Find references to identifiers in checkpoints: safetensors headers and JSON beside them."""
    wanted, found, num_files = Wanted(words), [], 0
    with disk_errors(f"search {folder}"):
        for path in sorted(folder.rglob("*")):
            if path.suffix not in {".safetensors", ".json"} or not path.is_file():
                continue
            num_files += 1
            if names := wanted.found_in(_header(path)):
                found.append(Reference(str(path), tuple(names)))
    return found, num_files


def _header(path: Path) -> bytes:
    with path.open("rb") as file:
        if path.suffix == ".json":
            return file.read(_MAX_HEADER_BYTES)
        size = int.from_bytes(file.read(8), "little")
        return file.read(min(size, _MAX_HEADER_BYTES))


def _words(wanted: Wanted, path: Path) -> list[str]:
    with disk_errors(f"search {path.name}"):
        return wanted.found_in(path.read_bytes())


def _remove(root: Path, victim: Victim) -> bool:
    """Remove one item unless a writer holds its lock; returns whether it was removed."""
    folder = root / victim.place / victim.folder
    if not folder.exists() and not folder.is_symlink():
        return False
    homes: dict[str, TrashKind] = {place: kind for kind, place in HOMES.items()}
    if victim.place == TRASH or folder.is_symlink() or not folder.is_dir():
        remove_for_good(folder)
        return True
    with disk_errors(f"delete {victim.folder}"):
        descriptor = os.open(folder, os.O_RDONLY)
    try:
        fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
        if victim.place in {"episodes", "recordings"}:
            # The rename makes it invisible at once, whatever happens to this process afterwards.
            folder = put_into_trash(root, homes[victim.place], victim.folder)
        remove_for_good(folder)
    except BlockingIOError:
        return False
    finally:
        os.close(descriptor)
    return True


def _asked(request: DeletionRequest) -> str:
    return request.operator or request.recording or ""


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


def _read_intent(path: Path, root: Path) -> tuple[str, dict[str, list[str]], list[Victim]]:
    with disk_errors("read what a deletion had planned"):
        if not path.is_file():
            return _now(), _listing(root), []
        data = path.read_bytes()
    try:
        plain: dict[str, Any] = json.loads(data)
        known = [Victim(**victim) for victim in plain["victims"]]
        return str(plain["started_at"]), dict(plain["before"]), known
    except (ValueError, KeyError, TypeError, RecursionError) as error:
        raise CorruptDataError(
            f"deletion: {path} is damaged ({error}); remove it and repeat the deletion"
        ) from error


def _write_intent(
    path: Path,
    request: DeletionRequest,
    started_at: str,
    before: dict[str, list[str]],
    known: Sequence[Victim],
) -> None:
    plain = {
        "request": asdict(request),
        "started_at": started_at,
        "before": before,
        "victims": [asdict(victim) for victim in known],
    }
    with disk_errors("write down what is to be deleted"):
        path.parent.mkdir(parents=True, exist_ok=True)
        replace_file(path, json.dumps(plain).encode())
