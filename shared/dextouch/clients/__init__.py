"""Clients of the DexTouch services for policies and stations, with few dependencies."""

from typing import TYPE_CHECKING

from dextouch.lazy_exports import lazy_exports

if TYPE_CHECKING:
    from dextouch.clients import gym_env as gym_env
    from dextouch.clients.episode_store import EpisodeStoreClient as EpisodeStoreClient
    from dextouch.clients.http_link import HttpLink as HttpLink
    from dextouch.clients.http_link import Reply as Reply
    from dextouch.clients.openpi import OpenPiPolicy as OpenPiPolicy
    from dextouch.clients.policy import Policy as Policy
    from dextouch.clients.policy import PolicyStart as PolicyStart
    from dextouch.clients.rollouts import Rollout as Rollout
    from dextouch.clients.rollouts import RolloutClient as RolloutClient
else:
    __getattr__, __dir__, __all__ = lazy_exports(__name__)
