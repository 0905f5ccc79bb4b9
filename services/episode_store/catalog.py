"""Catalog of a store: filtered lists of episodes and recordings, hours, lineage and groups."""

import json
import sqlite3
from collections import defaultdict, deque
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from datetime import date
from functools import partial
from typing import Any, Final, NamedTuple, TypeVar

import numpy as np

from dextouch import schemas
from dextouch.episodes import EpisodeStore, Kind
from dextouch.errors import NotFoundError
from services.episode_store.catalog_file import HALF_HOUR_US
from services.episode_store.catalog_index import CatalogIndex, Progress
from services.episode_store.filters import (
    EARLIEST,
    NO_WEIGHT,
    SORT_COLUMNS,
    WEIGHTS,
    CatalogFilter,
    Condition,
    EpisodeFilter,
    ItemFilter,
    Page,
    cursor_of,
    microseconds,
    number_key,
    place_of,
)
from services.episode_store.items import (
    FIGURES,
    MIN_ITEMS,
    HoursField,
    HoursFilter,
    Source,
    all_findings,
    linked_episode,
    take_of,
)

T = TypeVar("T")
S = TypeVar("S", schemas.EpisodeSummary, schemas.RecordingSummary)
FIRST_PAGE: Final = Page()
# Limit of the values of a field in one response.
MAX_VALUES: Final = 500
MAX_NODES: Final = 200
HOUR_NS: Final = 3600 * 10**9
DAY_US: Final = 24 * 3600 * 10**6
# Larger limits overflow SQLite's numbers once they are added to an offset.
MAX_LIMIT: Final = 1 << 60
# The row of an item, and of its last episode in the list of takes.
Found = tuple[int, int | None]
# Kind and id of an item.
Name = tuple[str, str]
_KEYS: Final = {"id": "''"} | {name: key.format("i.") for name, key in SORT_COLUMNS.items()}
_BEYOND_LIMIT: Final = number_key(WEIGHTS["beyond_limit"])
# As rows of a table of sums.
_EPISODES: Final = "(SELECT *, 1 AS num, duration_s * 1e9 AS duration_ns FROM item)"
_BODIES: Final = """SELECT i.row, i.kind, i.stands, i.is_compared, b.item, b.review, g.spread
  FROM item i JOIN body b USING (row) JOIN grp g ON g.number = i.grp
  WHERE i.row IN (SELECT value FROM json_each(?))"""
_SOURCES: Final = """SELECT l.row, s.kind, s.id, b.consent, s.complete, b.incomplete_cause, b.review
  FROM lineage l JOIN item s ON s.kind = l.kind AND s.id = l.source
    AND (l.sha256 IS NULL OR l.sha256 = s.sha256) JOIN body b ON b.row = s.row
  WHERE l.row IN (SELECT value FROM json_each(?)) ORDER BY l.row, l.position"""
_PRODUCTS: Final = """SELECT i.row, p.id
  FROM item i CROSS JOIN lineage l ON l.kind = 'recording' AND l.source = i.id
    AND (l.sha256 IS NULL OR l.sha256 = i.sha256)
  CROSS JOIN item p ON p.row = l.row AND p.kind = 'episode' AND p.origin <> 'imagined'
  WHERE +i.kind = 'recording' AND i.row IN (SELECT value FROM json_each(?))
  ORDER BY p.id, l.position"""


class ListedRow(NamedTuple):
    """An item as a command lists it; `size` are steps of an episode, samples of a recording."""

    id: str
    task: str
    domain: str
    origin: str
    size: int
    success: bool | None
    recovered: bool


@dataclass(frozen=True)
class Clickable:
    """An episode that training would take if its objects were clicked."""

    task: str
    clicks: schemas.EpisodeClicks | None


class Catalog:
    """Lists of all items of a store, from an index that all processes share.

    A damaged episode is omitted and logged once; `verify` reports the damage.
    """

    def __init__(self, store: EpisodeStore, progress: Progress | None = None) -> None:
        self._store = store
        self.index = CatalogIndex(store, progress)

    def episodes(
        self, query: EpisodeFilter, *, limit: int, page: Page = FIRST_PAGE
    ) -> schemas.EpisodeList:
        """One page of matching episodes in the order of the page."""
        rows, facts = self._summaries("episode", schemas.EpisodeSummary, query, limit, page)
        return schemas.EpisodeList.model_construct(episodes=rows, **facts)

    def recordings(
        self, query: CatalogFilter | None = None, *, limit: int, page: Page = FIRST_PAGE
    ) -> schemas.RecordingList:
        """One page of matching finished recordings in the order of the page."""
        wanted = query or CatalogFilter()
        rows, facts = self._summaries("recording", schemas.RecordingSummary, wanted, limit, page)
        return schemas.RecordingList.model_construct(recordings=rows, **facts)

    def _summaries(
        self, kind: Kind, model: type[S], query: CatalogFilter, limit: int, page: Page
    ) -> tuple[tuple[S, ...], dict[str, Any]]:
        where = Condition(terms=["i.kind = ?"], values=[kind])
        query.restrict(where)
        # Findings of an item on its own: limits, not outliers.
        weight = f"CASE WHEN i.beyond_limit THEN '{_BEYOND_LIMIT}' ELSE '{NO_WEIGHT}' END"
        order = _Order(_KEYS.get(page.sort, weight), "i.id", page)

        def read(connection: sqlite3.Connection) -> tuple[tuple[S, ...], dict[str, Any]]:
            found, facts = _page(connection, where, order, limit)
            text = "SELECT row, summary FROM body WHERE row IN (SELECT value FROM json_each(?))"
            bodies = dict(connection.execute(text, (_array(row for row, _ in found),)).fetchall())
            return tuple(model.model_validate_json(bodies[row]) for row, _ in found), facts

        return self.index.read(read)

    def rows(self, kind: Kind, query: CatalogFilter) -> list[ListedRow]:
        """All matching items of a kind in the order of ids, far faster than as summaries."""
        where = Condition(terms=["i.kind = ?"], values=[kind])
        query.restrict(where)
        text = f"SELECT {', '.join(ListedRow._fields)} FROM item i WHERE {where.sql} ORDER BY i.id"
        return self.index.read(
            lambda c: list(map(ListedRow._make, c.execute(text, where.values))), kind
        )

    def values(self) -> schemas.CatalogValues:
        """Tasks, operators and stations that occur, at most MAX_VALUES of each."""
        # Of each name, kind and review there is a row.
        text = "SELECT DISTINCT {0} FROM tally WHERE {0} > '' ORDER BY 1 LIMIT ?"

        def read(connection: sqlite3.Connection) -> schemas.CatalogValues:
            found = {
                f"{name}s": [row[0] for row in connection.execute(text.format(name), (MAX_VALUES,))]
                for name in ("task", "operator", "station")
            }
            return schemas.CatalogValues.model_validate(found)

        return self.index.read(read)

    def lineage(self, kind: Kind, item_id: str) -> schemas.Lineage:
        """Everything that an item was made from and that was made from it, nearest first.

        Raises NotFoundError: no such item.
        """
        return self.index.read(partial(_lineage, start=(kind, item_id)))

    def items(
        self, query: ItemFilter, *, limit: int, page: Page = FIRST_PAGE
    ) -> schemas.CatalogItems:
        """One page of matching recordings, episodes or takes in the order of the page."""
        of_takes = query.kind == "take"
        where = Condition(of_takes=of_takes, terms=["i.is_take"])
        if not of_takes:
            where = Condition(terms=["i.kind = ?"], values=[query.kind])
        query.restrict(where)
        weight = "i.take_weight" if of_takes else "i.weight"
        order = _Order(_KEYS.get(page.sort, weight), "i.name", page)

        def read(connection: sqlite3.Connection) -> schemas.CatalogItems:
            found, facts = _page(connection, where, order, limit)
            return schemas.CatalogItems.model_construct(items=_items(connection, found), **facts)

        return self.index.read(read)

    def groups(self) -> schemas.ComparedGroups:
        """The groups of items that are compared with each other to find outliers."""
        names = ("task", "domain", "origin", "kind", "num_items")
        text = f"SELECT {', '.join(names)} FROM grp WHERE num_items > 0 ORDER BY 1, 2, 3, 4"
        rows = self.index.read(lambda connection: connection.execute(text).fetchall())
        groups = (
            schemas.ComparedGroup(
                **dict(zip(names, row, strict=True)),
                min_items=MIN_ITEMS,
                is_compared=row[-1] >= MIN_ITEMS,
            )
            for row in rows
        )
        return schemas.ComparedGroups(groups=tuple(groups))

    def review(self, item: schemas.StoredItem, review: schemas.Review | None) -> None:
        """Keep the review of an item; None removes it. Raises NotFoundError: no such item."""
        self._store.set_review(item.id, review, kind=item.kind)
        self.index.reread(item.kind, item.id)

    def clickable(self) -> dict[str, Clickable]:
        """Episodes by id that training would take if their objects were clicked."""
        text = """SELECT i.id, i.task, b.clicks FROM item i JOIN body b USING (row)
          WHERE i.is_clickable AND i.verdict IS NOT 'rejected' ORDER BY i.id"""
        rows = self.index.read(lambda connection: connection.execute(text).fetchall())
        return {
            name: Clickable(task, clicks and schemas.EpisodeClicks.model_validate_json(clicks))
            for name, task, clicks in rows
        }

    def set_clicks(self, episode_id: str, clicks: schemas.EpisodeClicks | None) -> None:
        """Keep the clicks on the objects of an episode; raises as `review`."""
        self._store.set_clicks(episode_id, clicks)
        self.index.reread("episode", episode_id)

    def hours(self, query: EpisodeFilter) -> schemas.CatalogHours:
        """Total duration of matching episodes by task, domain and origin."""
        columns = "sum(i.num), coalesce(sum(i.success * i.num), 0), sum(i.duration_ns)"
        by = ("task", "domain", "origin")
        rows = [
            schemas.HoursRow(
                **dict(zip(by, names, strict=True)),
                num_episodes=count,
                num_successes=num_successes,
                hours=duration_ns / HOUR_NS,
            )
            for *names, count, num_successes, duration_ns in self._sums(
                [f"i.{name}" for name in by], columns, query
            )
        ]
        return schemas.CatalogHours(
            rows=tuple(rows),
            num_episodes=sum(row.num_episodes for row in rows),
            hours=sum(row.hours for row in rows),
        )

    def hours_by(self, field: HoursField, query: HoursFilter) -> schemas.HoursByField:
        """Total duration of matching episodes by the values of a field, and by their reviews."""
        column, table = f"i.{field}", "tally"
        if field == "day":
            # Days since the year 1, which are never negative.
            offset_us = query.utc_offset_min * 60 * 10**6
            column = f"(i.at_us + {offset_us - microseconds(EARLIEST)}) / {DAY_US}"
            table = _EPISODES if offset_us % HALF_HOUR_US else "half_hours"
        columns = "sum(i.num), sum(i.duration_ns)"
        found: defaultdict[Any, dict[str | None, tuple[int, float]]] = defaultdict(dict)
        for value, verdict, count, duration_ns in self._sums(
            (column, "i.verdict"), columns, query, table
        ):
            found[value][verdict] = count, duration_ns / HOUR_NS
        rows = []
        # SQLite sorts episodes without a value first.
        for value in sorted(found, key=lambda value: value is None):
            parts = found[value]
            names = {"accepted_h": "accepted", "rejected_h": "rejected", "not_reviewed_h": None}
            is_day = field == "day" and value is not None
            row = schemas.HoursOf(
                value=date.fromordinal(1 + value).isoformat() if is_day else value,
                num_episodes=sum(count for count, _ in parts.values()),
                **{name: parts.get(verdict, (0, 0.0))[1] for name, verdict in names.items()},
            )
            rows.append(row)
        return schemas.HoursByField(rows=tuple(rows))

    def _sums(
        self, by: Sequence[str], columns: str, query: EpisodeFilter, table: str = "tally"
    ) -> list[tuple[Any, ...]]:
        """Sums over matching episodes by values, in their order; from `table` if it can tell."""
        where = Condition(terms=["i.kind = 'episode'"])
        query.restrict(where)
        names, is_filtered = ", ".join(by), len(where.terms) > 1
        if not where.is_counted or (table == "half_hours" and is_filtered):
            table = _EPISODES
        text = f"SELECT {names}, {columns} FROM {table} i WHERE {where.sql} "
        text += f"GROUP BY {names} ORDER BY {names}"
        return self.index.read(lambda connection: connection.execute(text, where.values).fetchall())

    def bytes_by_station(self) -> dict[str, int]:
        """Disk usage of finished recordings by station."""
        text = "SELECT station, sum(num_bytes) FROM item WHERE kind = 'recording' GROUP BY station"
        return dict(self.index.read(lambda c: c.execute(text).fetchall(), "recording"))


@dataclass(frozen=True)
class _Order:
    """Columns of the key and the name by which rows are sorted, and the page of them."""

    key: str
    name: str
    page: Page

    @property
    def columns(self) -> str:
        down = " DESC" if self.page.descending else ""
        return f"n{down}" if self.page.sort == "id" else f"k{down}, n{down}"

    def go_on(self, where: Condition, place: tuple[str, str]) -> tuple[str, list[object]]:
        """The condition and parameters of rows after the page's cursor, by their key and name."""
        if self.page.after is None:
            return where.sql, where.values
        sign = "<" if self.page.descending else ">"
        after = place_of(self.page.after, descending=self.page.descending)
        if self.page.sort == "id" and not after[0]:
            return f"{where.sql} AND {place[1]} {sign} ?", [*where.values, after[1]]
        return f"{where.sql} AND ({', '.join(place)}) {sign} (?, ?)", [*where.values, *after]


def _page(
    connection: sqlite3.Connection, where: Condition, order: _Order, limit: int
) -> tuple[list[Found], dict[str, Any]]:
    """The rows of a page, and the number of all that match with the cursor to go on after."""
    limit = min(limit, MAX_LIMIT)
    found = f"SELECT i.row, i.aligned, {order.key} AS k, {order.name} AS n FROM item i"
    place = [limit + 1, min(order.page.offset, MAX_LIMIT)]
    if not where.is_rare:
        count = f"SELECT count(*) FROM item i WHERE {where.sql}"
        if where.is_counted:
            count = f"SELECT coalesce(sum(num), 0) FROM tally i WHERE {where.sql}"
        (num_matching,) = connection.execute(count, where.values).fetchone()
        later, values = order.go_on(where, (order.key, order.name))
        text = f"{found} WHERE {later} ORDER BY {order.columns} LIMIT ? OFFSET ?"
        rows = connection.execute(text, [*values, *place]).fetchall()
    else:
        # One scan for both: finding the page takes all rows, too.
        later, values = order.go_on(Condition(terms=["TRUE"]), ("k", "n"))
        text = f"""WITH m AS MATERIALIZED ({found} WHERE {where.sql})
          SELECT count(*), NULL, NULL, NULL FROM m UNION ALL SELECT * FROM (
            SELECT * FROM m WHERE {later} ORDER BY {order.columns} LIMIT ? OFFSET ?)"""
        (num_matching, *_), *rows = connection.execute(text, [*where.values, *values, *place])
    next_after = cursor_of(rows[limit - 1][2:]) if len(rows) > limit else None
    facts = {"num_matching": num_matching, "next_after": next_after}
    aligned = (lambda row: row[1]) if where.of_takes else (lambda _: None)
    return [(row[0], aligned(row)) for row in rows[:limit]], facts


def _array(rows: Iterable[int]) -> str:
    """Rows as a parameter of a query."""
    return json.dumps(list(rows))


def _items(
    connection: sqlite3.Connection, found: Sequence[Found]
) -> tuple[schemas.CatalogItem, ...]:
    """Items of rows with what others say of them; takes where a second row is given."""
    wanted = _array(row for pair in found for row in pair if row is not None)
    sources: defaultdict[int, list[Source]] = defaultdict(list)
    for row, kind, item_id, consent, complete, cause, review in connection.execute(
        _SOURCES, (wanted,)
    ):
        said = None if consent is None else bool(consent)
        one = Source(kind, item_id, said, bool(complete), cause, _review(review))
        sources[row].append(one)
    products: defaultdict[int, list[str]] = defaultdict(list)
    for row, item_id in connection.execute(_PRODUCTS, (wanted,)):
        products[row].append(item_id)
    items = {}
    for row, kind, stands, is_compared, text, written, spread in connection.execute(
        _BODIES, (wanted,)
    ):
        item = schemas.CatalogItem.model_validate_json(text)
        review = _review(written)
        counts = review if stands or review is None else review.earlier
        changes = {"review": counts, "episodes": tuple(products[row])}
        item = item.model_copy(update=changes)
        if kind == "episode":
            item = linked_episode(item, sources[row])
        scales = None if spread is None else np.frombuffer(spread).reshape(2, len(FIGURES))
        findings = all_findings(item, scales) if is_compared else ()
        items[row] = item.model_copy(update={"findings": findings})
    return tuple(
        items[row] if aligned is None else take_of(items[row], items[aligned])
        for row, aligned in found
    )


def _review(text: str | None) -> schemas.Review | None:
    return None if text is None else schemas.Review.model_validate_json(text)


def _lineage(connection: sqlite3.Connection, start: Name) -> schemas.Lineage:
    def sources(name: Name) -> list[Name]:
        text = """SELECT l.kind, l.source FROM item i JOIN lineage l USING (row)
          WHERE i.kind = ? AND i.id = ? ORDER BY l.position"""
        return connection.execute(text, name).fetchall()

    def products(name: Name) -> list[Name]:
        text = """SELECT i.kind, i.id FROM lineage l JOIN item i USING (row)
          WHERE l.kind = ? AND l.source = ? ORDER BY i.kind DESC, i.id, l.position"""
        return connection.execute(text, name).fetchall()

    text = "SELECT b.item FROM item i JOIN body b USING (row) WHERE i.kind = ? AND i.id = ?"
    if connection.execute(text, start).fetchone() is None:
        raise NotFoundError(f"{start[0]} {start[1]!r}: not in the catalog")
    nodes = {start: "self"}
    _walk(nodes, start, sources, "source")
    _walk(nodes, start, products, "product")
    rows = []
    for name, relation in nodes.items():
        found = connection.execute(text, name).fetchone()
        facts: dict[str, Any] = {"kind": name[0], "id": name[1], "relation": relation}
        facts |= {"is_stored": found is not None, "made_from": [one for _, one in sources(name)]}
        if found is not None:
            item = schemas.CatalogItem.model_validate_json(found[0])
            about = f"{item.task}, {item.domain}, {item.origin}, {item.duration_s:.1f} s"
            facts["summary"] = about
        rows.append(schemas.LineageNode.model_validate(facts))
    return schemas.Lineage(nodes=tuple(rows))


def _walk(
    nodes: dict[Name, str], start: Name, neighbours: Callable[[Name], Iterable[Name]], relation: str
) -> None:
    """Add everything that can be reached from an item, breadth first, until MAX_NODES."""
    waiting = deque([start])
    while waiting and len(nodes) < MAX_NODES:
        for name in neighbours(waiting.popleft()):
            if name not in nodes and len(nodes) < MAX_NODES:
                nodes[name] = relation
                waiting.append(name)
