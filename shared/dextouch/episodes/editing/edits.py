"""Relabels, notes on time ranges, and what all edits share: id and lineage of the result.

The source is marked as superseded before the result is committed, and the mark counts only while
the result is in the store (`Review.standing`): the commit alone switches from one to the other.
"""

import json
import shlex
from collections.abc import Callable, Iterator, Mapping
from contextlib import suppress
from dataclasses import dataclass, field
from datetime import UTC, datetime
from functools import partial

from pydantic import BaseModel, ValidationError

from dextouch.episodes.files import GroupFiles
from dextouch.episodes.format import (
    ATTRIBUTES_KEY,
    COMMIT_FILE,
    METADATA_FILE,
    Attributes,
    Kind,
    attributes_id,
    canonical_json,
    check_id,
    numbered_ids,
    sha256_hex,
)
from dextouch.episodes.maintenance import DeletionRecords
from dextouch.episodes.reader import EpisodeReader, RecordingReader
from dextouch.episodes.store import EpisodeStore
from dextouch.episodes.trash import CLICKS_FILE, NOTES_FILE, REVIEW_FILE
from dextouch.episodes.writer import EpisodeWriter
from dextouch.errors import (
    ConflictError,
    CorruptDataError,
    InvalidInputError,
    LimitExceededError,
    NotFoundError,
    StorageError,
    UnknownNameError,
)
from dextouch.schemas import (
    MAX_NOTES,
    EditedItem,
    EditedOutcome,
    EpisodeAttributes,
    EpisodeClicks,
    ItemNotes,
    LineageEntry,
    NewNote,
    RelabelItems,
    TimedNote,
    first_problems,
    json_ready,
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
_RELABELLED = ("task", "instruction", "operator")


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
                # Also all that the source was edited from, and what of it is in the trash.
                change = partial(superseded, by=self.new_id)
                for entry in self.lineage:
                    if entry.is_edit and entry.kind == self.kind:
                        is_held = entry == self.source
                        self.store.change_source_review(entry, change, is_held=is_held)
                with self.store.writer(kind=self.kind, attributes=attributes) as writer:
                    write(writer)
                    for name, remark in remarks.items():
                        if remark is not None:
                            writer.add_remark(name, remark)
            if self._to_trash:
                self.store.delete(self.source_id, kind=self.kind)
        written = not self.options.dry_run
        result = self.store.open_item(self.kind, self.new_id) if written else None
        return EditedItem(
            kind=self.kind,
            source_id=self.source_id,
            source_sha256=self.reader.content_sha256,
            id=self.new_id,
            sha256=None if result is None else result.content_sha256,
            operation=self.operation,
            num_samples=dict(num_samples),
            messages=tuple(self.messages),
            source_is="in the trash" if self._to_trash else "superseded",
        )

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
        return {REVIEW_FILE: review, NOTES_FILE: kept if kept.notes else None, CLICKS_FILE: clicks}


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


def zero_ns(reader: EpisodeReader | RecordingReader) -> int:
    """Second 0 of an item on its clock: step 0 of an episode, the start of a recording."""
    if isinstance(reader, EpisodeReader):
        return int(reader.stamps_ns("action")[0]) if reader.num_steps else 0
    started_ns = reader.attributes.started_t_host_ns
    return time_span_ns(reader)[0] if started_ns is None else started_ns


def time_span_ns(reader: EpisodeReader | RecordingReader) -> tuple[int, int]:
    """Stamps of the first and the last sample of an item; raises InvalidInputError without any."""
    stamps = [reader.stamps_ns(name) for name in reader.streams]
    ends = [(int(one[0]), int(one[-1])) for one in stamps if len(one)]
    if not ends:
        raise InvalidInputError(f"{reader.item_id!r}: has no sample, and no time to speak of")
    return min(first for first, _ in ends), max(last for _, last in ends)


def add_note(
    store: EpisodeStore, item_id: str, given: NewNote, *, kind: Kind = "episode"
) -> TimedNote:
    """Keep a note on an item.

    Raises InvalidInputError for a range that is empty or outside the item, LimitExceededError for
    more than MAX_NOTES, and as `EpisodeStore.review`.
    """
    reader = store.open_item(kind, item_id)
    first_ns, last_ns = time_span_ns(reader)
    if not given.start_ns <= given.stop_ns or given.stop_ns < first_ns or given.start_ns > last_ns:
        zero = zero_ns(reader)
        got, expected = (
            f"{(low - zero) / 1e9:.3f} … {(high - zero) / 1e9:.3f} s"
            for low, high in ((given.start_ns, given.stop_ns), (first_ns, last_ns))
        )
        raise InvalidInputError(
            f"note on {kind} {item_id!r}: got the range {got}, expected one within {expected}"
        )
    added: list[TimedNote] = []

    def add(notes: ItemNotes) -> ItemNotes:
        if len(notes.notes) >= MAX_NOTES:
            raise LimitExceededError(
                f"note on {kind} {item_id!r}: it has {MAX_NOTES} notes, expected at most as many; "
                "remove one first"
            )
        number = 1 + max((one.number for one in notes.notes), default=0)
        added.append(TimedNote(number=number, written_at=datetime.now(UTC), **given.model_dump()))
        ordered = sorted([*notes.notes, *added], key=lambda one: (one.start_ns, one.number))
        return ItemNotes(notes=tuple(ordered))

    store.change_notes(item_id, add, kind=kind)
    return added[0]


def remove_note(
    store: EpisodeStore, item_id: str, number: int, *, kind: Kind = "episode"
) -> ItemNotes:
    """Remove a note by its number, and return the others; raises NotFoundError without it."""

    def remove(notes: ItemNotes) -> ItemNotes:
        kept = tuple(one for one in notes.notes if one.number != number)
        if len(kept) == len(notes.notes):
            numbers = ", ".join(str(one.number) for one in notes.notes) or "none"
            raise NotFoundError(
                f"note {number} on {kind} {item_id!r}: not there; its notes are {numbers}"
            )
        return ItemNotes(notes=kept)

    return store.change_notes(item_id, remove, kind=kind)


def relabel_item(
    store: EpisodeStore,
    item_id: str,
    changes: Mapping[str, str],
    *,
    kind: Kind = "episode",
    outcome: EditedOutcome | None = None,
    options: EditOptions = DEFAULTS,
) -> EditedItem:
    """Write an item with other attributes, and the same arrays, as a new one, which supersedes it.

    The files of the arrays are shared with the source where the file system can.

    Args:
        store: where the item is.
        item_id: of the source.
        changes: new values of some of `task`, `instruction` and `operator`, as in `RelabelItems`.
        kind: of the item.
        outcome: new outcome; another task must be given one, if the item was judged.
        options: of all edits.

    Raises:
        InvalidInputError: nothing changes, a value is invalid, or the outcome is lacking.
        NotFoundError, CorruptDataError, ConflictError, UnavailableError: as `trim_episode`.
    """
    if any(key not in _RELABELLED or text is None for key, text in changes.items()):
        raise InvalidInputError(
            f"relabel {kind} {item_id!r}: got {dict(changes)}, expected texts of task, instruction "
            "or operator"
        )
    try:
        RelabelItems.model_validate({"items": [{"kind": kind, "id": item_id}], **changes})
    except ValidationError as error:
        raise InvalidInputError(f"relabel {kind} {item_id!r}: {first_problems(error)}") from error
    with store.held(item_id, kind=kind):
        reader = store.open_item(kind, item_id)
        about = reader.attributes
        changed = {key: text for key, text in changes.items() if getattr(about, key) != text}
        operator = changed.get("operator")
        if operator is not None and DeletionRecords(store.root).has_operator(operator):
            raise InvalidInputError(
                f"relabel {kind} {item_id!r}: the operator was permanently deleted from the store, "
                "expected another, or `dextouch store deletions --readmit` first"
            )
        is_other_task = "task" in changed
        lacking = f"it becomes one of {changed.get('task')!r}" if is_other_task else ""
        fields: dict[str, object] = {**changed, **new_outcome(about, outcome, lacking=lacking)}
        if not {key for key, value in fields.items() if getattr(about, key) != value}:
            raise InvalidInputError(
                f"{kind} {item_id!r}: nothing changes; expected another --task, --instruction, "
                "--operator or --outcome than it has"
            )
        # Not the pseudonym: the lineage of later items must not name an operator.
        arguments = {key: "…" if key == "operator" else text for key, text in changed.items()}
        if outcome is not None:
            arguments["outcome"] = outcome
        text = shlex.join(
            ["relabel", *(part for k, v in arguments.items() for part in (f"--{k}", v))]
        )
        edit = Edit(store, reader, "relabelled", text, options, fields)
        if is_other_task and isinstance(about, EpisodeAttributes) and about.event_times_s:
            edit.messages.append(f"events of {about.task!r} are left out")
            fields = {**fields, "event_times_s": {}}
        fields = fields | {f"{kind}_id": edit.new_id, "lineage": edit.lineage}
        attributes = about.model_copy(update=fields)
        metadata, commit = with_attributes(store.files(item_id, kind=kind), attributes)

        def write(writer: EpisodeWriter) -> None:
            files = store.files(item_id, kind=kind)
            writer.take_files(files, metadata=metadata, commit=commit, link=True)

        counts = {name: reader.num_samples(name) for name in reader.streams}
        # Its streams are files that exist already.
        shell = attributes.model_copy(update={"streams": ()})
        return edit.run(shell, counts, write, edit.remarks(clicks_hold=not is_other_task))


def with_attributes(files: GroupFiles, attributes: Attributes) -> tuple[bytes, bytes]:
    """`zarr.json` and `commit.json` of a group whose arrays stay, with other attributes."""
    metadata, commit = files.get(METADATA_FILE), files.get(COMMIT_FILE)
    if metadata is None or commit is None:
        raise CorruptDataError(f"{files.item_id}: {METADATA_FILE} or {COMMIT_FILE} is missing")
    group, record = json.loads(metadata), json.loads(commit)["record"]
    group["attributes"][ATTRIBUTES_KEY] = json_ready(attributes)
    changed = canonical_json(group)
    record |= {"id": attributes_id(attributes), "attributes_sha256": sha256_hex(changed)}
    digest = sha256_hex(canonical_json(record))
    return changed, canonical_json({"record": record, "sha256": digest})
