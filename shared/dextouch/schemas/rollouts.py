"""Schemas of rollouts without arrays: worlds, requests to start and fork, progress and doubt."""

from typing import Literal

from pydantic import Field, model_validator

from dextouch.free_text import FreeText
from dextouch.frozen_model import FrozenModel

ActionKind = Literal["measured", "commanded"]
WorldKind = Literal["twin", "model", "baseline", "robot"]
MAX_SEED = 2**63 - 1


class WorldDescription(FrozenModel):
    """Capabilities of a world, exchanged before a rollout.

    `object_names` lists, by task, the objects whose poses are in its observations; empty for a
    world without object poses. Touch is zero in observations of a world that does not predict it.
    """

    name: str
    kind: WorldKind
    digest: str
    tasks: tuple[str, ...]
    cameras: tuple[str, ...]
    image_height_px: int
    image_width_px: int
    model_rate_hz: float
    action_kinds: tuple[ActionKind, ...]
    starts_from: tuple[Literal["task_seed", "observation"], ...]
    chunk_multiple: int = 4
    max_chunk_steps: int = 64
    knows_success: bool = False
    object_names: dict[str, tuple[str, ...]] = Field(default={})
    predicts_touch: bool = Field(default=True, exclude_if=bool)


class WorldList(FrozenModel):
    """Response of GET /v1/worlds."""

    worlds: tuple[WorldDescription, ...]


class StartRequest(FrozenModel):
    """The fields of POST /v1/rollouts; an observation to start from is sent as arrays."""

    world: FreeText
    task: FreeText
    seed: int = Field(ge=0, le=MAX_SEED)
    instruction: FreeText = Field(max_length=1000)
    action_kind: ActionKind = "commanded"


class ForkRequest(FrozenModel):
    """The body of POST /v1/rollouts/{id}/fork; a new seed gives the branch its own noise."""

    seed: int | None = Field(default=None, ge=0, le=MAX_SEED)


class RolloutInfo(FrozenModel):
    """State of a rollout; `next_chunk` is the only chunk number accepted next.

    `ended` is why its world cannot continue it, omitted while it can.
    """

    id: str
    world: str
    world_digest: str
    task: str
    instruction: str
    seed: int
    action_kind: ActionKind
    next_chunk: int
    last_step: int
    ttl_s: float
    ended: str | None = Field(default=None, exclude_if=lambda reason: reason is None)


class Doubt(FrozenModel):
    """Uncertainty of an imagining world about its prediction.

    Both numbers are non-negative, and comparable within one world digest only.

    Attributes:
        disagreement: between several predictions of the same steps.
        distance: of the rollout from the training distribution.
        outside: whether the world's own bound is exceeded, so that the prediction is unreliable.
        reason: why it is outside; None otherwise.
    """

    disagreement: float = Field(ge=0, allow_inf_nan=False)
    distance: float = Field(ge=0, allow_inf_nan=False)
    outside: bool = False
    reason: str | None = Field(default=None, min_length=1, max_length=500)

    @model_validator(mode="after")
    def _a_reason_if_outside(self) -> "Doubt":
        if self.outside != (self.reason is not None):
            raise ValueError(
                f"got outside {self.outside} with reason {self.reason!r}, expected a reason where "
                "outside is true and none where it is not"
            )
        return self


class WatchedRollout(FrozenModel):
    """A rollout as it is shown to those who watch it, and who can neither advance nor end it.

    Attributes:
        watch_id: to read its newest response with; the rollout's own id cannot be derived from it.
        client: what the client says about itself, such as the name of a policy; may be empty.
        key: name of the API key that began it; empty without keys.
        age_s: since its start.
        idle_s: since its newest chunk, or its start.
        doubt: of the newest chunk; None where the world reports none.
        success: at the newest step; None where unknown.
        trace_id: of the request that began it; None if another version of DexTouch began it.
    """

    watch_id: str
    world: str
    world_digest: str
    task: str
    instruction: str
    seed: int
    next_chunk: int
    last_step: int
    ttl_s: float
    ended: str | None = None
    client: str = ""
    key: str = ""
    age_s: float
    idle_s: float
    doubt: Doubt | None = None
    success: bool | None = None
    trace_id: str | None = None


class WatchedRollouts(FrozenModel):
    """Response of GET /v1/watch: the newest rollouts first, and how many there are."""

    rollouts: tuple[WatchedRollout, ...]
    num_open: int
