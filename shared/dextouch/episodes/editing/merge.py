"""Merges of stores: every item of one or more stores copied into another, exactly as it is."""

from collections import defaultdict
from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, field
from functools import cached_property, partial
from types import MappingProxyType
from typing import Literal

from pydantic import BaseModel

from dextouch.episodes.editing.edits import with_attributes
from dextouch.episodes.files import LocalGroup
from dextouch.episodes.format import (
    COMMIT_FILE,
    KINDS,
    METADATA_FILE,
    Attributes,
    Kind,
    attributes_id,
    kind_of,
    numbered_ids,
)
from dextouch.episodes.maintenance import Covered, DeletionRecords, TakeFacts, open_contents
from dextouch.episodes.reader import EpisodeReader, RecordingReader
from dextouch.episodes.store import EpisodeStore
from dextouch.episodes.trash import CLICKS_FILE, NOTES_FILE, REVIEW_FILE, TRASH
from dextouch.errors import DexTouchError, InvalidInputError, NotFoundError
from dextouch.schemas import (
    MERGED,
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
    Reviews, clicks and notes come along, and go to an equal item in the target that has none. What
    was edited or put into the trash in the target since an earlier merge is there.

    Raises:
        InvalidInputError: the target is one of the sources.
        NotFoundError: a source without any item.
    """
    reports, origins = [], _Origins(target)
    for source in sources:
        are_folders = source.folders and target.folders
        is_same = are_folders and source.root.resolve() == target.root.resolve()
        if source.url == target.url or is_same:
            raise InvalidInputError(f"merge: {source.url} is the store to merge into; name others")
        listed = [(kind, name) for kind in KINDS for name in source.list(kind=kind)]
        if not listed:
            raise NotFoundError(f"merge: store {source.url} has no item; check its path")
        run = _Merge(source, target, options, origins)
        for kind, name in sorted(listed, key=lambda item: (item[0] != "recording", item[1])):
            try:
                report = run.merge(kind, name)
            except DexTouchError as error:
                report = MergeReport(kind, name, source.url, "refused", reason=error.message)
            reports.append(report)
            on_item(report)
        run.rename_results()
    return reports


class _Origins:
    """What the items of a store were made from by edits and merges, and what is in its trash."""

    def __init__(self, store: EpisodeStore) -> None:
        self._store = store
        # What a dry run would have copied so far: hashes by kind and new id, and the reverse.
        self.planned: dict[tuple[str, str], str] = {}
        self.planned_ids: dict[tuple[str, str], str] = {}

    @cached_property
    def _found(self) -> defaultdict[tuple[str, str], list[LineageEntry]]:
        """Items by the kind and hash of what they came from; `operation` is TRASH of trash."""
        found: defaultdict[tuple[str, str], list[LineageEntry]] = defaultdict(list)
        stored, trash = self._store, self._store.trash_list() if self._store.folders else ()
        for kind in KINDS:
            groups = [(stored.files(name, kind=kind), "") for name in stored.list(kind=kind)]
            for entry in trash:
                if entry.kind == kind:
                    deleted = LocalGroup(entry.folder)
                    # Not the name of the folder, which has a time.
                    deleted.item_id = entry.item_id
                    groups.append((deleted, TRASH))
            for files, place in groups:
                with suppress(DexTouchError):
                    group = open_contents(files, kind)
                    item = LineageEntry(
                        kind=kind,
                        id=attributes_id(group.attributes),
                        sha256=group.content_sha256,
                        operation=place,
                    )
                    if place:
                        found[kind, group.content_sha256].append(item)
                    for source in group.attributes.lineage:
                        if source.operation and source.kind == kind and source.sha256:
                            found[kind, source.sha256].append(item)
        return found

    def add(self, source: LineageEntry, item: LineageEntry) -> None:
        self._found[source.kind, source.sha256 or ""].append(item)

    def made_of(self, kind: Kind, sha256: str, other: EpisodeStore) -> LineageEntry | None:
        """What an item has become here, unless the other store has that, too."""
        for item in self._found[kind, sha256]:
            is_itself = item.operation and item.sha256 == sha256
            if is_itself or not other.has_source(item):
                return item
        return None


@dataclass
class _Merge:
    """A merge of one store: items that got another id, and those that were edited."""

    source: EpisodeStore
    target: EpisodeStore
    options: MergeOptions
    origins: _Origins
    # By kind and id: what the source has, and its copy.
    renamed: dict[tuple[str, str], tuple[LineageEntry, LineageEntry]] = field(default_factory=dict)
    # Copies of superseded items, with their reviews.
    marked: list[tuple[LineageEntry, Review]] = field(default_factory=list)

    def merge(self, kind: Kind, name: str) -> MergeReport:
        """Copy an item, unless the target has or had it; raises DexTouchError if it cannot."""
        source, target = self.source, self.target
        reader = source.open_item(kind, name)
        sha256 = reader.content_sha256
        covered = deletion_of(DeletionRecords(target.root), reader.attributes)
        if covered is not None:
            raise InvalidInputError(
                f"{name!r}: it, its recording or its operator was permanently deleted from the "
                f"target on {covered.deleted_at:%Y-%m-%d}"
            )
        if (planned_id := self.origins.planned_ids.get((kind, sha256))) is not None:
            return MergeReport(kind, name, source.url, "there", planned_id)
        ours = self._sha256_in_target(kind, name)
        remarks = self._remarks(kind, name)
        if ours == sha256:
            moved = self._add_remarks(kind, name, remarks)
            self._note_results(kind, name, sha256, remarks)
            return MergeReport(kind, name, source.url, "there", name, remarks=moved)
        entry = LineageEntry(kind=kind, id=name, sha256=sha256, operation=MERGED)
        if (made := self.origins.made_of(kind, sha256, source)) is not None:
            last = (
                None if made.operation else target.open_item(kind, made.id).attributes.lineage[-1]
            )
            if last is not None and last.sha256 == sha256 and last.operation == MERGED:
                self._rename(entry, made)
            reason = "deleted: it is in the trash" if made.operation else ""
            return MergeReport(kind, name, source.url, "there", made.id, reason=reason)
        new_id, attributes = name, reader.attributes
        if ours is not None:
            if not self.options.rename:
                reason = f"{kind} {name!r} of the target has other content; --rename copies it too"
                return MergeReport(kind, name, source.url, "refused", reason=reason)
            ids = numbered_ids(name, "merged")
            new_id = next(one for one in ids if self._sha256_in_target(kind, one) is None)
            lineage = (*map(self._in_target, attributes.lineage), entry)
            changes = {f"{kind}_id": new_id, "lineage": lineage}
            attributes = attributes.model_copy(update=changes)
        if self.options.dry_run:
            self.origins.planned[kind, new_id] = sha256
            self.origins.planned_ids[kind, sha256] = new_id
        else:
            reader.verify()
            copy_item(source, target, reader, attributes, remarks)
            copied = target.open_item(kind, new_id).content_sha256
            self._note_results(kind, new_id, copied, remarks)
            if ours is not None:
                item = LineageEntry(kind=kind, id=new_id, sha256=copied)
                self._rename(entry, item)
                self.origins.add(entry, item)
        return MergeReport(kind, name, source.url, "copied", new_id)

    def _sha256_in_target(self, kind: Kind, name: str) -> str | None:
        """Hash of what the target has by this id, or would have after a dry run; None if free."""
        if self.target.exists(name, kind=kind):
            return self.target.open_item(kind, name).content_sha256
        return self.origins.planned.get((kind, name))

    def _rename(self, before: LineageEntry, after: LineageEntry) -> None:
        self.renamed[before.kind, before.id] = before, after

    def _in_target(self, source: LineageEntry) -> LineageEntry:
        """A lineage entry of the source's as one of the target's, where the item has a new id."""
        before, after = self.renamed.get((source.kind, source.id), (None, source))
        if before is None or not source.is_of(before.sha256):
            return source
        return source.model_copy(update={"id": after.id, "sha256": source.sha256 and after.sha256})

    def _note_results(
        self, kind: Kind, name: str, sha256: str, remarks: Mapping[str, BaseModel | None]
    ) -> None:
        review = remarks[REVIEW_FILE]
        if isinstance(review, Review) and review.superseded_by:
            self.marked.append((LineageEntry(kind=kind, id=name, sha256=sha256), review))

    def rename_results(self) -> None:
        """Let reviews of edited items name the results by their new ids."""
        for item, theirs in [] if self.options.dry_run else self.marked:
            new_ids = {
                name: self.renamed[item.kind, name][1].id
                for name in theirs.superseded_by
                if (item.kind, name) in self.renamed
            }
            if new_ids:
                results = tuple(new_ids.get(name, name) for name in theirs.superseded_by)
                ours = theirs.model_copy(update={"superseded_by": results})
                self.target.change_source_review(item, partial(_instead, theirs, ours))

    def _remarks(self, kind: Kind, name: str) -> dict[str, BaseModel | None]:
        """What people said of an item, without the names of deleted operators."""
        records = DeletionRecords(self.target.root)

        def known(name: str | None) -> str | None:
            return None if name is None or records.has_operator(name) else name

        def signed(review: Review | None) -> Review | None:
            return review and review.model_copy(
                update={"reviewer": known(review.reviewer), "earlier": signed(review.earlier)}
            )

        notes = tuple(
            note.model_copy(update={"author": known(note.author)})
            for note in self.source.notes(name, kind=kind).notes
        )
        return {
            REVIEW_FILE: signed(self.source.review(name, kind=kind)),
            CLICKS_FILE: self.source.clicks(name) if kind == "episode" else None,
            NOTES_FILE: ItemNotes(notes=notes) if notes else None,
        }

    def _add_remarks(
        self, kind: Kind, name: str, remarks: Mapping[str, BaseModel | None]
    ) -> tuple[str, ...]:
        """Give an item in the target the remarks that only its copy has; returns their names."""
        target = self.target
        ours = {
            REVIEW_FILE: target.review(name, kind=kind),
            CLICKS_FILE: target.clicks(name) if kind == "episode" else None,
            NOTES_FILE: target.notes(name, kind=kind).notes or None,
        }
        added = {key: found for key, found in remarks.items() if found and ours[key] is None}
        for found in [] if self.options.dry_run else added.values():
            if isinstance(found, Review):
                item = LineageEntry(kind=kind, id=name)
                target.change_source_review(item, partial(_or_else, found))
            elif isinstance(found, EpisodeClicks):
                target.set_clicks(name, found)
            elif isinstance(found, ItemNotes):
                target.change_notes(name, partial(_or_these, found), kind=kind)
        return tuple(key.removesuffix(".json") for key in added)


def _instead(before: Review, after: Review, found: Review | None) -> Review | None:
    return after if found == before else found


def _or_else(theirs: Review, ours: Review | None) -> Review:
    # A review written meanwhile.
    return ours or theirs


def _or_these(theirs: ItemNotes, ours: ItemNotes) -> ItemNotes:
    return ours if ours.notes else theirs


def deletion_of(records: DeletionRecords, about: Attributes) -> Covered | None:
    """The permanent deletion that covers an item, its recording or its operator."""
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
    return next((found for take in takes if (found := records.find(take)) is not None), None)


def copy_item(
    source: EpisodeStore,
    target: EpisodeStore,
    reader: EpisodeReader | RecordingReader,
    attributes: Attributes | None = None,
    remarks: Mapping[str, BaseModel | None] = MappingProxyType({}),
    *,
    replaces: bool = False,
) -> None:
    """Copy a group with what is beside its content, byte for byte unless its attributes change.

    With `replaces` one of its id is moved to the trash, or deleted in a bucket, once all is copied.
    """
    attributes = attributes or reader.attributes
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
    with target.writer(kind=kind, attributes=shell, replaces=replaces) as writer:
        writer.take_files(files, metadata=metadata, commit=commit, link=False)
        for remark, found in remarks.items():
            if found is not None:
                writer.add_remark(remark, found)
        if replaces:
            with suppress(NotFoundError):
                target.delete(name, kind=kind)
