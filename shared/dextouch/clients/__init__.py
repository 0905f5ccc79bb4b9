"""Clients of the DexTouch services for policies and stations, with few dependencies."""

from dextouch.clients.policy import Policy, PolicyStart
from dextouch.clients.rollouts import Rollout, RolloutClient

__all__ = ["Policy", "PolicyStart", "Rollout", "RolloutClient"]
