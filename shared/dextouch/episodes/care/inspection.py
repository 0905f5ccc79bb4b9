"""Full inspection of a store: all damage by item, array and storage chunk, foreign files, stages.

A reader stops at the first damage; an inspection continues and lists all of it.
"""

import os
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from dextouch.episodes.files import disk_errors, try_lock
from dextouch.episodes.format import (
    COMMIT_FILE,
    METADATA_FILE,
    STAMPS,
    ArrayEntry,
    Kind,
    shard_path,
)
from dextouch.episodes.group_contents import GroupContents, read_group
from dextouch.episodes.reviews import REMARK_FILES
from dextouch.episodes.sources import GroupFiles, LocalGroup
from dextouch.episodes.spool import SpoolReader, read_attributes
from dextouch.episodes.spool_log import body_at, find_records, open_log
from dextouch.episodes.spool_seal import RECORDING_FILE
from dextouch.episodes.staged_group import STAGING
from dextouch.episodes.trash import HOMES
from dextouch.errors import NotFoundError, StorageError
from dextouch.schemas import EpisodeAttributes, RecordingAttributes
from dextouch.system_files import is_system_file

UPLOADS = HOMES["upload"]
Group = GroupContents[EpisodeAttributes] | GroupContents[RecordingAttributes]
# Called after every storage chunk with the number of bytes read.
Progress = Callable[[int], None]


@dataclass(frozen=True)
class Finding:
    """One damaged part; without `array` the whole item, without `chunk` the whole array."""

    message: str
    array: str | None = None
    chunk: int | None = None
    foreign: bool = False


@dataclass(frozen=True)
class ItemReport:
    """Findings on one group, unfinished upload or stage; `busy` if a writer holds its lock."""

    kind: str
    item_id: str
    num_arrays: int = 0
    num_bytes: int = 0
    findings: tuple[Finding, ...] = ()
    busy: bool = False

    @property
    def damaged(self) -> bool:
        """Whether there is any finding."""
        return bool(self.findings)


def open_contents(files: GroupFiles, kind: Kind) -> Group:
    """Open a committed group of either kind; raises as `read_group`."""
    if kind == "episode":
        return read_group(files, EpisodeAttributes)
    return read_group(files, RecordingAttributes)


def inspect_group(
    files: GroupFiles, kind: Kind, *, progress: Progress = lambda _: None
) -> ItemReport:
    """Read a committed group completely and list all damage.

    Raises:
        NotFoundError: there is no such group, or it was deleted meanwhile.
    """
    try:
        contents = open_contents(files, kind)
    except StorageError as error:
        if isinstance(files, LocalGroup) and not os.path.lexists(files.folder):
            raise NotFoundError(f"{kind} {files.item_id!r}: was deleted") from error
        return ItemReport(kind, files.item_id, findings=(Finding(error.message),))
    sizes: list[int] = []

    def count(size: int) -> None:
        sizes.append(size)
        progress(size)

    findings = [
        Finding(error.message, name, number)
        for name in contents.entries
        for number, error in contents.inspect_array(name, progress=count)
    ]
    if not findings:
        findings += _stamp_findings(contents)
    if isinstance(files, LocalGroup):
        findings += [
            Finding(f"{contents.what}: {path} belongs to no array; move it away", foreign=True)
            for path in _foreign_paths(files.folder, contents.entries)
        ]
    if findings:
        contents.opened.check_present()
    return ItemReport(kind, files.item_id, len(contents.entries), sum(sizes), tuple(findings))


def _stamp_findings(contents: Group) -> list[Finding]:
    """Stamps that are out of order, which breaks binary search in them."""
    first, strictly = STAMPS[contents.kind][0], contents.kind == "episode"
    findings = []
    for stream in contents.attributes.streams:
        name = f"{stream.name}_{first}"
        stamps = contents.shard(name).read()
        earlier, later = stamps[:-1], stamps[1:]
        if len(bad := np.flatnonzero(later <= earlier if strictly else later < earlier)):
            message = f"{contents.what}: array {name!r}: goes back after row {int(bad[0])}"
            findings.append(Finding(message, name))
    return findings


def _foreign_paths(folder: Path, entries: dict[str, ArrayEntry]) -> list[str]:
    """Files, folders and links in a group's folder that belong to no array."""
    wanted = {COMMIT_FILE, METADATA_FILE, *REMARK_FILES}
    for name, entry in entries.items():
        wanted |= {f"{name}/{METADATA_FILE}", f"{name}/{shard_path(len(entry.shape))}"}
    folders = {str(parent) for path in wanted for parent in Path(path).parents}
    found = []
    with disk_errors(f"look through {folder.name}"):
        for path in sorted(folder.rglob("*")):
            relative = path.relative_to(folder).as_posix()
            if is_system_file(relative):
                continue
            right = relative in folders if path.is_dir() else relative in wanted
            if not right or path.is_symlink():
                found.append(relative)
    return found


def inspect_upload(folder: Path) -> ItemReport:
    """Inspect an unfinished upload or any other spool; a torn tail does not count as damage."""
    with disk_errors(f"look at upload {folder.name}"):
        # A name with a dot, or a folder without attributes, is still being created.
        if not (folder / RECORDING_FILE).exists():
            return ItemReport("upload", folder.name)
    try:
        names = [stream.name for stream in read_attributes(folder).streams]
    except StorageError as error:
        return ItemReport("upload", folder.name, findings=(Finding(error.message),))
    report = _inspect_batches(folder, names)
    if not report.damaged:
        try:
            SpoolReader(folder).scan()
        except StorageError as error:
            # Closed, and not as it was then.
            return replace(report, findings=(Finding(error.message),))
    return report


def _inspect_batches(folder: Path, names: list[str]) -> ItemReport:
    what, busy = f"upload {folder.name}", is_held(folder)
    findings, torn, num_bytes = [], [], 0
    numbers = dict.fromkeys(range(len(names)), 0)
    try:
        with open_log(folder) as data:
            records = find_records(data)
            for start, stop in records.damage:
                message = f"{what}: bytes {start} … {stop - 1} of its log are not a record"
                findings.append(Finding(message))
            for row in records.rows:
                stream = int(row["stream"])
                number = numbers[stream] = numbers.get(stream, 0) + 1
                if body_at(data, row) is None:
                    name = names[stream] if stream < len(names) else str(stream)
                    message = f"{what}: batch {number - 1} of {name!r} does not match its checksum"
                    torn.append(Finding(message, name, number - 1))
                else:
                    # Data that a live writer has not written yet is neither damage nor a torn tail.
                    findings += torn
                    torn, num_bytes = [], num_bytes + int(row["length"])
    except StorageError as error:
        findings.append(Finding(f"{what}: {error.message}"))
    return ItemReport("upload", folder.name, len(names), num_bytes, tuple(findings), busy)


def inspect_stage(folder: Path) -> ItemReport:
    """Say whether a stage is that of a running writer; a sweep removes it otherwise."""
    return ItemReport("stage", folder.name, busy=is_held(folder))


def is_held(folder: Path) -> bool:
    """Whether a writer holds the lock of a stage or a spool."""
    with disk_errors(f"look at {folder.name}"):
        lock = try_lock(folder)
    if lock is not None:
        os.close(lock)
    return lock is None


def unfinished_folders(root: Path) -> Iterator[tuple[str, Path]]:
    """Kind and folder of every upload and stage below a store's folder."""
    for kind, name in (("upload", UPLOADS), ("stage", STAGING)):
        folder = root / name
        with disk_errors(f"list {name}"):
            paths = sorted(folder.iterdir()) if folder.is_dir() else []
        yield from ((kind, path) for path in paths if not is_system_file(path.name))
