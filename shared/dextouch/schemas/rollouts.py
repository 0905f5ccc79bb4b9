"""The nouns of a rollout: worlds and starts as requests, observations and progress as answers."""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Literal

import numpy as np
from jaxtyping import Float32, Float64, UInt8
from pydantic import BaseModel, ConfigDict, Field

from dextouch.errors import NonFiniteError, ShapeError
from dextouch.hands.actions import ACTION_DIM, AnchorPoses

ActionKind = Literal["measured", "commanded"]
WorldKind = Literal["twin", "model", "baseline", "robot"]
MAX_SEED = 2**63 - 1


class WorldDescription(BaseModel):
    """What a world is and accepts: the handshake before a rollout."""

    model_config = ConfigDict(frozen=True, extra="forbid")

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


@dataclass(frozen=True)
class Observation:
    """What is seen, felt and measured over n consecutive steps of the model grid.

    `action_reached` is the pose and joint reading as an action, relative to the rollout's step 0:
    measured by a twin or a robot; in an imagined world, which senses no joints, the actions it was
    given (`reached_is_measured` says which).
    """

    first_step: int
    images: dict[str, UInt8[np.ndarray, "n h w 3"]]
    tactile_kpa: Float32[np.ndarray, "n 2 320"]
    action_reached: Float64[np.ndarray, "n 67"]
    reached_is_measured: bool
    success: bool | None = None

    def __len__(self) -> int:
        return len(self.tactile_kpa)

    def last(self) -> "Observation":
        """Its last step alone."""
        return Observation(
            first_step=self.first_step + len(self) - 1,
            images={camera: images[-1:] for camera, images in self.images.items()},
            tactile_kpa=self.tactile_kpa[-1:],
            action_reached=self.action_reached[-1:],
            reached_is_measured=self.reached_is_measured,
            success=self.success,
        )


@dataclass(frozen=True)
class RolloutStart:
    """Where a future begins: a task and seed, or an observation made elsewhere.

    `anchor` are the absolute poses of step 0, `K_head` the head camera's matrix in pixels; both
    come with `observation` (one step), and with every first observation that a world gives.
    """

    task: str
    seed: int
    instruction: str
    action_kind: ActionKind = "commanded"
    observation: Observation | None = None
    anchor: AnchorPoses | None = None
    K_head: Float64[np.ndarray, "3 3"] | None = None


class WorldList(BaseModel):
    """Answer of GET /v1/worlds."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    worlds: tuple[WorldDescription, ...]


class StartRequest(BaseModel):
    """The fields of POST /v1/rollouts; an observation to start from travels as arrays beside it."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    world: str
    task: str
    seed: int = Field(ge=0, le=MAX_SEED)
    instruction: str = Field(max_length=1000)
    action_kind: ActionKind = "commanded"


class ForkRequest(BaseModel):
    """The body of POST /v1/rollouts/{id}/fork; a new seed gives the branch its own noise."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    seed: int | None = Field(default=None, ge=0, le=MAX_SEED)


class ReturnSelector(BaseModel):
    """Which part of an observation is sent; cameras None means all that the world has."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    cameras: tuple[str, ...] | None = None
    steps: Literal["last", "all"] = "all"
    tactile: bool = True


class RolloutInfo(BaseModel):
    """Where a rollout stands; `next_chunk` is the only number that is accepted next."""

    model_config = ConfigDict(frozen=True, extra="forbid")

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


def check_observation(observation: Observation, *, where: str) -> None:
    """Refuse an observation that `check_observation_arrays` refuses."""
    check_observation_arrays(
        images=observation.images,
        tactile_kpa=observation.tactile_kpa,
        action_reached=observation.action_reached,
        where=where,
    )


def check_observation_arrays(
    *,
    images: Mapping[str, np.ndarray],
    tactile_kpa: np.ndarray,
    action_reached: np.ndarray,
    where: str,
) -> None:
    """Refuse arrays that do not fit each other or hold NaN or infinity.

    Raises:
        ShapeError: kinds of number, lengths or shapes that do not fit.
        NonFiniteError: in touch or actions.
    """
    num_steps = len(tactile_kpa) if tactile_kpa.ndim else 0
    if num_steps == 0:
        raise ShapeError(f"{where}: got 0 steps, expected at least 1")
    _check_array("tactile_kpa", tactile_kpa, ("float32", (num_steps, 2, 320)), where)
    _check_array("action_reached", action_reached, ("float64", (num_steps, ACTION_DIM)), where)
    size_px = next((array.shape[1:3] for array in images.values() if array.ndim == 4), (0, 0))
    for camera, array in images.items():
        _check_array(f"images of {camera}", array, ("uint8", (num_steps, *size_px, 3)), where)


def _check_array(
    name: str, array: np.ndarray, expected: tuple[str, tuple[int, ...]], where: str
) -> None:
    if (array.dtype.name, array.shape) != expected:
        raise ShapeError(
            f"{where}: {name} got {array.dtype.name} {list(array.shape)}, "
            f"expected {expected[0]} {list(expected[1])}"
        )
    if array.dtype.kind == "f" and not np.isfinite(array).all():
        raise NonFiniteError(f"{where}: {name} holds NaN or infinity, expected finite numbers")
