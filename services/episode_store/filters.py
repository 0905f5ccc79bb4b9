"""Filters, order and pages of the catalog's lists."""

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from datetime import UTC, datetime
from operator import attrgetter
from typing import Annotated, Generic, Literal, TypeVar

from pydantic import AfterValidator, AwareDatetime, Field

from dextouch.errors import LimitExceededError
from dextouch.frozen_model import FrozenModel
from dextouch.schemas import (
    CatalogItem,
    Domain,
    EpisodeClicks,
    EpisodeSummary,
    LineageEntry,
    Origin,
    RecordingSummary,
    Verdict,
)

S = TypeVar("S", EpisodeSummary, RecordingSummary)
Outcome = Literal["success", "failure", "not_judged"]
SortKey = Literal["id", "time", "duration", "task", "operator", "station", "findings"]
ItemsKind = Literal["take", "recording", "episode"]
_COMPARED = (
    "task", "operator", "station", "domain", "success", "recovered", "origin", "trace_id",
)  # fmt: skip
# Order of items by their findings, where those without a score are among the outliers.
_WEIGHTS = {
    "incomplete": 20.0,
    "beyond_limit": 15.0,
    "doubtful_clock": 10.0,
    "recovered": 5.0,
    "not_judged": 1.0,
}
EARLIEST, LATEST = datetime(1, 1, 1, tzinfo=UTC), datetime(9999, 12, 31, tzinfo=UTC)
_SUCCESS: dict[Outcome, bool | None] = {"success": True, "failure": False, "not_judged": None}


@dataclass(frozen=True, slots=True)
class Entry(Generic[S]):
    """A row of the catalog in both forms, with further properties to filter by.

    `text` is in lower case. `is_clickable` marks episodes whose objects no stream knows, and
    `clicks` are those on them.
    """

    summary: S
    item: CatalogItem
    quality: Mapping[str, float]
    created_at: datetime | None
    lineage: tuple[LineageEntry, ...] = ()
    text: str = ""
    is_clickable: bool = False
    clicks: EpisodeClicks | None = None


def quality_bound(text: str) -> tuple[str, float]:
    """Parse `NAME:NUMBER` to a figure's name and lower bound.

    Raises:
        ValueError: anything else, and NaN.
    """
    name, colon, figure = text.rpartition(":")
    try:
        least = float(figure)
    except ValueError:
        least = math.nan
    if not (name and colon) or math.isnan(least):
        raise ValueError(f"got {text!r}, expected NAME:NUMBER such as coverage:0.95")
    return name, least


class CatalogFilter(FrozenModel):
    """Filter of episodes or recordings; omitted fields match anything.

    `min_quality` are bounds `NAME:NUMBER` that must all hold; an item without the figure does not
    match. Times are created_after ≤ t < created_before; an item without a time does not match.
    `text` is looked for in id, task, instruction, operator, station and trace, in any case.
    """

    task: str | None = None
    operator: str | None = None
    station: str | None = None
    domain: Domain | None = None
    success: bool | None = None
    outcome: Outcome | None = Field(default=None, description="as success, or not judged")
    recovered: bool | None = None
    trace_id: str | None = Field(default=None, max_length=32)
    text: str | None = Field(default=None, max_length=200)
    min_quality: tuple[
        Annotated[str, AfterValidator(lambda text: quality_bound(text) and text)], ...
    ] = ()
    created_after: AwareDatetime | None = None
    created_before: AwareDatetime | None = None

    def matcher(self) -> Callable[[Entry[S]], bool]:
        """Compile the filter to a fast predicate."""
        fields = [name for name in _COMPARED if getattr(self, name, None) is not None]
        get = attrgetter(*fields) if fields else None
        expected = get(self) if get else None
        bounds = [quality_bound(text) for text in self.min_quality]
        further = self._further()

        def matches(entry: Entry[S]) -> bool:
            if get is not None and get(entry.item) != expected:
                return False
            if any(not entry.quality.get(name, -math.inf) >= least for name, least in bounds):
                return False
            return all(check(entry) for check in further)

        return matches

    def _further(self) -> list[Callable[[Entry[S]], bool]]:
        """Checks of the filters that do not compare one field of the summary."""
        checks: list[Callable[[Entry[S]], bool]] = []
        if self.outcome is not None:
            success = _SUCCESS[self.outcome]
            checks.append(lambda entry: entry.item.success is success)
        if self.text:
            text = self.text.casefold()
            checks.append(lambda entry: text in entry.text)
        if self.created_after is not None or self.created_before is not None:
            after, before = self.created_after or EARLIEST, self.created_before or LATEST
            checks.append(lambda entry: after <= (entry.created_at or LATEST) < before)
        return checks


class EpisodeFilter(CatalogFilter):
    """Filter of episodes; `derived_from` is the id of an item that their lineage names."""

    origin: Origin | None = None
    derived_from: str | None = None

    def _further(self) -> list[Callable[[Entry[S]], bool]]:
        checks: list[Callable[[Entry[S]], bool]] = super()._further()
        if self.derived_from is not None:
            source = self.derived_from
            checks.append(lambda entry: any(one.id == source for one in entry.lineage))
        return checks


class ItemFilter(CatalogFilter):
    """Filter of items; `flagged` are those with findings, `id` any of these ids."""

    kind: ItemsKind = Field(
        default="take",
        description="recordings, episodes, or both: a recording and its episodes as one take",
    )
    origin: Origin | None = None
    review: Verdict | Literal["not_reviewed"] | None = None
    flagged: bool | None = None
    id: tuple[str, ...] = Field(default=(), max_length=200)

    def _further(self) -> list[Callable[[Entry[S]], bool]]:
        checks: list[Callable[[Entry[S]], bool]] = super()._further()
        if self.review is not None:
            verdict = None if self.review == "not_reviewed" else self.review
            checks.append(
                lambda entry: (entry.item.review and entry.item.review.verdict) == verdict
            )
        if self.flagged is not None:
            flagged = self.flagged
            checks.append(lambda entry: bool(entry.item.findings) == flagged)
        if self.id:
            ids = frozenset(self.id)
            checks.append(lambda entry: entry.item.id in ids)
        return checks


class Page(FrozenModel):
    """Page of a list in an order: after a cursor, or from an offset.

    Rows of equal keys are in the order of ids; rows without a key come first. `findings` sorts
    items by how far they are from what is usual.
    """

    sort: SortKey = "id"
    descending: bool = False
    limit: int | None = Field(default=None, ge=1)
    offset: int = Field(default=0, ge=0)
    after: str | None = Field(
        default=None,
        max_length=400,
        description="only rows after this cursor: an id, or next_after of the page before",
    )

    def num_rows(self, max_page: int) -> int:
        """Number of rows of the page; the maximum by default.

        Raises:
            LimitExceededError: above the maximum.
        """
        if self.limit is not None and self.limit > max_page:
            raise LimitExceededError(
                f"limit: got {self.limit}, expected at most {max_page}; "
                "ask for the next page with after=NEXT_AFTER",
                got=self.limit,
                expected=max_page,
            )
        return self.limit or max_page


class EpisodeQuery(EpisodeFilter, Page):
    """Filter and page of episodes."""


class RecordingQuery(CatalogFilter, Page):
    """Filter and page of recordings."""


class ItemQuery(ItemFilter, Page):
    """Filter and page of items."""


def sort_key(item: CatalogItem, sort: SortKey) -> str:
    """Text by which a row is sorted; empty for ids, which follow anyway."""
    if sort == "id":
        return ""
    if sort == "duration":
        return f"{item.duration_s:020.6f}"
    if sort == "findings":
        scores = (abs(one.score or _WEIGHTS.get(one.code, 0.0)) for one in item.findings)
        return f"{max(scores, default=0.0):020.6f}"
    if sort == "time":
        at = item.at
        return "" if at is None else at.astimezone(UTC).isoformat(timespec="microseconds")
    return getattr(item, sort) or ""


def cursor_of(place: tuple[str, str]) -> str:
    """Cursor of a row by its key and id; of a list by ids the id alone."""
    key, item_id = place
    return f"{key}|{item_id}" if key else item_id


def place_of(cursor: str) -> tuple[str, str]:
    """Key and id of a cursor; the row itself may be gone."""
    key, _, item_id = cursor.rpartition("|")
    return key, item_id
