"""Lineage of an item within a store: all that it was made from and that was made from it."""

from collections import defaultdict, deque
from collections.abc import Callable, Iterable, Mapping

from dextouch.errors import NotFoundError
from dextouch.schemas import CatalogItem, EpisodeSummary, Lineage, LineageNode, RecordingSummary
from services.episode_store.filters import Entry

MAX_NODES = 200
Name = tuple[str, str]
AnyEntry = Entry[EpisodeSummary] | Entry[RecordingSummary]


def lineage_of(entries: Mapping[Name, AnyEntry], start: Name) -> Lineage:
    """Everything that an item was made from and that was made from it, nearest first.

    Raises:
        NotFoundError: no such item.
    """
    kind, item_id = start
    if start not in entries:
        raise NotFoundError(f"{kind} {item_id!r}: not in the catalog")
    sources = {
        name: tuple((one.kind, one.id) for one in entry.lineage) for name, entry in entries.items()
    }
    products: defaultdict[Name, list[Name]] = defaultdict(list)
    for name, above in sources.items():
        for one in above:
            products[one].append(name)
    nodes = {start: "self"}
    _walk(nodes, start, lambda name: sources.get(name, ()), "source")
    _walk(nodes, start, lambda name: products[name], "product")
    rows = [
        LineageNode.model_validate(
            {
                "kind": name[0],
                "id": name[1],
                "relation": relation,
                "is_stored": name in entries,
                "made_from": [one for _, one in sources.get(name, ())],
                "summary": _brief(entries[name].item) if name in entries else "",
            }
        )
        for name, relation in nodes.items()
    ]
    return Lineage(nodes=tuple(rows))


def _walk(
    nodes: dict[Name, str],
    start: Name,
    neighbours: Callable[[Name], Iterable[Name]],
    relation: str,
) -> None:
    """Add everything that can be reached from an item, breadth first, until MAX_NODES."""
    waiting = deque([start])
    while waiting and len(nodes) < MAX_NODES:
        for name in neighbours(waiting.popleft()):
            if name not in nodes and len(nodes) < MAX_NODES:
                nodes[name] = relation
                waiting.append(name)


def _brief(item: CatalogItem) -> str:
    return f"{item.task}, {item.domain}, {item.origin}, {item.duration_s:.1f} s"
