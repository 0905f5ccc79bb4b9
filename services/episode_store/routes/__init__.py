"""HTTP routes of the store, one router per resource."""

from services.episode_store.routes.catalog import catalog_router
from services.episode_store.routes.episodes import episodes_router
from services.episode_store.routes.recordings import recordings_router
from services.episode_store.routes.uploads import uploads_router

__all__ = ["catalog_router", "episodes_router", "recordings_router", "uploads_router"]
