"""HTTP routes of the store: one router a resource."""

from services.episode_store.routes.episodes import episodes_router
from services.episode_store.routes.recordings import recordings_router

__all__ = ["episodes_router", "recordings_router"]
