"""Backups: a store that follows another one while that is in use, and from which it is restored."""

import shutil
from base64 import b64encode
from collections.abc import Callable, Iterable, Mapping, Set
from contextlib import suppress
from dataclasses import dataclass, field
from datetime import UTC, datetime
from fnmatch import fnmatchcase
from typing import Final, Literal

from pydantic import AwareDatetime, Base64Bytes, Field, ValidationError

from dextouch.episodes import maintenance
from dextouch.episodes.editing.merge import copy_item, deletion_of
from dextouch.episodes.files import LocalGroup, disk_errors, held_folder, replace_file
from dextouch.episodes.format import COMMIT_FILE, KINDS, Kind, stated_sha256
from dextouch.episodes.staging import CATALOG_FOLDER
from dextouch.episodes.store import EpisodeStore
from dextouch.episodes.trash import remove_for_good
from dextouch.errors import (
    ConflictError,
    CorruptDataError,
    DexTouchError,
    InvalidInputError,
    NotFoundError,
    StorageError,
)
from dextouch.frozen_model import FrozenModel

BACKUP_FILE: Final = "backup.json"
# What a store must not forget, beside its items. The journals of running deletions stay: they name
# operators, and the records say enough.
_KEPT: Final = (
    *("enrolments.json", ".deleted/salt"),
    *(".deleted/records/*.json", ".deleted/stations/*.json"),
)
# An episode is listed before the recording that it was made of can have been missed.
_ORDER: Final[tuple[Kind, ...]] = ("episode", "recording")
Action = Literal["copied", "there", "updated", "retired", "erased", "refused", "damaged"]
OnItem = Callable[["BackupReport"], None]


class BackedUpItem(FrozenModel):
    """An item of a backup; `stamp` is what changes with its content or remarks in the source."""

    kind: Kind
    id: str
    sha256: str
    stamp: str


class BackupList(FrozenModel):
    """What a backup knew at its end, by which the next one tells changes; `files` are of `_KEPT`.

    It may lack items of a backup that was interrupted.
    """

    backup_version: Literal[1] = 1
    source: str
    finished_at: AwareDatetime
    items: tuple[BackedUpItem, ...] = ()
    files: dict[str, Base64Bytes] = Field(default={})

    @property
    def by_name(self) -> dict[tuple[Kind, str], BackedUpItem]:
        """Items by kind and id."""
        return {(item.kind, item.id): item for item in self.items}


@dataclass(frozen=True)
class BackupReport:
    """What became of one item.

    `copied`, or `there` already; `updated` if only remarks changed; `retired` to the backup's trash
    (in a bucket: deleted) as it is gone from the source, `erased` or not restored as it was
    permanently deleted there; `refused` or `damaged` for a reason.
    """

    kind: Kind
    item_id: str
    action: Action
    reason: str = ""


def read_backup_list(store: EpisodeStore) -> BackupList | None:
    """The list of a backup; None of a store that is none, CorruptDataError for another form."""
    data = store.get_file(BACKUP_FILE)
    if data is None:
        return None
    try:
        return BackupList.model_validate_json(data)
    except ValidationError as error:
        raise CorruptDataError(
            f"{store.url}: {BACKUP_FILE} is damaged, or of a later release "
            f"({error.error_count()} fields do not fit); back up to another place"
        ) from error


def back_up(
    source: EpisodeStore,
    target: EpisodeStore,
    *,
    accept_deletions: bool = False,
    on_item: OnItem = lambda _: None,
) -> list[BackupReport]:
    """Bring a backup up to date with a store, which may be written to and served meanwhile.

    Only what is new is copied, after it was verified. A damaged item is refused, and an earlier
    copy of it stays. Repeating an interrupted backup completes it.

    Raises:
        ConflictError: the target holds items and is no backup, or more than half of the backup is
            gone from the source, unless `accept_deletions`.
        InvalidInputError: one store lies in the other.
        NotFoundError: the source has no folder.
    """
    _check_apart(source, target, "backup")
    source.require_folder()
    with disk_errors(f"back up to {target.root}"):
        target.root.mkdir(parents=True, exist_ok=True)
    # Another backup to the same place ends first; in a bucket, one from this machine.
    with held_folder(target.root):
        before = (read_backup_list(target) or _begin(source, target)).by_name
        present = {(kind, name) for kind in KINDS for name in target.list(kind=kind)}
        held, found = present | before.keys(), dict[tuple[Kind, str], str]()
        for kind in _ORDER:
            numbers = source.folder_numbers(kind=kind)
            stored = source.fingerprints(numbers, kind=kind)
            for name in numbers:
                if name in stored or (kind, name) in held:
                    # Without a fingerprint its commit record was lost: it is damaged, not gone.
                    found[kind, name] = " ".join(stored[name][1:]) if name in stored else ""
        gone = held - found.keys()
        if 2 * len(gone) > len(held) and not accept_deletions:
            raise ConflictError(
                f"backup: {len(gone)} of {len(held)} items of {target.url} are gone from "
                f"{source.url}; if they were deleted on purpose, repeat it with --accept-deletions"
            )
        run = _Backup(source, target, before, present, on_item)
        for (kind, name), stamp in found.items():
            run.follow(kind, name, stamp)
        # Some were deleted meanwhile. What is deleted from here on is in the files that are kept.
        order = reversed(_ORDER)
        left = {(kind, name) for kind in order for name in source.folder_numbers(kind=kind)}
        left &= found.keys()
        run.items = [one for one in run.items if (one.kind, one.id) in left]
        _write_list(source, target, run.items)
        run.retire({(kind, name) for kind in KINDS for name in target.list(kind=kind)} - left)
    return run.reports


def restore_backup(
    backup: EpisodeStore, target: EpisodeStore, *, on_item: OnItem = lambda _: None
) -> list[BackupReport]:
    """Restore a store from its backup, and verify every item of it; repeatable.

    What the store must not forget, such as deletions, is restored before its items; what these
    cover is not restored. Nothing whole is written over, and remarks stay where there are any.

    Raises:
        ConflictError: the target has other items or records of its own.
        InvalidInputError: one store lies in the other.
        NotFoundError: there is no backup.
    """
    _check_apart(backup, target, "restore-backup")
    listing = read_backup_list(backup)
    if listing is None:
        raise NotFoundError(
            f"restore-backup: {backup.url} has no {BACKUP_FILE}: it is no backup; `dextouch store "
            "merge` copies other stores"
        )
    # Also what a backup copied that was interrupted.
    wanted = {(kind, name) for kind in KINDS for name in backup.list(kind=kind)}
    wanted |= listing.by_name.keys()
    present = [(kind, name) for kind in KINDS for name in target.list(kind=kind)]
    if others := [name for kind, name in present if (kind, name) not in wanted]:
        raise ConflictError(
            f"restore-backup: {target.url} has {len(others)} items that the backup lacks, such as "
            f"{others[0]!r}; restore into an empty folder, and merge the two stores then"
        )
    _write_kept_files(target, listing)
    reports = []
    for kind, name in sorted(wanted, key=lambda item: (item[0] != "recording", item[1])):
        try:
            report = _restored(backup, target, kind, name)
        except ConflictError as error:
            report = BackupReport(kind, name, "refused", error.message)
        except DexTouchError as error:
            report = BackupReport(kind, name, "damaged", error.message)
        reports.append(report)
        on_item(report)
    return reports


def _restored(backup: EpisodeStore, target: EpisodeStore, kind: Kind, name: str) -> BackupReport:
    if not backup.exists(name, kind=kind):
        raise NotFoundError(f"{kind} {name!r}: the backup lacks it")
    reader = backup.open_item(kind, name)
    covered = deletion_of(maintenance.DeletionRecords(target.root), reader.attributes)
    if covered is not None and not covered.is_later:
        reason = f"it was permanently deleted on {covered.deleted_at:%Y-%m-%d}"
        return BackupReport(kind, name, "erased", reason)
    action: Action = "there"
    is_whole = target.exists(name, kind=kind) and not _damage(target, kind, name)
    if is_whole and _content(target, kind, name) != reader.content_sha256:
        raise ConflictError(
            f"{kind} {name!r}: {target.url} has other content; restore into an empty folder"
        )
    if not is_whole:
        reader.verify()
        copy_item(backup, target, reader, replaces=True)
        action = "copied"
    target.copy_remarks(backup, name, kind=kind, only_missing=True)
    if not is_whole and (findings := _damage(target, kind, name)):
        raise CorruptDataError("; ".join(one.message for one in findings))
    return BackupReport(kind, name, action)


@dataclass
class _Backup:
    source: EpisodeStore
    target: EpisodeStore
    before: Mapping[tuple[Kind, str], BackedUpItem]
    present: Set[tuple[Kind, str]]
    on_item: OnItem
    items: list[BackedUpItem] = field(default_factory=list)
    reports: list[BackupReport] = field(default_factory=list)

    def follow(self, kind: Kind, name: str, stamp: str) -> None:
        """Copy an item if it is new or changed; one that was deleted meanwhile is left out."""
        before = self.before.get((kind, name))
        if before is not None and (kind, name) in self.present and before.stamp == stamp:
            self._note(BackupReport(kind, name, "there"), before)
            return
        try:
            content = _content(self.source, kind, name)
            action: Action = "there"
            if content is None or content != _content(self.target, kind, name):
                reader = self.source.open_item(kind, name)
                reader.verify()
                copy_item(self.source, self.target, reader, replaces=True)
                action = "copied"
            if self.target.copy_remarks(self.source, name, kind=kind) and action == "there":
                action = "updated"
            item = BackedUpItem(kind=kind, id=name, sha256=content or "", stamp=stamp)
            self._note(BackupReport(kind, name, action), item)
        except DexTouchError as error:
            # Otherwise deleted since it was listed, so that what was copied of it is retired.
            if not stamp or self.source.exists(name, kind=kind):
                self._note(BackupReport(kind, name, "refused", error.message), before)

    def retire(self, gone: set[tuple[Kind, str]]) -> None:
        """Remove what the source lacks; what was permanently deleted there, from the trash, too."""
        records = maintenance.DeletionRecords(self.source.root)
        for kind, name in sorted(gone):
            self.target.delete(name, kind=kind)
            self._note(BackupReport(kind, name, "retired"))
        for entry in self.target.trash_list() if self.target.folders else ():
            if entry.kind != "upload":
                files = LocalGroup(entry.folder)
                files.item_id = entry.item_id
                with suppress(StorageError):
                    contents = maintenance.open_contents(files, entry.kind)
                    if deletion_of(records, contents.attributes):
                        remove_for_good(entry.folder)
                        self._note(BackupReport(entry.kind, entry.item_id, "erased"))
        if any(one.action == "erased" for one in self.reports):
            # A cache, which `store list` may have made here.
            shutil.rmtree(self.target.root / CATALOG_FOLDER, ignore_errors=True)

    def _note(self, report: BackupReport, item: BackedUpItem | None = None) -> None:
        if item is not None:
            self.items.append(item)
        self.reports.append(report)
        self.on_item(report)


def _content(store: EpisodeStore, kind: Kind, name: str) -> str | None:
    """The content hash of an item; None without it, and of a damaged one."""
    if not store.exists(name, kind=kind):
        return None
    return stated_sha256(store.files(name, kind=kind).get_now(COMMIT_FILE))


def _damage(store: EpisodeStore, kind: Kind, name: str) -> tuple[maintenance.Finding, ...]:
    return maintenance.inspect_group(store.files(name, kind=kind), kind).findings


def _check_apart(source: EpisodeStore, target: EpisodeStore, command: str) -> None:
    if source.url == target.url:
        raise InvalidInputError(f"{command}: {source.url} is both the store and its backup")
    if source.folders and target.folders:
        one, other = source.root.resolve(), target.root.resolve()
        if one.is_relative_to(other) or other.is_relative_to(one):
            raise InvalidInputError(
                f"{command}: {one} and {other} lie in one another; name a folder apart"
            )


def _begin(source: EpisodeStore, target: EpisodeStore) -> BackupList:
    """Declare an empty store a backup."""
    if any(target.list(kind=kind) for kind in KINDS):
        raise ConflictError(
            f"backup: {target.url} has items and is no backup; name an empty folder or prefix, or "
            "`dextouch store merge` the stores"
        )
    return _write_list(source, target, ())


def _write_list(
    source: EpisodeStore, target: EpisodeStore, items: Iterable[BackedUpItem]
) -> BackupList:
    listing = BackupList(
        source=source.url,
        finished_at=datetime.now(UTC),
        items=tuple(items),
        files=_kept_files(source),
    )
    target.put_file(BACKUP_FILE, listing.model_dump_json().encode())
    return listing


def _kept_files(source: EpisodeStore) -> dict[str, bytes]:
    with disk_errors(f"read what {source.root} must not forget"):
        found = {}
        for path in sorted(path for pattern in _KEPT for path in source.root.glob(pattern)):
            # Records may go while they are read.
            with suppress(FileNotFoundError):
                found[path.relative_to(source.root).as_posix()] = b64encode(path.read_bytes())
        return found


def _write_kept_files(target: EpisodeStore, listing: BackupList) -> None:
    """Write the files of a store; raises ConflictError if it has others."""
    for name, content in listing.files.items():
        if not any(fnmatchcase(name, pattern) for pattern in _KEPT) or ".." in name:
            raise CorruptDataError(f"{BACKUP_FILE}: got the file {name!r}, expected {list(_KEPT)}")
        path = target.root / name
        with disk_errors(f"write {path}"):
            if path.is_file() and path.read_bytes() != content:
                raise ConflictError(
                    f"restore-backup: {path} differs from that of the backup; restore into an "
                    "empty folder"
                )
            path.parent.mkdir(parents=True, exist_ok=True)
            replace_file(path, content, mode=0o600)
