"""Query filters of the catalog: task, station, quality bounds, times and paging."""

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from datetime import datetime
from operator import attrgetter
from typing import Annotated, Generic, TypeVar

from pydantic import AfterValidator, AwareDatetime, Field

from dextouch.errors import LimitExceededError
from dextouch.frozen_model import FrozenModel
from dextouch.schemas import Domain, EpisodeSummary, Origin, RecordingSummary

S = TypeVar("S", EpisodeSummary, RecordingSummary)
_COMPARED = ("task", "operator", "station", "domain", "success", "recovered", "origin")


@dataclass(frozen=True, slots=True)
class Entry(Generic[S]):
    """A row of the catalog, with further properties to filter by."""

    summary: S
    quality: Mapping[str, float]
    created_at: datetime | None


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


def _checked(text: str) -> str:
    quality_bound(text)
    return text


class CatalogFilter(FrozenModel):
    """Filter of episodes or recordings; omitted fields match anything.

    `min_quality` are bounds `NAME:NUMBER` that must all hold; an item without the figure does not
    match. Times are created_after ≤ t < created_before; an item without a time does not match.
    """

    task: str | None = None
    operator: str | None = None
    station: str | None = None
    domain: Domain | None = None
    success: bool | None = None
    recovered: bool | None = None
    min_quality: tuple[Annotated[str, AfterValidator(_checked)], ...] = ()
    created_after: AwareDatetime | None = None
    created_before: AwareDatetime | None = None

    def matcher(self) -> Callable[[Entry[S]], bool]:
        """Compile the filter to a fast predicate."""
        fields = [name for name in _COMPARED if getattr(self, name, None) is not None]
        get = attrgetter(*fields) if fields else None
        expected = get(self) if get else None
        bounds = [quality_bound(text) for text in self.min_quality]
        after, before = self.created_after, self.created_before

        def matches(entry: Entry[S]) -> bool:
            if get is not None and get(entry.summary) != expected:
                return False
            if any(not entry.quality.get(name, -math.inf) >= least for name, least in bounds):
                return False
            if after is None and before is None:
                return True
            at = entry.created_at
            return (
                at is not None
                and (after is None or after <= at)
                and (before is None or at < before)
            )

        return matches


class EpisodeFilter(CatalogFilter):
    """Filter of episodes."""

    origin: Origin | None = None


class Page(FrozenModel):
    """Page of a list: after an id, or from an offset."""

    limit: int | None = Field(default=None, ge=1)
    offset: int = Field(default=0, ge=0)
    after: str | None = Field(default=None, description="only ids after this one")

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
