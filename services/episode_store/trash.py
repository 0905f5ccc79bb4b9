"""HTTP routes of the store's trash: delete and restore many items, and list what is deleted."""

from collections.abc import Callable
from datetime import UTC, datetime
from typing import Annotated

import structlog
from fastapi import APIRouter, Depends, Query

from dextouch.episodes import KINDS, EpisodeStore
from dextouch.errors import DexTouchError
from dextouch.schemas import (
    MovedItems,
    MoveItems,
    RefusedItem,
    StoredItem,
    TrashContents,
    TrashedItem,
)
from dextouch.serving import RequireScope

logger = structlog.get_logger(__name__)

MAY_READ = Depends(RequireScope("store_read"))
MAY_DELETE = Depends(RequireScope("store_delete"))
NS_PER_S = 1_000_000_000


def trash_router(store: EpisodeStore, *, max_page: int) -> APIRouter:
    """Create the routes below /v1/trash."""
    router = APIRouter(prefix="/v1/trash", tags=["trash"])

    @router.get("", dependencies=[MAY_READ])
    def contents(limit: Annotated[int, Query(ge=1)] = 100) -> TrashContents:
        """Deleted episodes and recordings, newest first; refused for a store in a bucket."""
        entries = [entry for entry in store.trash_list() if entry.kind in KINDS]
        newest = entries[::-1][: min(limit, max_page)]
        items = [
            TrashedItem.model_validate(
                {
                    "kind": entry.kind,
                    "id": entry.item_id,
                    "deleted_at": datetime.fromtimestamp(entry.deleted_at_ns / NS_PER_S, UTC),
                    "num_bytes": entry.num_bytes,
                }
            )
            for entry in newest
        ]
        return TrashContents(items=tuple(items), num_items=len(entries))

    @router.post("", dependencies=[MAY_DELETE])
    def delete(wanted: MoveItems) -> MovedItems:
        """Move items to the trash; refused for a store in a bucket, which has none."""
        store.require_trash()
        return _move(wanted, lambda item: store.delete(item.id, kind=item.kind))

    @router.post("/restore", dependencies=[MAY_DELETE])
    def restore(wanted: MoveItems) -> MovedItems:
        """Restore items from the trash, each the one that was deleted last."""
        store.require_trash()
        return _move(wanted, lambda item: store.restore(item.id, kind=item.kind))

    return router


def _move(wanted: MoveItems, move: Callable[[StoredItem], None]) -> MovedItems:
    moved, refused = [], []
    for item in wanted.items:
        try:
            move(item)
        except DexTouchError as error:
            refused.append(RefusedItem(kind=item.kind, id=item.id, reason=error.message))
        else:
            moved.append(item)
    logger.info("items_moved", moved=[item.id for item in moved], num_refused=len(refused))
    return MovedItems(moved=tuple(moved), refused=tuple(refused))
