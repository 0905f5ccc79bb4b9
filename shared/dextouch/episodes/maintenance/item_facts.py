"""Identity of every folder of a store, even a damaged or unfinished one, for deletions."""

import json
import re
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from dextouch.data_folder import is_system_file
from dextouch.episodes.files import MAX_METADATA_BYTES, disk_errors
from dextouch.episodes.format import ATTRIBUTES_KEY, COMMIT_FILE, METADATA_FILE
from dextouch.episodes.maintenance.deletion_records import take_start
from dextouch.episodes.spool_log import RECORDING_FILE
from dextouch.episodes.staging import STAGING
from dextouch.episodes.trash import HOMES, NOTES_FILE, REVIEW_FILE, TRASH

# Folders of a store and the kind of group in each.
PLACES: dict[str, str] = {
    "episodes": "episode",
    "recordings": "recording",
    HOMES["upload"]: "recording",
    STAGING: "",
    TRASH: "",
}
# Files with attributes, and the keys under which they lie.
_ATTRIBUTES = {METADATA_FILE: ("attributes", ATTRIBUTES_KEY), RECORDING_FILE: ()}
_SAMPLES = ".log"
# Remarks that name who wrote them, and the keys under which they do.
SIGNED_FILES = (REVIEW_FILE, NOTES_FILE)
_SIGNED = ("reviewer", "author")
_AROUND = {
    STAGING: re.compile(r"(episode|recording)-(.+)-[0-9a-f]{32}"),
    TRASH: re.compile(r"(episode|recording|upload)\.(.+)\.[0-9]+"),
}


@dataclass(frozen=True)
class Facts:
    """Identity of one folder of a store, even a damaged or unfinished one.

    `item_id` and `kind` are those of its (intended) group; `lineage` the kinds, ids and hashes of
    its sources, and the operations of edits; `authors` the pseudonyms in its review and
    notes; `readable` is false where nothing could be parsed. `started` is `take_start` of a
    recording.
    """

    folder: Path
    place: str
    kind: str
    item_id: str
    operator: str | None
    authors: frozenset[str]
    lineage: tuple[tuple[str, str, str | None, str], ...]
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
    attributes = next(filter(None, (read_dict(folder / n, *k) for n, k in _ATTRIBUTES.items())), {})
    for known in ("episode", "recording"):
        if isinstance(attributes.get(f"{known}_id"), str):
            kind, item_id = known, attributes[f"{known}_id"]
    entries = attributes.get("lineage")
    lineage = tuple(
        (
            str(entry.get("kind")),
            str(entry.get("id")),
            _text(entry.get("sha256")),
            _text(entry.get("operation")) or "",
        )
        for entry in (entries if isinstance(entries, list) else [])
        if isinstance(entry, dict)
    )
    return Facts(
        folder=folder,
        place=place,
        kind=kind,
        item_id=item_id,
        operator=_text(attributes.get("operator")),
        authors=frozenset(
            name for remark in SIGNED_FILES for name in authors_in(read_dict(folder / remark))
        ),
        lineage=lineage,
        sha256=_text(read_dict(folder / COMMIT_FILE).get("sha256")),
        readable=bool(attributes) or not any(small_files(folder)),
        station=_text(attributes.get("station")),
        started=take_start(attributes.get("started_at"), attributes.get("started_t_host_ns")),
    )


def _named(name: str, place: str) -> tuple[str, str]:
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
            if (
                path.suffix != _SAMPLES
                and path.is_file()
                and path.stat().st_size <= MAX_METADATA_BYTES
            ):
                yield path


def read_dict(path: Path, *keys: str) -> dict[str, Any]:
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


def authors_in(value: object) -> Iterator[str]:
    """Pseudonyms of those who wrote a remark, or parts of it."""
    if isinstance(value, dict):
        yield from (name for key in _SIGNED if isinstance(name := value.get(key), str))
        value = list(value.values())
    for one in value if isinstance(value, list) else ():
        yield from authors_in(one)


def without_author(value: object, name: str | None) -> object:
    """A remark in which no part says that somebody wrote it."""
    if isinstance(value, list):
        return [without_author(one, name) for one in value]
    if not isinstance(value, dict):
        return value
    return {
        key: None if key in _SIGNED and one == name else without_author(one, name)
        for key, one in value.items()
    }


def _text(value: object) -> str | None:
    return value if isinstance(value, str) else None
