"""Trash of a store, from where deleted groups can be restored, and remarks on its items.

An entry is a folder `.trash/KIND.ID.TIME`, TIME being nanoseconds since 1970. Deleting and
restoring are one rename each, hence atomic.
"""

import contextlib
import re
import shutil
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Final, Literal, TypeVar, get_args

from pydantic import BaseModel, ValidationError

from dextouch.episodes.files import (
    GroupFiles,
    LocalGroup,
    disk_errors,
    folder_bytes,
    replace_file,
    sync_folder,
)
from dextouch.episodes.format import COMMIT_FILE, KINDS, stated_sha256
from dextouch.errors import ConflictError, CorruptDataError, NotFoundError, UnknownNameError
from dextouch.schemas import LineageEntry, Review

TRASH = ".trash"
# Besides groups: unfinished uploads that were damaged.
TrashKind = Literal["episode", "recording", "upload"]
TRASH_KINDS: tuple[TrashKind, ...] = get_args(TrashKind)
HOMES: dict[TrashKind, str] = {
    "episode": "episodes",
    "recording": "recordings",
    "upload": ".uploads",
}
# What people say of items: files beside the content of a group. They are no part of it, so they
# may change, and they go where the item goes: to the trash, back, and away for good.
REVIEW_FILE: Final = "review.json"
CLICKS_FILE: Final = "clicks.json"
NOTES_FILE: Final = "notes.json"
REMARK_FILES: Final = (REVIEW_FILE, CLICKS_FILE, NOTES_FILE)
Remark = TypeVar("Remark", bound=BaseModel)
_NAME = re.compile(rf"({'|'.join(TRASH_KINDS)})\.([a-z0-9_-]+)\.([0-9]{{1,20}})")


@dataclass(frozen=True)
class TrashEntry:
    """One deleted item; `num_bytes` is the space that purging it frees."""

    kind: TrashKind
    item_id: str
    deleted_at_ns: int
    num_bytes: int
    folder: Path


def put_into_trash(root: Path, kind: TrashKind, item_id: str, *, now_ns: int | None = None) -> Path:
    """Move a folder to the trash, where it can be restored until it is purged; returns its path.

    `now_ns` are nanoseconds since 1970, None for now. Raises NotFoundError without the item.
    """
    home = root / _home(kind)
    number = time.time_ns() if now_ns is None else now_ns
    with disk_errors(f"delete {kind} {item_id}"):
        while (place := root / TRASH / f"{kind}.{item_id}.{number}").exists():
            number += 1
        try:
            (home / item_id).lstat()
            place.parent.mkdir(parents=True, exist_ok=True)
            (home / item_id).rename(place)
        except FileNotFoundError as error:
            raise NotFoundError(f"{kind} {item_id!r}: not in the store {root}") from error
        sync_folder(home)
        sync_folder(root / TRASH)
    return place


def list_trash(root: Path) -> list[TrashEntry]:
    """Contents of the trash, oldest first, including partially purged entries."""
    folder = root / TRASH
    entries = []
    with disk_errors("list the trash"):
        for path in sorted(folder.iterdir()) if folder.is_dir() else []:
            match = _NAME.fullmatch(path.name)
            if match is not None:
                kind = next(known for known in TRASH_KINDS if known == match[1])
                size = folder_bytes(path)
                entries.append(TrashEntry(kind, match[2], int(match[3]), size, path))
    return sorted(entries, key=lambda entry: entry.deleted_at_ns)


def restore_from_trash(root: Path, kind: TrashKind, item_id: str) -> TrashEntry:
    """Restore the last deleted item of an id.

    Raises NotFoundError without a complete one in the trash, ConflictError if the id was taken.
    """
    home = _home(kind)
    entries = [
        entry
        for entry in list_trash(root)
        if (entry.kind, entry.item_id) == (kind, item_id)
        and (kind not in KINDS or (entry.folder / COMMIT_FILE).is_file())
    ]
    if not entries:
        raise NotFoundError(f"{kind} {item_id!r}: not in the trash of {root}")
    entry, target = entries[-1], root / home / item_id
    with disk_errors(f"restore {kind} {item_id}"):
        if target.exists() or target.is_symlink():
            raise ConflictError(
                f"{kind} {item_id!r} exists; delete it first, then restore the older one"
            )
        target.parent.mkdir(parents=True, exist_ok=True)
        try:
            entry.folder.rename(target)
        except FileNotFoundError as error:
            raise NotFoundError(f"{kind} {item_id!r}: was purged from the trash") from error
        sync_folder(target.parent)
    return entry


def purge_trash(
    root: Path, *, older_than_s: float = 0.0, now_ns: int | None = None
) -> list[TrashEntry]:
    """Permanently delete trash older than `older_than_s` and return the deleted entries.

    An interrupted purge is completed by the next one.
    """
    now_ns = time.time_ns() if now_ns is None else now_ns
    old = [e for e in list_trash(root) if e.deleted_at_ns <= now_ns - round(older_than_s * 1e9)]
    for entry in old:
        remove_for_good(entry.folder)
    return old


def remove_for_good(folder: Path) -> None:
    """Delete a folder; a symbolic link is removed, its target kept."""
    with disk_errors(f"remove {folder.name}"), contextlib.suppress(FileNotFoundError):
        if folder.is_symlink() or folder.is_file():
            folder.unlink()
            return
        # First, so that a partially removed group never passes for a complete one.
        (folder / COMMIT_FILE).unlink(missing_ok=True)
        shutil.rmtree(folder)


def _home(kind: TrashKind) -> str:
    if kind not in HOMES:
        raise UnknownNameError("kind", kind, list(HOMES))
    return HOMES[kind]


def read_remark(files: GroupFiles, name: str, form: type[Remark], *, what: str) -> Remark | None:
    """A file beside the content of a group; None without, CorruptDataError for another form."""
    content = files.get(name)
    if content is None:
        return None
    try:
        return form.model_validate_json(content, extra="ignore")
    except ValidationError as error:
        raise CorruptDataError(
            f"{what}: {name} is no {name.removesuffix('.json')} ({error.error_count()} fields do "
            "not fit); delete the file, and enter it again"
        ) from error


def change_trashed_review(
    root: Path, source: LineageEntry, change: Callable[[Review | None], Review | None]
) -> None:
    """Change the reviews of a source's groups in the trash, for when they are restored."""
    for folder in sorted((root / TRASH).glob(f"{source.kind}.{source.id}.*")):
        files, what = LocalGroup(folder), f"{source.kind} {source.id!r} in the trash"
        commit = files.get(COMMIT_FILE)
        if commit is None or not source.is_of(stated_sha256(commit)):
            continue
        review = read_remark(files, REVIEW_FILE, Review, what=what)
        changed = change(review)
        if changed is not None and changed != review:
            with disk_errors(f"write {REVIEW_FILE} of {what}"):
                replace_file(folder / REVIEW_FILE, changed.model_dump_json().encode())
