"""Inspection of a store for damage, and repair from a copy or by salvage of what is whole."""

import json
import math
import os
from collections.abc import Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np
from pydantic import BaseModel

from dextouch.data_folder import is_system_file
from dextouch.episodes.files import (
    PARTIAL,
    GroupFiles,
    LocalGroup,
    disk_errors,
    replace_file,
    try_lock,
    unheld_folders,
)
from dextouch.episodes.format import (
    ATTRIBUTES,
    COMMIT_FILE,
    MALFORMED,
    METADATA_FILE,
    STAMPS,
    ArrayEntry,
    Attributes,
    CommitRecord,
    Kind,
    Version,
    array_files,
    array_metadata,
    attributes_id,
    decode_commit,
    group_attributes,
    kind_of,
    numbered_ids,
    sha256_hex,
    shard_path,
    stream_arrays,
    version_of_group,
    with_rows,
)
from dextouch.episodes.groups import GroupContents, read_group
from dextouch.episodes.maintenance.salvage import (
    SalvagedStream,
    group_streams,
    on_one_grid,
    spool_streams,
)
from dextouch.episodes.spool import SpoolReader, read_attributes
from dextouch.episodes.spool_log import RECORDING_FILE, body_at, find_records, open_log
from dextouch.episodes.staging import DOWNLOADS, STAGING, new_stage
from dextouch.episodes.store import EpisodeStore
from dextouch.episodes.trash import (
    HOMES,
    NOTES_FILE,
    REMARK_FILES,
    REVIEW_FILE,
    TrashKind,
    put_into_trash,
    read_remark,
)
from dextouch.episodes.writer import EpisodeWriter
from dextouch.errors import (
    ConflictError,
    CorruptDataError,
    DexTouchError,
    InvalidInputError,
    NotFoundError,
    StorageError,
)
from dextouch.schemas import (
    EpisodeAttributes,
    ItemNotes,
    LedgerEntry,
    LineageEntry,
    RecordingAttributes,
    Review,
    superseded,
)

UPLOADS = HOMES["upload"]
Group = GroupContents[EpisodeAttributes] | GroupContents[RecordingAttributes]
WHOLE, REPAIRED, SALVAGED, LEFT = "whole", "repaired", "salvaged", "left"
LOST = "lost_to_damage"


@dataclass(frozen=True)
class Finding:
    """One damaged part: of an item, or of an array, or a storage chunk or an image of it."""

    message: str
    array: str | None = None
    chunk: int | None = None
    image: int | None = None
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


def inspect_group(files: GroupFiles, kind: Kind) -> ItemReport:
    """Read a committed group completely and list all damage.

    Raises NotFoundError if there is no such group, or it was deleted meanwhile.
    """
    try:
        contents = open_contents(files, kind)
    except StorageError as error:
        if isinstance(files, LocalGroup) and not os.path.lexists(files.folder):
            raise NotFoundError(f"{kind} {files.item_id!r}: was deleted") from error
        return ItemReport(kind, files.item_id, findings=(Finding(error.message),))
    sizes: list[int] = []
    findings = []
    for name in contents.entries:
        for number, damage in contents.inspect_array(name, progress=sizes.append):
            image = damage.details.get("image")
            findings.append(
                Finding(damage.message, name, number, image if isinstance(image, int) else None)
            )
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
    # A killed program may have left a part of a remark, which the next one replaces.
    partial = (name + PARTIAL for name in REMARK_FILES)
    wanted = {COMMIT_FILE, METADATA_FILE, *REMARK_FILES, *partial} | array_files(entries)
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


def is_held(folder: Path) -> bool:
    """Whether a writer holds the lock of a stage or a spool."""
    with disk_errors(f"look at {folder.name}"):
        lock = try_lock(folder)
    if lock is not None:
        os.close(lock)
    return lock is None


def inspect_unfinished(root: Path) -> Iterator[ItemReport]:
    """Inspect every upload, stage and download below a store's folder."""
    for kind, name in (("upload", UPLOADS), ("stage", STAGING), ("download", DOWNLOADS)):
        folder = root / name
        with disk_errors(f"list {name}"):
            paths = sorted(folder.iterdir()) if folder.is_dir() else []
        for path in paths:
            if is_system_file(path.name):
                continue
            if not path.is_dir() or path.is_symlink():
                finding = Finding(
                    f"{kind} {path.name}: is not a folder; move it away", foreign=True
                )
                yield ItemReport(kind, path.name, findings=(finding,))
            elif kind == "upload":
                yield inspect_upload(path)
            else:
                # Where it is not busy, a sweep removes it.
                yield ItemReport(kind, path.name, busy=is_held(path))


@dataclass(frozen=True)
class RepairReport:
    """Result of the repair of one item.

    `action` is `whole` (nothing to do), `repaired` (restored as it was before the damage),
    `salvaged` (the readable samples are in `new_id`, the damaged group in the trash) or `left`
    (unchanged, `notes` say why). `lost` counts the samples that a salvage dropped.
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
    """Repair a group from a copy of the same content, or salvage its readable samples.

    Raises ConflictError for a copy of other content.
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
        return RepairReport(kind, item_id, REPAIRED, notes=notes)
    return _salvage(root, kind, files.folder, notes)


def repair_uploads(root: Path) -> list[RepairReport]:
    """Salvage damaged uploads; intact ones are unchanged, since their station continues them.

    Their readable samples become a recording `ID-salvaged-N`: the station can send everything
    again.
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
        remarks = _remarks(folder)
        new_id, lost = _write_salvaged(root, attributes, streams, source, remarks)
        _supersede_sources(root, attributes, new_id)
    except DexTouchError as error:
        # Often the inspection has already found the same.
        notes = tuple(dict.fromkeys((*notes, error.message)))
        return RepairReport(kind, folder.name, LEFT, notes=notes)
    put_into_trash(root, kind, folder.name)
    return RepairReport(kind, folder.name, SALVAGED, new_id, lost, notes)


def _write_salvaged(
    root: Path,
    attributes: Attributes,
    streams: Sequence[SalvagedStream],
    source: LineageEntry,
    remarks: Mapping[str, BaseModel],
) -> tuple[str, dict[str, int]]:
    """Write the readable samples of a damaged item, the source, as a new group `ID-salvaged-N`.

    Returns its id, also if an interrupted repair wrote it, and the number of dropped samples by
    stream. Raises InvalidInputError if no sample is readable.
    """
    kind, item_id = kind_of(attributes), attributes_id(attributes)
    streams = on_one_grid(streams) if kind == "episode" else list(streams)
    if not any(stream.kept.any() for stream in streams):
        raise InvalidInputError(f"{kind} {item_id!r}: no sample is intact; delete it")
    lost = {stream.descriptor.name: stream.num_lost for stream in streams if stream.num_lost}
    for folder in sorted((root / f"{kind}s").glob(f"{item_id[:112]}-salvaged-*")):
        with suppress(StorageError):
            if source in open_contents(LocalGroup(folder), kind).attributes.lineage:
                return folder.name, lost
    names = numbered_ids(item_id, "salvaged")
    free = next(name for name in names if not (root / f"{kind}s" / name).exists())
    lineage = (*attributes.lineage, source)
    update = {f"{kind}_id": free, "recovered": True, "lineage": lineage}
    with EpisodeWriter(
        stage=new_stage(root, kind, free),
        target=root / f"{kind}s" / free,
        attributes=attributes.model_copy(update=update | _changed(attributes, streams, lost)),
    ) as writer:
        for stream in streams:
            for values, stamps in stream.blocks():
                writer.append(stream.descriptor.name, values=values, **stamps)
        for name, remark in remarks.items():
            writer.add_remark(name, remark)
    return free, lost


def _remarks(folder: Path) -> dict[str, BaseModel]:
    """What people said of a damaged item that holds for its readable samples."""
    found: dict[str, BaseModel | None] = {}
    forms: dict[str, type[BaseModel]] = {REVIEW_FILE: Review, NOTES_FILE: ItemNotes}
    for name, form in forms.items():
        with suppress(StorageError):
            found[name] = read_remark(LocalGroup(folder), name, form, what=folder.name)
    return {name: remark for name, remark in found.items() if remark is not None}


def _supersede_sources(root: Path, attributes: Attributes, new_id: str) -> None:
    """Let what an edited item supersedes be superseded by what was salvaged of it."""
    item_id, store = attributes_id(attributes), EpisodeStore(root)

    def change(review: Review | None) -> Review | None:
        is_of_it = review is not None and item_id in review.superseded_by
        return superseded(review, new_id) if is_of_it else review

    for entry in attributes.lineage:
        if entry.is_edit and entry.kind == kind_of(attributes):
            store.change_source_review(entry, change)


def _changed(
    attributes: Attributes, streams: Sequence[SalvagedStream], lost: Mapping[str, int]
) -> dict[str, object]:
    """Milestones within the steps left, from their first, and where dropped samples are counted.

    They are in the quality of an episode and in the ledger of a take.
    """
    if isinstance(attributes, EpisodeAttributes):
        figures = {f"{name}_{LOST}": float(count) for name, count in lost.items()}
        steps = next((one.kept for one in streams if one.descriptor.name == "action"), None)
        first_s, last_s = 0.0, math.inf
        if steps is not None:
            kept = np.flatnonzero(steps)
            first_s, last_s = (int(kept[end]) / attributes.model_rate_hz for end in (0, -1))
        times_s = {
            name: t - first_s
            for name, t in attributes.event_times_s.items()
            if first_s <= t <= last_s
        }
        return {"quality": attributes.quality | figures, "event_times_s": times_s}
    entries = (LedgerEntry(stream=name, event=LOST, count=count) for name, count in lost.items())
    return {"ledger": (*attributes.ledger, *entries)}


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


def _damaged_arrays(files: GroupFiles, kind: Kind) -> dict[str, frozenset[tuple[object, object]]]:
    found: dict[str, frozenset[tuple[object, object]]] = {}
    for finding in inspect_group(files, kind).findings:
        if finding.array is not None:
            found[finding.array] = found.get(finding.array, frozenset()) | {
                (finding.chunk, finding.image)
            }
    return found


def _commit_of(files: LocalGroup, kind: Kind) -> tuple[CommitRecord, str] | None:
    what = f"{kind} {files.item_id}"
    try:
        data = files.get(COMMIT_FILE)
        return None if data is None else decode_commit(data, what=what)
    except CorruptDataError as error:
        if "too_large" in error.details:
            # It may be whole: a salvage would only be a copy.
            raise
        return None


def _known(
    files: LocalGroup, kind: Kind
) -> tuple[Attributes, Mapping[str, ArrayEntry], str | None]:
    """Trustworthy attributes, arrays and content hash of a damaged group.

    Raises StorageError for another version, or damaged attributes.
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
    return attributes, _entries(files, attributes, version_of_group(group)), None


def _entries(files: LocalGroup, attributes: Attributes, version: Version) -> dict[str, ArrayEntry]:
    """Array entries without a commit record, with the lengths of the arrays' own metadata."""
    entries = {}
    for stream in attributes.streams:
        for name, entry in stream_arrays(stream, kind_of(attributes), version).items():
            try:
                plain = json.loads(files.get(f"{name}/{METADATA_FILE}") or b"")
                count = int(plain["shape"][0])
            except (ValueError, KeyError, TypeError, IndexError, RecursionError):
                count = 0
            entries[name] = with_rows(entry, max(0, count))
    return entries
