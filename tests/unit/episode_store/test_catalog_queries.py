"""Queries of the catalog find what plain Python finds, while items come, go and are reviewed."""

from collections import Counter
from datetime import UTC, datetime, timedelta

import numpy as np
import pytest

from dextouch.episodes import EpisodeStore
from dextouch.schemas import StoredItem
from services.episode_store.catalog import Catalog
from services.episode_store.filters import EpisodeFilter, ItemFilter, Page
from services.episode_store.items import HoursFilter
from tests.unit.episode_store import plain_catalog as plain
from tests.unit.episode_store.random_items import NOON, put_item, put_random, review_random

# Names of which some are beginnings of others, which sort differently with what follows them.
NAMES = [
    f"{stem}{end}"
    for stem in ("a", "b", "c-d", "e_")
    for end in ("", "-1", "1", "_2", "0-x", "z", "-", "9")
]
# Midnight in UTC, India, Adelaide and Nepal, before 1970, too.
MIDNIGHTS = [
    datetime(year, 1, 1, *clock, tzinfo=UTC)
    for year in (2, 1970, 2026, 9998)
    for clock in ((0, 0), (18, 30), (14, 30), (18, 15))
]
SORTS = ["id", "time", "duration", "task", "operator", "station", "findings"]


def shared_filters(rng):
    """A random filter of all lists: mostly of few fields."""
    after = NOON + timedelta(minutes=int(rng.integers(-3000, 3000)))
    values = {
        "task": ["a", "b", "none"],
        "operator": ["ada", "bo"],
        "station": ["bench"],
        "domain": ["human", "robot"],
        "success": [True, False],
        "outcome": ["success", "failure", "not_judged"],
        "recovered": [True, False],
        "trace_id": ["0123456789abcdef" * 2],
        "text": ["STAND", "STRASSE", "a\n", "c-d", "bench"],
        "min_quality": [("other:0",), ("coverage:-0.1", "other:-inf"), ("no:0",), ("no:-inf",)],
        "created_after": [after],
        "created_before": [after + timedelta(hours=20)],
        "origin": ["recorded", "twin", "imagined"],
    }
    return {n: v[rng.integers(len(v))] for n, v in values.items() if rng.random() < 0.12}


def random_page(rng, sort):
    return {"sort": sort, "descending": bool(rng.integers(2)), "offset": int(rng.integers(3))}


def page_through(get, page, limit):
    """All rows of a list, read in pages, and how many match on the first."""
    rows, count, after = [], None, None
    while count is None or after is not None:
        found = get(limit=limit, page=Page(**page | {"after": after}))
        count = found.num_matching if count is None else count
        rows += found.items if hasattr(found, "items") else found.episodes
        page, after = page | {"offset": 0}, found.next_after
    return rows, count


@pytest.mark.parametrize("seed", range(2))
def test_queries_are_those_of_plain_python(settings, seed):
    store, rng = EpisodeStore(settings.store_url), np.random.default_rng(seed)
    catalogs = [Catalog(store), Catalog(store)]
    checked = Counter()
    for _ in range(3):
        for _ in range(40):
            kind, name = put_random(store, rng, NAMES)
            if rng.random() < 0.4:
                review_random(store, rng, kind, name)
            if rng.random() < 0.15:
                name = store.list(kind=kind)[0]
                store.delete(name, kind=kind)
        names = [
            (kind, name) for kind in ("episode", "recording") for name in store.list(kind=kind)
        ]
        for catalog in catalogs:
            catalog.index.check()
        kind, name = names[rng.integers(len(names))]
        catalogs[0].review(StoredItem(kind=kind, id=name), None)
        recordings, episodes = (plain.read_all(store, kind) for kind in ("recording", "episode"))
        lists = plain.listed(recordings, episodes)
        for catalog in catalogs:
            compare_items(catalog, lists, rng, checked)
            compare_episodes(catalog, episodes, lists["episode"], rng, checked)
            groups = {
                (g.task, g.domain, g.origin, g.kind): g.num_items for g in catalog.groups().groups
            }
            assert groups == expected_groups(lists)
    # Neither all filters matched nothing, nor all findings were missing.
    assert checked["rows"] > 300
    assert checked["outlier"] > 10, checked
    assert checked["takes with an episode"] > 10


def compare_items(catalog, lists, rng, checked):
    for kind, entries in lists.items():
        for sort in SORTS:
            own = {
                "kind": kind,
                "review": ["accepted", "rejected", "not_reviewed"][rng.integers(3)],
            }
            own |= {"flagged": bool(rng.integers(2)), "id": tuple(rng.choice(NAMES, 6))}
            chosen = {n: own[n] for n in own if n == "kind" or rng.random() < 0.2}
            query = ItemFilter.model_validate(shared_filters(rng) | chosen)
            page = random_page(rng, sort)
            expected = plain.in_order(entries, query, Page(**page))
            rows, count = page_through(
                lambda query=query, **facts: catalog.items(query, **facts), page, 3
            )
            assert count == len(expected), query
            wanted = [row[2].item for row in expected[page["offset"] :]]
            assert [one.model_dump() for one in rows] == [one.model_dump() for one in wanted], query
            checked["rows"] += count
            checked["takes with an episode"] += sum(one.aligned is not None for one in rows)
            checked.update(one.code for item in rows for one in item.findings)


def compare_episodes(catalog, episodes, linked, rng, checked):
    for sort in SORTS:
        chosen = {"derived_from": str(rng.choice(NAMES))} if rng.random() < 0.3 else {}
        query = EpisodeFilter.model_validate(shared_filters(rng) | chosen)
        page = random_page(rng, sort)
        expected = plain.in_order(episodes, query, Page(**page))
        rows, count = page_through(
            lambda query=query, **facts: catalog.episodes(query, **facts), page, 3
        )
        assert count == len(expected), query
        assert rows == [row[2].summary for row in expected[page["offset"] :]], query
        for field in ("task", "operator", "station", "day"):
            offset_min = int(rng.integers(-14 * 60, 14 * 60))
            wanted = HoursFilter(**query.model_dump(), utc_offset_min=offset_min)
            matching = [one for one in linked.values() if plain.matches(one, query)]
            sums = plain.hours_by(matching, field, offset_min)
            found = catalog.hours_by(field, wanted).rows
            order = sorted(sums, key=lambda value: (value is None, value or ""))
            assert [row.value for row in found] == order
            for row in found:
                for verdict in ("accepted", "rejected", "not_reviewed"):
                    hours = getattr(row, f"{verdict}_h")
                    assert 3600 * hours == pytest.approx(sums[row.value].get(verdict, 0.0))
        hours = catalog.hours(query)
        assert hours.num_episodes == count
        seconds = sum(row[2].summary.duration_s for row in expected)
        assert 3600 * hours.hours == pytest.approx(seconds)
        checked["rows"] += count


@pytest.mark.parametrize("seed", range(2))
def test_hours_of_days_are_those_of_a_recount(settings, seed):
    """About midnight of several zones, while episodes and sources come, go and are reviewed."""
    store, rng = EpisodeStore(settings.store_url), np.random.default_rng(seed)
    catalog, sources = Catalog(store), ["r-0", "r-1"]
    for name in sources:
        put_item(store, "recording", name)
    for _ in range(8):
        for name in rng.choice(NAMES, 8, replace=False):
            at = MIDNIGHTS[rng.integers(16)] - timedelta(microseconds=int(rng.integers(2)))
            changes = {
                "created_at": at if rng.random() < 0.9 else None,
                "task": rng.choice(["a", "b"]),
            }
            changes["lineage"] = [{"kind": "recording", "id": str(rng.choice(sources))}]
            put_item(store, "episode", name, num_rows=int(rng.integers(1, 999)), **changes)
        review_random(store, rng, "recording", sources[rng.integers(2)])
        for name in rng.choice(store.list(), 2, replace=False):
            review_random(store, rng, "episode", name)
        store.delete(store.list()[0])
        catalog.index.check()
        linked = plain.listed(*(plain.read_all(store, kind) for kind in ("recording", "episode")))
        filters = [{}, {"task": "a"}, {"text": "b"}, {"created_after": NOON}, {"domain": "robot"}]
        for chosen in filters:
            for offset_min in (0, 330, 570, -570, 345, int(rng.integers(-840, 841))):
                query = HoursFilter(**chosen, utc_offset_min=offset_min)
                items = [e for e in linked["episode"].values() if plain.matches(e, query)]
                sums = plain.hours_by(items, "day", offset_min)
                rows = catalog.hours_by("day", query).rows
                assert {row.value for row in rows} == sums.keys()
                assert sum(row.num_episodes for row in rows) == len(items)
                for row in rows:
                    for verdict in ("accepted", "rejected", "not_reviewed"):
                        found_s = 3600 * getattr(row, f"{verdict}_h")
                        assert found_s == pytest.approx(sums[row.value].get(verdict, 0.0))


def expected_groups(lists):
    """Numbers of compared items: those without an episode that were not rejected."""
    items = [one.item for kind in ("episode", "recording") for one in lists[kind].values()]
    return Counter(
        (item.task, item.domain, item.origin, item.kind)
        for item in items
        if not item.episodes and (item.review is None or item.review.verdict != "rejected")
    )


@pytest.mark.parametrize("sort", SORTS)
def test_pages_have_no_gaps_while_items_come_and_go(settings, sort):
    """Items that are there all the time are listed once each; others at most once."""
    store, rng = EpisodeStore(settings.store_url), np.random.default_rng(3)
    steady = {f"s-{number:02d}" for number in range(30)}
    for name in steady:
        put_item(store, "episode", name, num_rows=int(rng.integers(1, 50)), task=f"t{name[-1]}")
    for number in range(20):
        put_item(store, "episode", f"gone-{number}", task=f"t{number % 7}")
    catalog, listed, page = Catalog(store), [], {"sort": sort}
    for number in range(100):
        found = catalog.items(ItemFilter(), limit=4, page=Page(**page))
        listed += [item.id for item in found.items]
        if found.next_after is None:
            break
        page["after"] = found.next_after
        for name in [name for name in store.list() if name.startswith("gone")][:2]:
            store.delete(name)
        put_item(store, "episode", f"new-{number}", num_rows=number + 1, task=f"t{number % 7}")
    times = Counter(listed)
    assert set(times) >= steady
    if sort != "findings":
        # How unusual an item is depends on all others.
        assert set(times.values()) == {1}


def test_ways_through_the_lineage_are_those_of_all_items(settings):
    store = EpisodeStore(settings.store_url)
    put_item(store, "recording", "r")
    above = [{"kind": "recording", "id": "r"}]
    put_item(store, "episode", "e", lineage=above)
    put_item(store, "episode", "f", lineage=[{"kind": "episode", "id": "e"}, *above])
    found = Catalog(store).lineage("recording", "r").nodes
    nodes = [(node.id, node.relation, node.made_from) for node in found]
    assert nodes == [("r", "self", ()), ("e", "product", ("r",)), ("f", "product", ("e", "r"))]
