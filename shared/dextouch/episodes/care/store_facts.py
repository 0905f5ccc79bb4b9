"""Lenient scan of a store: operator, ids and lineage of each item, even damaged or unfinished ones.

Used for deletion, where an attributes file with a wrong hash still names its operator.
"""

import json
import os
import re
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from dextouch.data_folder import is_system_file
from dextouch.episodes.care.deletion_records import take_start
from dextouch.episodes.files import disk_errors, try_lock
from dextouch.episodes.format import (
    ATTRIBUTES_KEY,
    COMMIT_FILE,
    METADATA_FILE,
    STAMPS,
    ArrayEntry,
    Kind,
    shard_path,
)
from dextouch.episodes.group_contents import GroupContents, read_group
from dextouch.episodes.sources import GroupFiles, LocalGroup
from dextouch.episodes.spool import SpoolReader, read_attributes
from dextouch.episodes.spool_log import RECORDING_FILE, body_at, find_records, open_log
from dextouch.episodes.trash import HOMES, REMARK_FILES, REVIEW_FILE, TRASH
from dextouch.episodes.writer import STAGING
from dextouch.errors import NotFoundError, StorageError
from dextouch.schemas import EpisodeAttributes, RecordingAttributes

# Full inspection of a store: all damage by item, array and storage chunk, foreign files, stages.
#
# A reader stops at the first damage; an inspection continues and lists all of it.

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


# Folders of a store and the kind of group in each.
PLACES: dict[str, str] = {
    "episodes": "episode",
    "recordings": "recording",
    UPLOADS: "recording",
    STAGING: "",
    TRASH: "",
}
MAX_BYTES = 16 << 20
# Files with attributes, and the keys under which they lie.
_ATTRIBUTES = {
    METADATA_FILE: ("attributes", ATTRIBUTES_KEY),
    RECORDING_FILE: (),
}
_SAMPLES = ".log"
_WORD = "A-Za-z0-9_-"
_AROUND = {
    STAGING: re.compile(r"(episode|recording)-(.+)-[0-9a-f]{32}"),
    TRASH: re.compile(r"(episode|recording|upload)\.(.+)\.[0-9]+"),
}


@dataclass(frozen=True)
class Facts:
    """Identity of one folder of a store, even a damaged or unfinished one.

    `item_id` and `kind` are those of its (intended) group; `lineage` the kinds, ids and hashes of
    its sources, `reviewer` the pseudonym in its review; `readable` is false where nothing could be
    parsed. `started` is `take_start` of a recording.
    """

    folder: Path
    place: str
    kind: str
    item_id: str
    operator: str | None
    reviewer: str | None
    lineage: tuple[tuple[str, str, str | None], ...]
    sha256: str | None
    readable: bool
    station: str | None = None
    started: str = ""


def all_facts(root: Path) -> list[Facts]:
    """Facts of every group, upload, stage and trash entry below a store's folder."""
    found = []
    for place in PLACES:
        with disk_errors(f"list {place}"):
            paths = sorted((root / place).iterdir()) if (root / place).is_dir() else []
        found += [_facts(path, place) for path in paths if not is_system_file(path.name)]
    return found


def _facts(folder: Path, place: str) -> Facts:
    kind, item_id = _named(folder.name, place)
    attributes = next(filter(None, (_dict(folder / n, *k) for n, k in _ATTRIBUTES.items())), {})
    for known in ("episode", "recording"):
        if isinstance(attributes.get(f"{known}_id"), str):
            kind, item_id = known, attributes[f"{known}_id"]
    entries = attributes.get("lineage")
    lineage = tuple(
        (str(entry.get("kind")), str(entry.get("id")), _text(entry.get("sha256")))
        for entry in (entries if isinstance(entries, list) else [])
        if isinstance(entry, dict)
    )
    return Facts(
        folder=folder,
        place=place,
        kind=kind,
        item_id=item_id,
        operator=_text(attributes.get("operator")),
        reviewer=_text(_dict(folder / REVIEW_FILE).get("reviewer")),
        lineage=lineage,
        sha256=_text(_dict(folder / COMMIT_FILE).get("sha256")),
        readable=bool(attributes) or not any(small_files(folder)),
        station=_text(attributes.get("station")),
        started=take_start(attributes.get("started_at"), attributes.get("started_t_host_ns")),
    )


def _named(name: str, place: str) -> tuple[str, str]:
    """Kind and id from the name of a folder."""
    match = _AROUND[place].fullmatch(name) if place in _AROUND else None
    if match is None:
        return PLACES[place], name.removesuffix(".new")
    return {"upload": "recording"}.get(match[1], match[1]), match[2]


def small_files(folder: Path) -> Iterator[Path]:
    """Metadata files directly in a folder, without samples."""
    if folder.is_file():
        yield folder
    with disk_errors(f"look through {folder.name}"):
        for path in sorted(folder.iterdir()) if folder.is_dir() else []:
            if path.suffix != _SAMPLES and path.is_file() and path.stat().st_size <= MAX_BYTES:
                yield path


def _dict(path: Path, *keys: str) -> dict[str, Any]:
    """The object under nested keys of a JSON file; empty where there is none."""
    with disk_errors(f"read {path.name}"):
        data = path.read_bytes() if path.is_file() else b""
    try:
        value = json.loads(data)
    except (ValueError, RecursionError):
        return {}
    for key in keys:
        value = value.get(key) if isinstance(value, dict) else None
    return value if isinstance(value, dict) else {}


def _text(value: object) -> str | None:
    return value if isinstance(value, str) else None


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
            texts = "\0".join(_strings(json.loads(data)))
        except (ValueError, RecursionError):
            text = data.decode(errors="replace")
            escaped = {word for word in self._words if json.dumps(word)[1:-1] in text}
            return sorted(escaped.union(self.in_text(text)))
        return self.in_text(texts)

    def in_text(self, text: str) -> list[str]:
        """Identifiers in a text."""
        return sorted(set(self._pattern.findall(text)))


def _strings(value: object) -> Iterator[str]:
    waiting = [value]
    while waiting:
        item = waiting.pop()
        if isinstance(item, str):
            yield item
        elif isinstance(item, dict):
            waiting += [*item.keys(), *item.values()]
        elif isinstance(item, list):
            waiting += item
