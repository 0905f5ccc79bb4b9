"""Bodies of the liveness and readiness probes /healthz and /readyz."""

from typing import Literal

from pydantic import BaseModel, ConfigDict


class Health(BaseModel):
    """Liveness: the process responds."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    status: Literal["ok"] = "ok"
    service: str
    version: str


class Readiness(BaseModel):
    """Readiness for requests; `waiting_for` names what is missing (empty when ready)."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    ready: bool
    service: str
    waiting_for: tuple[str, ...] = ()
