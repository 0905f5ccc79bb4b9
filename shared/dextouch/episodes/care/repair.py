"""Repair of damaged groups from an intact copy, or by salvaging the readable samples.

Repairing is reversible: damaged groups go to the trash, from where they can be restored.
"""

import json
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path

from dextouch.episodes.care.salvage import (
    group_streams,
    spool_streams,
    write_salvaged,
)
from dextouch.episodes.care.store_facts import (
    UPLOADS,
    inspect_group,
    inspect_upload,
    open_contents,
)
from dextouch.episodes.files import disk_errors, replace_file
from dextouch.episodes.format import (
    ATTRIBUTES,
    COMMIT_FILE,
    MALFORMED,
    METADATA_FILE,
    ArrayEntry,
    Attributes,
    CommitRecord,
    Kind,
    array_metadata,
    attributes_id,
    decode_commit,
    group_attributes,
    kind_of,
    sha256_hex,
    shard_path,
    stream_arrays,
    with_rows,
)
from dextouch.episodes.sources import GroupFiles, LocalGroup
from dextouch.episodes.spool import read_attributes
from dextouch.episodes.trash import TrashKind, put_into_trash
from dextouch.episodes.writer import unheld_folders
from dextouch.errors import ConflictError, CorruptDataError, DexTouchError, StorageError
from dextouch.schemas import LineageEntry

WHOLE, MENDED, SALVAGED, LEFT = "whole", "mended", "salvaged", "left"


@dataclass(frozen=True)
class RepairReport:
    """Result of the repair of one item.

    `action` is `whole` (nothing to do), `mended` (restored as it was before the damage), `salvaged`
    (the readable samples are in `new_id`, the damaged group in the trash) or `left` (unchanged,
    `notes` say why). `lost` counts the samples that a salvage dropped.
    """

    kind: str
    item_id: str
    action: str
    new_id: str | None = None
    lost: Mapping[str, int] = field(default_factory=dict)
    notes: tuple[str, ...] = ()


def repair_group(
    root: Path, kind: Kind, item_id: str, *, copy: GroupFiles | None = None
) -> RepairReport:
    """Repair a committed group from a copy of the same content, or salvage its readable samples.

    Raises:
        ConflictError: a copy of other content.
    """
    files = LocalGroup(root / f"{kind}s" / item_id)
    findings = inspect_group(files, kind).findings
    if not findings:
        return RepairReport(kind, item_id, WHOLE)
    notes = tuple(finding.message for finding in findings)
    if all(finding.foreign for finding in findings):
        return RepairReport(kind, item_id, LEFT, notes=notes)
    if copy is not None:
        _repair_from(files, kind, copy)
    _rewrite_metadata(files, kind)
    if all(finding.foreign for finding in inspect_group(files, kind).findings):
        return RepairReport(kind, item_id, MENDED, notes=notes)
    return _salvage(root, kind, files.folder, notes)


def repair_uploads(root: Path) -> list[RepairReport]:
    """Salvage damaged uploads.

    Intact ones are unchanged, since their station continues them. The readable samples of damaged
    ones become a recording `ID-salvaged-N`, so that the station can send everything again.
    """
    reports = []
    for spool in unheld_folders(root / UPLOADS):
        if findings := inspect_upload(spool).findings:
            notes = tuple(finding.message for finding in findings)
            reports.append(_salvage(root, "upload", spool, notes))
    return reports


def _salvage(root: Path, kind: TrashKind, folder: Path, notes: tuple[str, ...]) -> RepairReport:
    """Write the readable samples as a new group, and put the damaged item into the trash."""
    attributes: Attributes | None
    try:
        sha256 = None
        if kind == "upload":
            attributes = read_attributes(folder)
            streams = spool_streams(folder, attributes)
        else:
            attributes, entries, sha256 = _known(LocalGroup(folder), kind)
            streams = group_streams(folder, attributes, entries)
        item_id = attributes_id(attributes)
        source = LineageEntry(kind=kind_of(attributes), id=item_id, sha256=sha256)
        new_id, lost = write_salvaged(root, attributes, streams, source)
    except DexTouchError as error:
        # Often the inspection has already found the same.
        notes = tuple(dict.fromkeys((*notes, error.message)))
        return RepairReport(kind, folder.name, LEFT, notes=notes)
    put_into_trash(root, kind, folder.name)
    return RepairReport(kind, folder.name, SALVAGED, new_id, lost, notes)


def _rewrite_metadata(files: LocalGroup, kind: Kind) -> None:
    """Rewrite the `zarr.json` of arrays, which is fully determined by the commit record."""
    try:
        contents = open_contents(files, kind)
    except StorageError:
        return
    for name, entry in contents.entries.items():
        _put(files.folder, f"{name}/{METADATA_FILE}", array_metadata(entry))


def _put(folder: Path, name: str, data: bytes) -> None:
    """Replace a file of a group; symbolic links on its path are removed, their targets kept."""
    with disk_errors(f"repair {name} of {folder.name}"):
        place = folder
        for part in name.split("/"):
            place = place / part
            if place.is_symlink():
                place.unlink()
        if place.is_file() and place.stat().st_size == len(data) and place.read_bytes() == data:
            return
        place.parent.mkdir(parents=True, exist_ok=True)
        replace_file(place, data)


def _repair_from(files: LocalGroup, kind: Kind, copy: GroupFiles) -> None:
    """Copy all files that differ or are damaged here and are intact in the copy."""
    theirs, record = open_contents(copy, kind), _commit_of(files, kind)
    if record is not None:
        same = record[1] == theirs.content_sha256
    else:
        # The attributes name the streams and their lineage, which identifies the content.
        same = files.get(METADATA_FILE) == copy.get(METADATA_FILE)
    if not same:
        raise ConflictError(
            f"{kind} {files.item_id}: the copy holds content {theirs.content_sha256[:12]}, which "
            f"is not proven to be ours ({record[1][:12] if record else f'{COMMIT_FILE} is damaged'}"
            "); name a copy of the same content"
        )
    for name in (METADATA_FILE, COMMIT_FILE):
        if (data := copy.get(name)) is not None:
            _put(files.folder, name, data)
    _rewrite_metadata(files, kind)
    ours, of_copy = _damaged_arrays(files, kind), _damaged_arrays(copy, kind)
    # A damaged image is in the copy, too: what counts is that the rest is intact there.
    for name in sorted(n for n in ours if of_copy.get(n, frozenset()) < ours[n]):
        path = f"{name}/{shard_path(len(theirs.entries[name].shape))}"
        source = copy.source(path)
        _put(files.folder, path, bytes(source.read(0, source.size() or 0)))


def _damaged_arrays(files: GroupFiles, kind: Kind) -> dict[str, frozenset[int | None]]:
    """Damaged arrays with their damaged storage chunks; None for the whole array."""
    found: dict[str, frozenset[int | None]] = {}
    for finding in inspect_group(files, kind).findings:
        if finding.array is not None:
            found[finding.array] = found.get(finding.array, frozenset()) | {finding.chunk}
    return found


def _commit_of(files: LocalGroup, kind: Kind) -> tuple[CommitRecord, str] | None:
    what = f"{kind} {files.item_id}"
    try:
        data = files.get(COMMIT_FILE)
        return None if data is None else decode_commit(data, what=what)
    except CorruptDataError:
        return None


def _known(
    files: LocalGroup, kind: Kind
) -> tuple[Attributes, Mapping[str, ArrayEntry], str | None]:
    """Trustworthy attributes, arrays and content hash of a damaged group.

    Raises:
        StorageError: another version, or attributes that are damaged.
    """
    what = f"{kind} {files.item_id}"
    record, group = _commit_of(files, kind), files.get(METADATA_FILE)
    if group is None or (record and sha256_hex(group) != record[0].attributes_sha256):
        raise CorruptDataError(
            f"{what}: attributes are damaged, and samples cannot be interpreted without them; "
            "name a copy with --from, or delete it"
        )
    try:
        attributes: Attributes = group_attributes(group, ATTRIBUTES[kind])
    except MALFORMED as error:
        raise CorruptDataError(f"{what}: attributes are damaged ({error})") from error
    if attributes_id(attributes) != files.item_id:
        raise CorruptDataError(f"{what}: attributes are those of {attributes_id(attributes)!r}")
    if record is not None:
        return attributes, record[0].arrays, record[1]
    return attributes, _entries(files, attributes), None


def _entries(files: LocalGroup, attributes: Attributes) -> dict[str, ArrayEntry]:
    """Array entries without a commit record, with the lengths of the arrays' own metadata."""
    entries = {}
    for stream in attributes.streams:
        for name, entry in stream_arrays(stream, kind_of(attributes)).items():
            try:
                plain = json.loads(files.get(f"{name}/{METADATA_FILE}") or b"")
                count = int(plain["shape"][0])
            except (ValueError, KeyError, TypeError, IndexError, RecursionError):
                count = 0
            entries[name] = with_rows(entry, max(0, count))
    return entries
