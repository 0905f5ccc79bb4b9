"""Settings that limit the rollouts of a service: how many there are, how long they get and stay."""

from pydantic import Field

from dextouch.frozen_model import FrozenModel


class RolloutLimits(FrozenModel):
    """Limits of this installation; every chunk renews `ttl_s`."""

    max_rollouts: int = Field(default=64, ge=1, description="rollouts open at the same time")
    max_rollouts_per_key: int | None = Field(
        default=None, ge=1, description="open rollouts of one API key (default: no limit)"
    )
    max_chunks: int = Field(default=1000, ge=1, description="chunks of one rollout")
    ttl_s: float = Field(
        default=600.0,
        gt=0,
        description="seconds until an unused rollout expires; every chunk restarts them",
    )
