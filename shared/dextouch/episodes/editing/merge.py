"""Merges of stores: every item of one or more stores copied into another, exactly as it is.

Each item is verified before it is copied, and committed atomically: a merge that was interrupted is
repeated, and goes on where it stopped.
"""

import itertools
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from typing import Literal

from pydantic import BaseModel

from dextouch.episodes.care import DeletionRecords, TakeFacts
from dextouch.episodes.editing.relabel import with_attributes
from dextouch.episodes.format import (
    COMMIT_FILE,
    KINDS,
    METADATA_FILE,
    Attributes,
    Kind,
    attributes_id,
    kind_of,
)
from dextouch.episodes.reader import EpisodeReader, RecordingReader
from dextouch.episodes.store import EpisodeStore
from dextouch.episodes.trash import CLICKS_FILE, NOTES_FILE, REVIEW_FILE
from dextouch.errors import DexTouchError, InvalidInputError, NotFoundError
from dextouch.schemas import (
    EpisodeClicks,
    ItemNotes,
    LineageEntry,
    RecordingAttributes,
    Review,
)

OnItem = Callable[["MergeReport"], None]


@dataclass(frozen=True)
class MergeOptions:
    """Options of a merge.

    Args:
        rename: give an item whose id other content has a new id, `ID-merged-1`; otherwise it is
            refused.
        dry_run: nothing is written.
    """

    rename: bool = False
    dry_run: bool = False


@dataclass(frozen=True)
class MergeReport:
    """What became of one item: copied as `new_id`, in the store already, or refused for a reason.

    `remarks` are the reviews, clicks and notes that an item in the store got from its copy.
    """

    kind: Kind
    item_id: str
    source: str
    action: Literal["copied", "there", "refused"]
    new_id: str = ""
    reason: str = ""
    remarks: tuple[str, ...] = ()


def merge_stores(
    sources: Sequence[EpisodeStore],
    target: EpisodeStore,
    *,
    options: MergeOptions,
    on_item: OnItem = lambda _: None,
) -> list[MergeReport]:
    """Copy all items of some stores into one; recordings first, in the order of their ids.

    What is damaged, or was permanently deleted from the target, is refused, and the rest is copied.
    Reviews, clicks and notes come along, and go to an equal item in the target that has none.

    Raises:
        InvalidInputError: the target is one of the sources.
        NotFoundError: a source without any item.
    """
    reports = []
    for source in sources:
        if source.url == target.url or (source.folders and _same_folder(source, target)):
            raise InvalidInputError(f"merge: {source.url} is the store to merge into; name others")
        listed = [(kind, name) for kind in KINDS for name in source.list(kind=kind)]
        if not listed:
            raise NotFoundError(f"merge: store {source.url} has no item; check its path")
        for kind, name in sorted(listed, key=lambda item: (item[0] != "recording", item[1])):
            try:
                report = _merge(source, target, kind, name, options)
            except DexTouchError as error:
                report = MergeReport(kind, name, source.url, "refused", reason=error.message)
            reports.append(report)
            on_item(report)
    return reports


def _same_folder(source: EpisodeStore, target: EpisodeStore) -> bool:
    return bool(target.folders) and source.root.resolve() == target.root.resolve()


def _merge(
    source: EpisodeStore, target: EpisodeStore, kind: Kind, name: str, options: MergeOptions
) -> MergeReport:
    reader = _open(source, kind, name)
    _check_not_deleted(target, reader)
    new_id, attributes = name, reader.attributes
    if target.exists(name, kind=kind):
        if _open(target, kind, name).content_sha256 == reader.content_sha256:
            moved = _add_remarks(source, target, kind, name, dry_run=options.dry_run)
            return MergeReport(kind, name, source.url, "there", name, remarks=moved)
        if not options.rename:
            reason = f"{kind} {name!r} of the target has other content; --rename copies it as well"
            return MergeReport(kind, name, source.url, "refused", reason=reason)
        entry = LineageEntry(
            kind=kind, id=name, sha256=reader.content_sha256, operation="merge --rename"
        )
        new_id, is_done = _free_id(target, kind, name, entry)
        if is_done:
            return MergeReport(kind, name, source.url, "there", new_id)
        changes = {f"{kind}_id": new_id, "lineage": (*attributes.lineage, entry)}
        attributes = attributes.model_copy(update=changes)
    if not options.dry_run:
        reader.verify()
        _copy(source, target, reader, attributes)
    return MergeReport(kind, name, source.url, "copied", new_id)


def _open(store: EpisodeStore, kind: Kind, name: str) -> EpisodeReader | RecordingReader:
    return store.open(name) if kind == "episode" else store.recording(name)


def _check_not_deleted(target: EpisodeStore, reader: EpisodeReader | RecordingReader) -> None:
    """Refuse what was permanently deleted from the target, with its operator or its recording."""
    records, about = DeletionRecords(target.root), reader.attributes
    if isinstance(about, RecordingAttributes):
        takes = [TakeFacts.of(about)]
    else:
        names = [entry.id for entry in about.lineage if entry.kind == "recording"]
        takes = [
            TakeFacts(
                recording_id=name,
                station=about.station or "",
                started="",
                operator=about.operator,
                started_at=about.created_at,
                is_damaged=True,
            )
            for name in names or [about.episode_id]
        ]
    for take in takes:
        covered = records.find(take)
        if covered is not None:
            raise InvalidInputError(
                f"{reader.item_id!r}: it, its recording or its operator was permanently deleted "
                f"from the target on {covered.deleted_at:%Y-%m-%d}"
            )


def _free_id(target: EpisodeStore, kind: Kind, name: str, entry: LineageEntry) -> tuple[str, bool]:
    """A free id `NAME-merged-N`, or that of an earlier run's copy and True."""
    for number in itertools.count(1):
        new_id = f"{name[:112]}-merged-{number}"
        if not target.exists(new_id, kind=kind):
            return new_id, False
        if entry in _open(target, kind, new_id).attributes.lineage:
            return new_id, True
    raise AssertionError("numbers do not end")


def _copy(
    source: EpisodeStore,
    target: EpisodeStore,
    reader: EpisodeReader | RecordingReader,
    attributes: Attributes,
) -> None:
    """Copy a group with what is beside its content, byte for byte unless its attributes change."""
    kind, name = kind_of(attributes), reader.item_id
    files = source.files(name, kind=kind)
    if attributes_id(attributes) == name:
        metadata, commit = files.get(METADATA_FILE), files.get(COMMIT_FILE)
    else:
        metadata, commit = with_attributes(files, attributes)
    if metadata is None or commit is None:
        raise NotFoundError(f"{kind} {name!r}: was deleted while it was copied")
    # Its streams are files that exist already.
    shell = attributes.model_copy(update={"streams": ()})
    with target.writer(kind=kind, attributes=shell) as writer:
        writer.take_files(files, metadata=metadata, commit=commit, link=False)
        for remark, found in _remarks(source, kind, name).items():
            if found is not None:
                writer.add_remark(remark, found)


def _remarks(store: EpisodeStore, kind: Kind, name: str) -> dict[str, BaseModel | None]:
    notes = store.notes(name, kind=kind)
    return {
        REVIEW_FILE: store.review(name, kind=kind),
        CLICKS_FILE: store.clicks(name) if kind == "episode" else None,
        NOTES_FILE: notes if notes.notes else None,
    }


def _instead(notes: ItemNotes, _: ItemNotes) -> ItemNotes:
    return notes


def _add_remarks(
    source: EpisodeStore, target: EpisodeStore, kind: Kind, name: str, *, dry_run: bool
) -> tuple[str, ...]:
    """Give an item in the target the remarks that only its copy has; returns their names."""
    theirs, ours = _remarks(source, kind, name), _remarks(target, kind, name)
    added = {key: found for key, found in theirs.items() if found and ours[key] is None}
    if not dry_run:
        for found in added.values():
            if isinstance(found, Review):
                target.set_review(name, found, kind=kind)
            elif isinstance(found, EpisodeClicks):
                target.set_clicks(name, found)
            elif isinstance(found, ItemNotes):
                target.change_notes(name, partial(_instead, found), kind=kind)
    return tuple(key.removesuffix(".json") for key in added)
