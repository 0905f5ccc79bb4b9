"""Reviews of many items at once, each item on its own."""

from datetime import UTC, datetime

import structlog

from dextouch.errors import DexTouchError
from dextouch.schemas import RefusedItem, Review, ReviewedItems, ReviewItems
from services.episode_store.catalog import Catalog

logger = structlog.get_logger(__name__)


def review_items(catalog: Catalog, wanted: ReviewItems) -> ReviewedItems:
    """Keep the same review for all items, or remove their reviews; the rest is refused by item."""
    review = None
    if wanted.verdict is not None:
        review = Review(
            verdict=wanted.verdict,
            reason=wanted.reason,
            reviewer=wanted.reviewer,
            reviewed_at=datetime.now(UTC),
        )
    reviewed, refused = [], []
    for item in wanted.items:
        try:
            catalog.review(item, review)
        except DexTouchError as error:
            refused.append(RefusedItem(kind=item.kind, id=item.id, reason=error.message))
        else:
            reviewed.append(item)
    logger.info("items_reviewed", verdict=wanted.verdict, ids=[item.id for item in reviewed])
    return ReviewedItems(reviewed=tuple(reviewed), refused=tuple(refused))
