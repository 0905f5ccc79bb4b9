"""Routes of /v1/catalog: statistics of the stored episodes."""

from typing import Annotated

from fastapi import APIRouter, Query

from dextouch.schemas import CatalogHours
from services.episode_store.catalog import Catalog
from services.episode_store.filters import EpisodeFilter
from services.episode_store.routes.scopes import MAY_READ


def catalog_router(*, catalog: Catalog) -> APIRouter:
    """Create the router."""
    router = APIRouter(prefix="/v1/catalog", tags=["catalog"], dependencies=[MAY_READ])

    @router.get("/hours")
    def hours(wanted: Annotated[EpisodeFilter, Query()]) -> CatalogHours:
        """Hours and counts of the matching episodes by task, domain and origin."""
        return catalog.hours(wanted)

    return router
