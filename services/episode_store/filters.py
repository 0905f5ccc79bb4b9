"""Filters, order and pages of the catalog's lists."""

import math
from dataclasses import dataclass, field
from datetime import UTC, datetime, timedelta
from typing import Annotated, Final, Literal

from pydantic import AfterValidator, AwareDatetime, Field

from dextouch.errors import LimitExceededError
from dextouch.frozen_model import FrozenModel
from dextouch.schemas import Domain, Origin, Verdict

Outcome = Literal["success", "failure", "not_judged"]
SortKey = Literal["id", "time", "duration", "task", "operator", "station", "findings"]
ItemsKind = Literal["take", "recording", "episode"]
# Attributes that rows are counted by, with their columns in the tables `item` and `tally`.
COUNTED_ATTRIBUTES: Final = {
    "task": "TEXT NOT NULL", "operator": "TEXT", "station": "TEXT", "domain": "TEXT NOT NULL",
    "origin": "TEXT NOT NULL", "success": "INTEGER", "recovered": "INTEGER NOT NULL",
}  # fmt: skip
EQUALITY_FILTERS: Final = (*COUNTED_ATTRIBUTES, "trace_id")
# Order of items by their findings, where those without a score are among the outliers.
WEIGHTS: Final = {
    "incomplete": 20.0,
    "beyond_limit": 15.0,
    "doubtful_clock": 10.0,
    "recovered": 5.0,
    "not_judged": 1.0,
}
# Columns by which lists are sorted, `name` behind each, with a place for the name of the table.
SORT_COLUMNS: Final = {
    "time": "{}at_key", "duration": "{}duration_key", "task": "{}task",
    "operator": "coalesce({}operator, '')", "station": "coalesce({}station, '')",
}  # fmt: skip
_EPOCH = datetime(1970, 1, 1, tzinfo=UTC)
_FIGURE = "SELECT value FROM figure WHERE number = (SELECT number FROM figure_name WHERE name = ?)"
_WITH_TEXT: Final = "SELECT row FROM item WHERE instr(text, ?) > 0"
# The text of a take is that of its recording and of its episode.
_TAKES_WITH_TEXT: Final = """WITH m AS MATERIALIZED (
  SELECT row FROM item WHERE instr(text, ?) > 0)
  SELECT row FROM m UNION ALL SELECT t.row FROM m CROSS JOIN item t ON t.aligned = m.row"""
EARLIEST, LATEST = datetime(1, 1, 1, tzinfo=UTC), datetime(9999, 12, 31, tzinfo=UTC)
_SUCCESS: dict[Outcome, bool | None] = {"success": True, "failure": False, "not_judged": None}


@dataclass
class Condition:
    """An SQL condition on a row `i` of the catalog with its parameters.

    In the list of takes (`of_takes`) a recording's last episode is the row `i.aligned`. With
    `is_counted` its terms have only columns of `tally`; few rows match one that `is_rare`.
    """

    of_takes: bool = False
    is_counted: bool = True
    is_rare: bool = False
    terms: list[str] = field(default_factory=list)
    values: list[object] = field(default_factory=list)

    def add(self, term: str, *values: object, is_counted: bool = False) -> None:
        """A further term that must hold."""
        self.is_counted &= is_counted
        self.terms.append(term)
        self.values += values

    @property
    def sql(self) -> str:
        """All terms."""
        return " AND ".join(self.terms)


def quality_bound(text: str) -> tuple[str, float]:
    """Parse `NAME:NUMBER` to a figure's name and lower bound.

    Raises ValueError: anything else, and NaN.
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
    ] = Field(default=(), max_length=20)
    created_after: AwareDatetime | None = None
    created_before: AwareDatetime | None = None

    def restrict(self, to: Condition) -> None:
        """Add what must hold of a matching row."""
        for name in EQUALITY_FILTERS:
            if (value := getattr(self, name, None)) is not None:
                to.add(f"i.{name} = ?", value, is_counted=name in COUNTED_ATTRIBUTES)
        if self.outcome is not None:
            to.add("i.success IS ?", _SUCCESS[self.outcome], is_counted=True)
        if self.text:
            found = _TAKES_WITH_TEXT if to.of_takes else _WITH_TEXT
            to.add(f"i.row IN ({found})", self.text.casefold())
            to.is_rare = True
        for name, least in map(quality_bound, self.min_quality):
            if least > -math.inf:
                figure = f"({_FIGURE} AND row = i.row)"
                if to.of_takes:
                    figure = f"coalesce(({_FIGURE} AND row = i.aligned), {figure})"
                to.add(f"{figure} >= ?", *[name] * (1 + to.of_takes), least)
        if self.created_after is not None or self.created_before is not None:
            after, before = self.created_after or EARLIEST, self.created_before or LATEST
            to.add("i.at_us >= ? AND i.at_us < ?", microseconds(after), microseconds(before))


class EpisodeFilter(CatalogFilter):
    """Filter of episodes; `derived_from` is the id of an item that their lineage names."""

    origin: Origin | None = None
    derived_from: str | None = None

    def restrict(self, to: Condition) -> None:
        """Add what must hold of a matching row."""
        super().restrict(to)
        if self.derived_from is not None:
            to.add("i.row IN (SELECT row FROM lineage WHERE source = ?)", self.derived_from)


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

    def restrict(self, to: Condition) -> None:
        """Add what must hold of a matching row."""
        super().restrict(to)
        prefix = "take_" if to.of_takes else ""
        if self.review is not None:
            verdict = None if self.review == "not_reviewed" else self.review
            to.add(f"i.{prefix}verdict IS ?", verdict, is_counted=True)
        if self.flagged is not None:
            to.add(f"i.{prefix}weight {'>' if self.flagged else '='} ?", NO_WEIGHT)
        if self.id:
            to.add(f"i.id IN ({', '.join('?' * len(self.id))})", *self.id)


class Page(FrozenModel):
    """Page of a list in an order: after a cursor, or from an offset.

    Rows of equal keys are in the order of ids, the episode of an id before the recording; rows
    without a key come first. `findings` sorts items by how far they are from what is usual.
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

        Raises LimitExceededError: above the maximum.
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


def within_calendar(at: datetime) -> datetime:
    """The same time in UTC, or the first or last one where that has no date in UTC."""
    return min(max(at, EARLIEST), LATEST).astimezone(UTC)


def time_key(at: datetime | None) -> str:
    """Text by which rows are sorted by time, which is `within_calendar`."""
    return "" if at is None else at.isoformat(timespec="microseconds")


def item_name(item_id: str, kind: str) -> str:
    """Name by which items of both kinds are sorted: a comma comes before any part of an id."""
    return f"{item_id},{kind}"


def number_key(number: float) -> str:
    """Text by which rows are sorted by a duration, or by how unusual they are."""
    return f"{number:020.6f}"


def microseconds(at: datetime) -> int:
    """Microseconds since 1970, without rounding."""
    return (at - _EPOCH) // timedelta(microseconds=1)


# Sort key of an item without findings.
NO_WEIGHT: Final = number_key(0.0)


def cursor_of(place: tuple[str, str]) -> str:
    """Cursor of a row by its key and id; of a list by ids the id alone."""
    key, item_id = place
    return f"{key}|{item_id}" if key else item_id


def place_of(cursor: str, *, descending: bool = False) -> tuple[str, str]:
    """Key and id or name of a cursor; the row itself may be gone.

    In the list of both kinds an id alone stands for all items of it: they come before its place, or
    after it where the list is `descending`.
    """
    key, _, item_id = cursor.rpartition("|")
    return key, item_id if descending or "," in item_id else item_name(item_id, "~")
