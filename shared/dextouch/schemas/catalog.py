"""Schemas of the store's catalog beyond its lists: values to filter by, lineage, and the trash."""

from typing import Literal

from pydantic import AwareDatetime, Field

from dextouch.frozen_model import FrozenModel
from dextouch.schemas.episodes import StoreId

ItemKind = Literal["episode", "recording"]
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
