"""Bodies of the liveness and readiness probes /healthz and /readyz."""

from typing import Literal

from dextouch.frozen_model import FrozenModel


class Health(FrozenModel):
    """Liveness: the process responds."""

    status: Literal["ok"] = "ok"
    service: str
    version: str


class Readiness(FrozenModel):
    """Readiness for requests; `waiting_for` names what is missing (empty when ready)."""

    ready: bool
    service: str
    waiting_for: tuple[str, ...] = ()
