"""What policies and stations import to talk to the services; light on purpose."""

from dextouch.clients.policy import Policy, PolicyStart
from dextouch.clients.rollouts import Rollout, RolloutClient

__all__ = ["Policy", "PolicyStart", "Rollout", "RolloutClient"]
