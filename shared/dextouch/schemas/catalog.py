"""Schemas of the store's catalog: items, lineage, the trash, reviews, notes, edits, hours."""

from collections.abc import Callable
from datetime import UTC, datetime
from operator import not_
from typing import Annotated, Literal

from pydantic import AfterValidator, AwareDatetime, Field, StringConstraints, model_validator

from dextouch.free_text import FreeLines, FreeText, check_lines
from dextouch.frozen_model import FrozenModel, example, is_none
from dextouch.schemas.common import MAX_INSTRUCTION, Domain, Origin, StoreId
from dextouch.schemas.episodes import LineageEntry
from dextouch.tactile import LayoutDescription

ItemKind = Literal["episode", "recording"]
Verdict = Literal["accepted", "rejected"]
EditedOutcome = Literal["keep", "success", "failure", "unknown"]
MAX_MOVED = 500  # chosen: bounds one request
# Of an item. Chosen: a take of minutes has tens of notes of a sentence; the file stays below 2 MB.
MAX_NOTES = 500
MAX_NOTE = 1000
# A century: of stamps that differ, no sum overflows.
MAX_TIME_NS = 4 * 10**18


class CatalogValues(FrozenModel):
    """Values that occur in a store, sorted."""

    tasks: tuple[str, ...]
    operators: tuple[str, ...]
    stations: tuple[str, ...]


class LineageNode(FrozenModel):
    """An item in the lineage of another; one that is not stored may be deleted or elsewhere.

    `made_from` are the ids that its own lineage names; `summary` is empty if it is not stored.
    """

    kind: Literal["recording", "episode", "checkpoint", "rollout"]
    id: str
    relation: Literal["self", "source", "product"]
    is_stored: bool
    made_from: tuple[str, ...] = ()
    summary: str = ""


class Lineage(FrozenModel):
    """An item with its sources and products, nearest first."""

    nodes: tuple[LineageNode, ...]


class StoredItem(FrozenModel):
    """Name of an episode or a recording."""

    kind: ItemKind
    id: StoreId


class MoveItems(FrozenModel):
    """Request to move items to the trash, or back."""

    model_config = example(items=[{"kind": "episode", "id": "take-20260301-1"}])

    items: tuple[StoredItem, ...] = Field(min_length=1, max_length=MAX_MOVED)


class RefusedItem(FrozenModel):
    """An item that was not moved, and why."""

    kind: ItemKind
    id: str
    reason: str


class MovedItems(FrozenModel):
    """Result of a move: every item is in one of the lists."""

    moved: tuple[StoredItem, ...]
    refused: tuple[RefusedItem, ...] = ()


class TrashedItem(FrozenModel):
    """A deleted item that can be restored until the trash is purged."""

    kind: ItemKind
    id: str
    deleted_at: AwareDatetime
    num_bytes: int = Field(ge=0)


class TrashContents(FrozenModel):
    """Deleted items, newest first, and how many there are in all."""

    items: tuple[TrashedItem, ...]
    num_items: int


class Review(FrozenModel):
    """Verdict of a person on an item; rejected ones are not trained on.

    `reviewer` is a pseudonym. An edit of the item rejects it as `superseded_by` its results, as
    long as one of them is in the store; `earlier` is the review that the item had before.
    """

    verdict: Verdict
    reason: str = Field(default="", max_length=500)
    reviewer: str | None = Field(default=None, max_length=128)
    reviewed_at: AwareDatetime
    superseded_by: tuple[StoreId, ...] = Field(default=(), max_length=MAX_MOVED, exclude_if=not_)
    earlier: "Review | None" = Field(default=None, exclude_if=is_none)

    def standing(self, is_stored: Callable[[str], bool]) -> "Review | None":
        """The review that counts: the earlier one where no result of an edit is stored any more."""
        if self.superseded_by and not any(map(is_stored, self.superseded_by)):
            return self.earlier
        return self

    @property
    def spreads(self) -> bool:
        """Whether what was made from the item is rejected, too: not by an edit of the item."""
        review = self.earlier if self.superseded_by else self
        return review is not None and review.verdict == "rejected"


def superseded(review: Review | None, by: str) -> Review:
    """The review of an item, from an earlier one, once an edit made another one of it."""
    marked = () if review is None else review.superseded_by
    if review is not None and by in marked:
        return review
    results = (*marked, by)[-MAX_MOVED:]
    return Review(
        verdict="rejected",
        reason=f"superseded by {', '.join(results)}"[:500],
        reviewed_at=datetime.now(UTC),
        superseded_by=results,
        earlier=review.earlier if marked and review is not None else review,
    )


class TimedNote(FrozenModel):
    """What a person says of a time range of an item, on the clock of its streams (`Playback`).

    `number` names it among the notes of its item; `author` is a pseudonym.
    """

    number: int = Field(ge=1)
    start_ns: int = Field(ge=-MAX_TIME_NS, le=MAX_TIME_NS)
    stop_ns: int = Field(ge=-MAX_TIME_NS, le=MAX_TIME_NS)
    text: str = Field(min_length=1, max_length=MAX_NOTE)
    author: str | None = Field(default=None, max_length=128)
    written_at: AwareDatetime

    @model_validator(mode="after")
    def _ends_after_its_start(self) -> "TimedNote":
        if self.stop_ns < self.start_ns:
            raise ValueError(
                f"got a note from {self.start_ns} to {self.stop_ns} ns, expected a "
                "time range that does not end before it begins"
            )
        return self


class ItemNotes(FrozenModel):
    """Notes on time ranges of an item, in the order of their starts."""

    notes: tuple[TimedNote, ...] = Field(default=(), max_length=MAX_NOTES)


class NewNote(FrozenModel):
    """Request to add a note to an item."""

    model_config = example(
        start_ns=1_000_000_000, stop_ns=2_500_000_000, text="the bottle slips", author="p17"
    )

    start_ns: int = Field(ge=-MAX_TIME_NS, le=MAX_TIME_NS)
    stop_ns: int = Field(ge=-MAX_TIME_NS, le=MAX_TIME_NS)
    text: Annotated[
        str,
        StringConstraints(strip_whitespace=True, min_length=1, max_length=MAX_NOTE),
        AfterValidator(check_lines),
    ]
    author: FreeText | None = Field(default=None, max_length=128)


class RemoveNote(FrozenModel):
    """Request to remove a note."""

    model_config = example(number=1)

    number: int = Field(ge=1)


class TrimEpisode(FrozenModel):
    """Request to trim an episode to its steps `first_step` … `stop_step` − 1.

    `outcome` is that of the result, which must be given where the end of a judged episode is cut
    off. `exact` encodes H.264 images anew from the cut on. The source goes to the trash unless
    `keep`. With `dry_run` nothing is written.
    """

    model_config = example(first_step=30, stop_step=120, dry_run=True)

    first_step: int = Field(ge=0)
    stop_step: int = Field(ge=1)
    outcome: EditedOutcome | None = None
    exact: bool = False
    keep: bool = False
    dry_run: bool = False


class RelabelItems(FrozenModel):
    """Request to change attributes of items; those that are None stay. Otherwise as a trim."""

    model_config = example(
        items=[{"kind": "episode", "id": "take-20260301-1"}], task="stand_bottle", dry_run=True
    )

    items: tuple[StoredItem, ...] = Field(min_length=1, max_length=MAX_MOVED)
    task: FreeText | None = Field(default=None, min_length=1, max_length=128)
    instruction: FreeText | None = Field(default=None, max_length=MAX_INSTRUCTION)
    operator: FreeText | None = Field(default=None, min_length=1, max_length=128)
    outcome: EditedOutcome | None = None
    keep: bool = False
    dry_run: bool = False


class EditedItem(FrozenModel):
    """Result of an edit: a new item, what is in it, and what is not.

    `sha256` is its content hash, None of a dry run; `num_samples` those of its streams;
    `messages` say what could not be kept; `source_is` where the source is now.
    """

    kind: ItemKind
    source_id: str
    source_sha256: str
    id: str
    sha256: str | None
    operation: str
    num_samples: dict[str, int]
    messages: tuple[str, ...] = ()
    source_is: Literal["superseded", "in the trash"]


class EditedItems(FrozenModel):
    """Results of edits: every item is in one of the lists."""

    edited: tuple[EditedItem, ...]
    refused: tuple[RefusedItem, ...] = ()


class ReviewItems(FrozenModel):
    """Request to review items; a `verdict` of None removes their reviews."""

    model_config = example(
        items=[{"kind": "episode", "id": "take-20260301-1"}],
        verdict="rejected",
        reason="hand occluded",
    )

    items: tuple[StoredItem, ...] = Field(min_length=1, max_length=MAX_MOVED)
    verdict: Verdict | None
    reason: FreeLines = Field(default="", max_length=500)
    reviewer: FreeText | None = Field(default=None, max_length=128)


class ReviewedItems(FrozenModel):
    """Result of a review: every item is in one of the lists."""

    reviewed: tuple[StoredItem, ...]
    refused: tuple[RefusedItem, ...] = ()


class Finding(FrozenModel):
    """A reason to look at an item.

    `figure` and `value` belong to the codes `outlier` and `beyond_limit`, `median` and `score`
    (robust z-score) to `outlier`.
    """

    code: Literal[
        "outlier", "beyond_limit", "incomplete", "not_judged", "doubtful_clock", "recovered"
    ]
    message: str
    figure: str | None = None
    value: float | None = None
    median: float | None = None
    score: float | None = None


class _ItemFields(FrozenModel):
    """What the table of items and their playback both show."""

    kind: ItemKind
    id: str
    task: str
    instruction: str
    domain: Domain
    origin: Origin
    station: str | None = None
    operator: str | None = None
    success: bool | None = None
    recovered: bool = False
    at: AwareDatetime | None = None


class CatalogItem(_ItemFields):
    """An episode or a recording with all that a table of both shows.

    `consent` of an episode is that of its recording, None where that is not stored. `figures` are
    figures of its quality, the same for all items. `recordings` and `episodes` are the stored
    recordings that it was made from and the episodes that were made from it; `aligned` is the last
    of these, in the list of takes only. `complete` is False of a take that was saved although its
    check found it incomplete. `time_doubts` names streams whose times are in doubt.
    """

    consent: bool | None = None
    complete: bool = True
    incomplete_cause: str = ""
    duration_s: float = Field(ge=0)
    trace_id: str | None = Field(default=None, exclude_if=not_)
    figures: dict[str, float] = Field(default={})
    time_doubts: tuple[str, ...] = ()
    recordings: tuple[str, ...] = ()
    episodes: tuple[str, ...] = ()
    review: Review | None = None
    findings: tuple[Finding, ...] = ()
    aligned: "CatalogItem | None" = None


class CatalogItems(FrozenModel):
    """One page of items, and how many match in all; `next_after` is None on the last page."""

    items: tuple[CatalogItem, ...]
    num_matching: int
    next_after: str | None = None


class ComparedGroup(FrozenModel):
    """Items that are compared with each other to find outliers.

    `is_compared` is False where there are fewer than `min_items`.
    """

    kind: ItemKind
    task: str
    domain: Domain
    origin: Origin
    num_items: int
    min_items: int
    is_compared: bool


class ComparedGroups(FrozenModel):
    """All groups of items, by task, domain, origin and kind."""

    groups: tuple[ComparedGroup, ...]


class HoursOf(FrozenModel):
    """Hours of the episodes with one value of a field, by their reviews; None without a value."""

    value: str | None
    num_episodes: int
    accepted_h: float
    rejected_h: float
    not_reviewed_h: float


class HoursByField(FrozenModel):
    """Hours of episodes by the values of one field, in their order."""

    rows: tuple[HoursOf, ...]


class InterpolatedSpan(FrozenModel):
    """From when to when a part of the action, a stream or a finger, was interpolated."""

    part: str
    start_ns: int
    stop_ns: int


class PlayedStream(FrozenModel):
    """A stream on the item's clock; `gaps_ns` are the longest gaps in order of time.

    `interpolated` are the spans of actions that nothing measured, `unmeasured_taxels` those that
    alignment refused. `layout` is that of the taxels of a tactile stream, None of `dextouch_v1`.
    `components` name the values of actions of the robot's hands, with their unit as a suffix.

    A gap is an interval of more than one and a half nominal periods between samples. Times are
    those of the reference clock for episodes, of the host's arrivals for recordings; None if the
    stream has no samples.
    """

    name: str
    kind: str
    shape: tuple[int, ...]
    unit: str
    side: Literal["left", "right"] | None = None
    frame: str | None = None
    nominal_rate_hz: float
    num_samples: int
    first_ns: int | None = None
    last_ns: int | None = None
    num_gaps: int = 0
    gaps_ns: tuple[tuple[int, int], ...] = ()
    interpolated: tuple[InterpolatedSpan, ...] = ()
    unmeasured_taxels: tuple[int, ...] = ()
    components: tuple[str, ...] = ()
    layout: LayoutDescription | None = Field(default=None, exclude_if=is_none)


class Playback(_ItemFields):
    """What can be played of a recording or an episode, from `start_ns` to `stop_ns`.

    `started_t_host_ns` is a recording's host time at its start, `origin_after_start_ns` how much
    later an episode that was aligned from it begins; None where unknown. `absent` are the parts of
    the action that no step of an episode has.
    """

    absent: tuple[str, ...] = ()
    model_rate_hz: float | None = None
    num_steps: int = 0
    start_ns: int
    stop_ns: int
    started_t_host_ns: int | None = None
    origin_after_start_ns: int | None = None
    lineage: tuple[LineageEntry, ...] = ()
    streams: tuple[PlayedStream, ...] = ()
