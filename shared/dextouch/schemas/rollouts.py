"""Schemas of rollouts: world descriptions, start requests, observations and progress."""

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Final, Literal

import numpy as np
from jaxtyping import Float32, Float64, UInt8
from pydantic import Field, field_validator, model_validator

from dextouch.errors import DegenerateRotationError, NonFiniteError, ShapeError
from dextouch.frozen_model import FrozenModel
from dextouch.hands.actions import ACTION_DIM, AnchorPoses

ActionKind = Literal["measured", "commanded"]
WorldKind = Literal["twin", "model", "baseline", "robot"]
MAX_SEED = 2**63 - 1
# Tolerance of the norm of a unit quaternion in float32.
QUATERNION_TOLERANCE: Final = 1e-3


class WorldDescription(FrozenModel):
    """Capabilities of a world, exchanged before a rollout.

    `object_names` lists, by task, the objects whose poses are in its observations; empty for a
    world without object poses.
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


class ReturnSelector(FrozenModel):
    """Requested part of an observation.

    `cameras` None means all cameras of the world, an empty list none; in a query, where an empty
    list cannot be written, none is `cameras=`.
    """

    cameras: tuple[str, ...] | None = None
    steps: Literal["last", "all"] = "all"
    tactile: bool = True

    @field_validator("cameras")
    @classmethod
    def _one_empty_name_means_none(cls, cameras: tuple[str, ...] | None) -> tuple[str, ...] | None:
        return () if cameras == ("",) else cameras

    def wants(self, camera: str) -> bool:
        """Whether images of this camera are requested."""
        return self.cameras is None or camera in self.cameras


EVERYTHING: Final = ReturnSelector()


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


@dataclass(frozen=True)
class Observation:
    """Images, touch and measurements over n consecutive steps of the model grid.

    `action_reached` is the pose and joint reading as an action, relative to the rollout's step 0:
    measured by a twin or a robot; in an imagined world, which does not sense joints, the commanded
    actions (`reached_is_measured` says which). `object_poses` are T_world_object (x y z in m, qw qx
    qy qz) as estimated by an imagined world, in the order of the description's `object_names`; None
    in worlds without object poses, such as a robot. `doubt` is about the whole chunk.
    """

    first_step: int
    images: dict[str, UInt8[np.ndarray, "n h w 3"]]
    tactile_kpa: Float32[np.ndarray, "n 2 320"]
    action_reached: Float64[np.ndarray, "n 67"]
    reached_is_measured: bool
    success: bool | None = None
    object_poses: Float32[np.ndarray, "n objects 7"] | None = None
    doubt: Doubt | None = None

    def __len__(self) -> int:
        return len(self.tactile_kpa)

    def last(self) -> "Observation":
        """The last step only."""
        return replace(
            self,
            first_step=self.first_step + len(self) - 1,
            images={camera: images[-1:] for camera, images in self.images.items()},
            tactile_kpa=self.tactile_kpa[-1:],
            action_reached=self.action_reached[-1:],
            object_poses=None if self.object_poses is None else self.object_poses[-1:],
        )

    def selected(self, selector: ReturnSelector) -> "Observation":
        """Apply a selector: the requested cameras, and all steps or the last one.

        The last step is an observation of one step that begins where the chunk ends. Touch is
        always kept; whether it is sent is decided by the sender.
        """
        shown = self.last() if selector.steps == "last" else self
        wanted = {camera: rows for camera, rows in shown.images.items() if selector.wants(camera)}
        return replace(shown, images=wanted)


@dataclass(frozen=True)
class RolloutStart:
    """Start of a rollout: a task and seed, or an observation made elsewhere.

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


class WorldList(FrozenModel):
    """Response of GET /v1/worlds."""

    worlds: tuple[WorldDescription, ...]


class StartRequest(FrozenModel):
    """The fields of POST /v1/rollouts; an observation to start from is sent as arrays."""

    world: str
    task: str
    seed: int = Field(ge=0, le=MAX_SEED)
    instruction: str = Field(max_length=1000)
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


def check_observation(observation: Observation, *, where: str) -> None:
    """Validate an observation with `check_observation_arrays`."""
    check_observation_arrays(
        images=observation.images,
        tactile_kpa=observation.tactile_kpa,
        action_reached=observation.action_reached,
        object_poses=observation.object_poses,
        where=where,
    )


def check_observation_arrays(
    *,
    images: Mapping[str, np.ndarray],
    tactile_kpa: np.ndarray,
    action_reached: np.ndarray,
    object_poses: np.ndarray | None = None,
    where: str,
) -> None:
    """Check that the arrays of an observation are consistent and finite.

    Raises:
        ShapeError: inconsistent dtypes, lengths or shapes.
        NonFiniteError: in touch, actions or object poses.
        DegenerateRotationError: an object's quaternion is not of length 1.
    """
    num_steps = len(tactile_kpa) if tactile_kpa.ndim else 0
    if num_steps == 0:
        raise ShapeError(f"{where}: got 0 steps, expected at least 1")
    _check_array("tactile_kpa", tactile_kpa, ("float32", (num_steps, 2, 320)), where)
    _check_array("action_reached", action_reached, ("float64", (num_steps, ACTION_DIM)), where)
    size_px = next((array.shape[1:3] for array in images.values() if array.ndim == 4), (0, 0))
    for camera, array in images.items():
        _check_array(f"images of {camera}", array, ("uint8", (num_steps, *size_px, 3)), where)
    if object_poses is not None:
        _check_object_poses(object_poses, num_steps, where)


def _check_object_poses(poses: np.ndarray, num_steps: int, where: str) -> None:
    num_objects = poses.shape[1] if poses.ndim == 3 else 1
    if num_objects == 0:
        raise ShapeError(f"{where}: object_poses got 0 objects, expected at least 1 or no poses")
    _check_array("object_poses", poses, ("float32", (num_steps, num_objects, 7)), where)
    off = np.abs(np.linalg.norm(poses[:, :, 3:], axis=2) - 1.0)
    if off.max() > QUATERNION_TOLERANCE:
        step, index = np.unravel_index(off.argmax(), off.shape)
        raise DegenerateRotationError(
            f"{where}: object_poses hold a quaternion (qw qx qy qz) of step {step}, object {index} "
            f"whose length is off 1 by {off.max():.1e}, expected at most {QUATERNION_TOLERANCE:.0e}"
        )


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
