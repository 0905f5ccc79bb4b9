"""Clients of the DexTouch services for policies and stations, with few dependencies."""

from typing import TYPE_CHECKING

from dextouch.lazy_exports import lazy_exports

if TYPE_CHECKING:
    from dextouch.clients.episode_store import EpisodeStoreClient
    from dextouch.clients.http_link import HttpLink, Reply
    from dextouch.clients.policy import Policy, PolicyStart
    from dextouch.clients.rollouts import Rollout, RolloutClient
else:
    __getattr__, __dir__ = lazy_exports(
        __name__,
        {
            "episode_store": "EpisodeStoreClient",
            "http_link": "HttpLink Reply",
            "policy": "Policy PolicyStart",
            "rollouts": "Rollout RolloutClient",
        },
    )

__all__ = [
    "EpisodeStoreClient",
    "HttpLink",
    "Policy",
    "PolicyStart",
    "Reply",
    "Rollout",
    "RolloutClient",
    "gym_env",
]
