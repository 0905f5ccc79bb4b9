"""Lenient scan of a store: operator, ids and lineage of each item, even damaged or unfinished ones.

Used for deletion, where an attributes file with a wrong hash still names its operator.
"""

import json
import re
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from dextouch.episodes.care.deletion_records import take_start
from dextouch.episodes.care.inspection import UPLOADS
from dextouch.episodes.files import disk_errors
from dextouch.episodes.format import ATTRIBUTES_KEY, COMMIT_FILE, METADATA_FILE
from dextouch.episodes.reviews import REVIEW_FILE
from dextouch.episodes.spool_seal import RECORDING_FILE
from dextouch.episodes.staged_group import STAGING
from dextouch.episodes.trash import TRASH
from dextouch.system_files import is_system_file

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
