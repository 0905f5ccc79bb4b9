"""Settings of a service of worlds: how many rollouts there are, how long they get and stay."""

from pydantic import Field, model_validator

from dextouch.frozen_model import FrozenModel
from dextouch.serving import ServiceSettings


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
        lt=1e9,
        description="seconds until an unused rollout expires; every chunk restarts them; below 1e9",
    )


class WorldServiceSettings(ServiceSettings):
    """Settings of a service of worlds; subclass to add those of a world."""

    state_url: str = Field(
        default="memory://", description="store of rollouts: memory:// or redis://HOST:PORT/DB"
    )
    limits: RolloutLimits = RolloutLimits()
    workers: int = Field(
        default=1, ge=1, le=64, description="processes on one port; more than one needs redis://"
    )
    drain_s: float = Field(
        default=0.0,
        ge=0,
        le=600,
        description="seconds after SIGTERM without new rollouts and not ready, before the port is "
        "closed (of one process)",
    )

    @model_validator(mode="after")
    def _workers_share_their_state(self) -> "WorldServiceSettings":
        if self.workers > 1 and self.state_url == "memory://":
            raise ValueError(
                f"workers: got {self.workers} with state_url memory://, which each of them would "
                "have for itself; set state_url to redis://HOST:PORT/DB"
            )
        return self
