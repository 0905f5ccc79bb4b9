"""What all edits share: the id and lineage of the result, and what becomes of the source.

The source is marked as superseded before the result is committed, and the mark counts only while
the result is in the store (`Review.standing`): the commit alone switches from one to the other.
"""

from collections.abc import Callable, Iterator, Mapping
from contextlib import suppress
from dataclasses import dataclass, field
from functools import partial

from pydantic import BaseModel

from dextouch.episodes.format import Attributes, Kind, attributes_id, check_id, numbered_ids
from dextouch.episodes.reader import EpisodeReader, RecordingReader
from dextouch.episodes.store import EpisodeStore
from dextouch.episodes.trash import CLICKS_FILE, NOTES_FILE, REVIEW_FILE
from dextouch.episodes.writer import EpisodeWriter
from dextouch.errors import ConflictError, InvalidInputError, StorageError, UnknownNameError
from dextouch.schemas import (
    EditedItem,
    EditedOutcome,
    EpisodeClicks,
    ItemNotes,
    LineageEntry,
    superseded,
)

OUTCOMES: Mapping[str, bool | None] = {"success": True, "failure": False, "unknown": None}


@dataclass(frozen=True)
class EditOptions:
    """Options that all edits have.

    Args:
        new_id: of the result; by default `ID-trimmed-1` and so on.
        keep: the source stays where it is, as superseded; otherwise it goes to the trash, if the
            store has one.
        dry_run: nothing is written.
    """

    new_id: str | None = None
    keep: bool = False
    dry_run: bool = False


DEFAULTS = EditOptions()


@dataclass
class Edit:
    """One edit of one item: its name, its lineage, and what it cannot keep.

    Args:
        store: of the source and of the result.
        reader: the source.
        word: what the result is, such as `trimmed`, in its id.
        operation: with parameters, as on the command line.
        options: that all edits have.
        changes: attributes that tell the result from that of another edit of this operation.
    """

    store: EpisodeStore
    reader: EpisodeReader | RecordingReader
    word: str
    operation: str
    options: EditOptions
    changes: Mapping[str, object] = field(default_factory=dict)
    messages: list[str] = field(default_factory=list)

    def __post_init__(self) -> None:
        self.kind: Kind = "episode" if isinstance(self.reader, EpisodeReader) else "recording"
        self.source_id = self.reader.item_id
        self.source = LineageEntry(
            kind=self.kind,
            id=self.source_id,
            sha256=self.reader.content_sha256,
            operation=self.operation,
        )
        self.lineage = (*self.reader.attributes.lineage, self.source)
        self.new_id, self.is_done = self._choose_id()
        self._to_trash = not self.options.keep and bool(self.store.folders)
        if not self.options.keep and not self._to_trash:
            self.messages.append("the source stays, as superseded: a bucket has no trash")

    def _choose_id(self) -> tuple[str, bool]:
        """The id of the result, and whether an earlier, interrupted run has written it."""
        given = self.options.new_id
        names: Iterator[str] = numbered_ids(self.source_id, self.word)
        if given is not None:
            names = iter([check_id(given, kind=f"new {self.kind} id")])
        for name in names:
            if not self.store.exists(name, kind=self.kind):
                return name, False
            # A damaged item has its id nevertheless.
            with suppress(StorageError):
                about = self.store.open_item(self.kind, name).attributes
                is_same = all(getattr(about, key) == want for key, want in self.changes.items())
                if is_same and self.source == next(reversed(about.lineage), None):
                    return name, True
        raise ConflictError(f"{self.kind} {given!r} exists already; choose another id with --as")

    def run(
        self,
        attributes: Attributes,
        num_samples: Mapping[str, int],
        write: Callable[[EpisodeWriter], None],
        remarks: Mapping[str, BaseModel | None],
    ) -> EditedItem:
        """Write the result with `write`, unless that is done, and put the source away."""
        if not self.options.dry_run:
            if not self.is_done:
                self._mark_sources()
                with self.store.writer(kind=self.kind, attributes=attributes) as writer:
                    write(writer)
                    for name, remark in remarks.items():
                        if remark is not None:
                            writer.add_remark(name, remark)
            if self._to_trash:
                self.store.delete(self.source_id, kind=self.kind)
        return EditedItem(
            kind=self.kind,
            source_id=self.source_id,
            source_sha256=self.reader.content_sha256,
            id=self.new_id,
            sha256=None if self.options.dry_run else self._content_of_result(),
            operation=self.operation,
            num_samples=dict(num_samples),
            messages=tuple(self.messages),
            source_is="in the trash" if self._to_trash else "superseded",
        )

    def _mark_sources(self) -> None:
        """Mark the source, and all that it was edited from, also in the trash, as superseded."""
        change = partial(superseded, by=self.new_id)
        for entry in self.lineage:
            if entry.is_edit and entry.kind == self.kind:
                self.store.change_source_review(entry, change, is_held=entry == self.source)

    def _content_of_result(self) -> str:
        return self.store.open_item(self.kind, self.new_id).content_sha256

    def remarks(
        self,
        *,
        span_ns: tuple[int | None, int | None] = (None, None),
        shift_ns: int = 0,
        clicks_hold: bool,
    ) -> dict[str, BaseModel | None]:
        """What people said of the source that holds for the result, and messages on the rest."""
        review = self.store.review(self.source_id, kind=self.kind)
        if review is not None and review.superseded_by:
            review = review.earlier
        if review is not None and review.verdict == "rejected":
            self.messages.append("the source was rejected, and the result is with it: accept it")
        notes = self.store.notes(self.source_id, kind=self.kind)
        kept = shifted_notes(notes, span_ns, shift_ns)
        if lost := len(notes.notes) - len(kept.notes):
            self.messages.append(f"{lost} notes lie outside and are left out")
        clicks: EpisodeClicks | None = None
        if self.kind == "episode":
            clicks = self.store.clicks(self.source_id)
            if clicks is not None and not clicks_hold:
                self.messages.append("the clicks are on another first image and are left out")
                clicks = None
        return {
            REVIEW_FILE: review,
            NOTES_FILE: kept if kept.notes else None,
            CLICKS_FILE: clicks,
        }


def shifted_notes(
    notes: ItemNotes, span_ns: tuple[int | None, int | None], shift_ns: int = 0
) -> ItemNotes:
    """Notes that touch a span (None: no limit), cut to it, on a clock that is `shift_ns` behind."""
    low, high = span_ns
    kept = []
    for note in notes.notes:
        start_ns = note.start_ns if low is None else max(note.start_ns, low)
        stop_ns = note.stop_ns if high is None else min(note.stop_ns, high)
        if start_ns <= stop_ns:
            times = {"start_ns": start_ns - shift_ns, "stop_ns": stop_ns - shift_ns}
            kept.append(note.model_copy(update=times))
    return ItemNotes(notes=tuple(kept))


def new_outcome(
    about: Attributes, outcome: EditedOutcome | None, *, lacking: str = ""
) -> dict[str, bool | None]:
    """The changed field of an outcome; empty where it stays.

    `lacking` is why a known outcome may not hold any more. Raises InvalidInputError where it must
    be given, UnknownNameError for another word.
    """
    if outcome is None and lacking and about.success is not None:
        known = "success" if about.success else "failure"
        raise InvalidInputError(
            f"{attributes_id(about)}: {lacking}, so that its outcome ({known}) may not hold; say "
            "it with --outcome keep, success, failure or unknown"
        )
    if outcome is None or outcome == "keep":
        return {}
    if outcome not in OUTCOMES:
        raise UnknownNameError("outcome", outcome, ["keep", *OUTCOMES])
    return {"success": OUTCOMES[outcome]}
