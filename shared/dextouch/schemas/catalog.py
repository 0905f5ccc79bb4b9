"""Schemas of the store's catalog: items of both kinds, lineage, the trash, reviews, hours."""

from operator import not_
from typing import Literal

from pydantic import AwareDatetime, Field

from dextouch.free_text import FreeLines, FreeText
from dextouch.frozen_model import FrozenModel, example
from dextouch.schemas.common import Domain, Origin, StoreId
from dextouch.schemas.episodes import LineageEntry
from dextouch.tactile import LayoutDescription

ItemKind = Literal["episode", "recording"]
Verdict = Literal["accepted", "rejected"]
MAX_MOVED = 500


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

    `reviewer` is a pseudonym.
    """

    verdict: Verdict
    reason: str = Field(default="", max_length=500)
    reviewer: str | None = Field(default=None, max_length=128)
    reviewed_at: AwareDatetime


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
    layout: LayoutDescription | None = Field(default=None, exclude_if=lambda layout: layout is None)


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
