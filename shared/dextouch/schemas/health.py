"""The bodies of /healthz and /readyz: is the process alive, and may work be sent to it."""

from typing import Literal

from pydantic import BaseModel, ConfigDict


class Health(BaseModel):
    """The process answers."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    status: Literal["ok"] = "ok"
    service: str
    version: str


class Readiness(BaseModel):
    """Whether work may be sent; `waiting_for` names what is missing (empty when ready)."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    ready: bool
    service: str
    waiting_for: tuple[str, ...] = ()
