"""Binary codec of rollout requests and responses, shared by server, client and store."""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, TypeVar

import numpy as np
from jaxtyping import Float64
from pydantic import BaseModel, Field, ValidationError

from dextouch.errors import DegenerateRotationError, InvalidInputError, ShapeError
from dextouch.frozen_model import FrozenModel
from dextouch.hands.actions import AnchorPoses
from dextouch.schemas.problems import first_problems
from dextouch.schemas.rollouts import (
    Doubt,
    Observation,
    RolloutInfo,
    RolloutStart,
    StartRequest,
    check_observation_arrays,
)
from dextouch.streams import pack, unpack

IMAGE_PREFIX = "image/"
ANCHOR_NAMES = ("T_world_wrist_left", "T_world_wrist_right", "T_world_camera_head")
RIGID_TOLERANCE = 1e-6
ModelT = TypeVar("ModelT", bound=BaseModel)


class ObservationFields(FrozenModel):
    """The non-array fields of an observation."""

    first_step: int
    reached_is_measured: bool
    success: bool | None = None
    doubt: Doubt | None = Field(default=None, exclude_if=lambda doubt: doubt is None)


class AnswerFields(FrozenModel):
    """The fields of a response with an observation."""

    rollout: RolloutInfo
    observation: ObservationFields
    info: dict[str, float] = Field(default={})


class StartFields(FrozenModel):
    """The fields of a start request with an observation."""

    start: StartRequest
    observation: ObservationFields | None = None


@dataclass(frozen=True)
class RolloutOrigin:
    """Anchor poses and camera matrix of a rollout, given with its first observation."""

    anchor: AnchorPoses
    K_head: Float64[np.ndarray, "3 3"]


@dataclass(frozen=True)
class RolloutAnswer:
    """A decoded response; `origin` only with the first observation of a rollout."""

    rollout: RolloutInfo
    observation: Observation
    info: dict[str, float]
    origin: RolloutOrigin | None


def encode_answer(
    rollout: RolloutInfo,
    observation: Observation,
    *,
    tactile: bool = True,
    info: dict[str, float] | None = None,
    origin: RolloutOrigin | None = None,
) -> bytes:
    """Encode an observation with the rollout's progress; without touch unless `tactile`."""
    arrays = _observation_arrays(observation)
    if not tactile:
        del arrays["tactile_kpa"]
    if origin is not None:
        arrays |= _origin_arrays(origin)
    fields = AnswerFields(rollout=rollout, observation=_fields_of(observation), info=info or {})
    return pack(fields.model_dump(mode="json"), arrays)


def decode_answer(data: bytes, *, max_bytes: int) -> RolloutAnswer:
    """Decode the result of `encode_answer` with tactile.

    Raises:
        InvalidInputError: not a valid response.
    """
    raw, arrays = unpack(data, max_bytes=max_bytes)
    fields = _validated(AnswerFields, raw, where="answer")
    origin = _origin_from(arrays, where="answer") if "K_head" in arrays else None
    observation = _observation_from(fields.observation, arrays, where="answer")
    return RolloutAnswer(fields.rollout, observation, fields.info, origin)


def encode_observation(observation: Observation) -> bytes:
    """Encode an observation alone, for a world's snapshot."""
    return pack(_fields_of(observation).model_dump(mode="json"), _observation_arrays(observation))


def decode_observation(data: bytes, *, max_bytes: int) -> Observation:
    """Inverse of `encode_observation`.

    Raises:
        InvalidInputError: not a valid observation.
    """
    raw, arrays = unpack(data, max_bytes=max_bytes)
    fields = _validated(ObservationFields, raw, where="observation")
    return _observation_from(fields, arrays, where="observation")


def encode_start(request: StartRequest, start: RolloutStart) -> bytes:
    """The body of POST /v1/rollouts, with the observation to start from if there is one."""
    arrays: dict[str, np.ndarray] = {}
    observation = None
    if start.observation is not None:
        if start.anchor is None or start.K_head is None:
            raise InvalidInputError("start: an observation needs anchor and K_head beside it")
        arrays = _observation_arrays(start.observation)
        arrays |= _origin_arrays(RolloutOrigin(start.anchor, start.K_head))
        observation = _fields_of(start.observation)
    fields = StartFields(start=request, observation=observation)
    return pack(fields.model_dump(mode="json"), arrays)


def decode_start(data: bytes, *, max_bytes: int) -> tuple[StartRequest, RolloutStart]:
    """Decode and validate a start request from an untrusted source.

    Raises:
        InvalidInputError: not a valid start request.
    """
    raw, arrays = unpack(data, max_bytes=max_bytes)
    fields = _validated(StartFields, raw, where="start")
    if fields.observation is None:
        return fields.start, start_from(fields.start)
    observation = _observation_from(fields.observation, arrays, where="start")
    origin = _origin_from(arrays, where="start")
    return fields.start, start_from(fields.start, observation=observation, origin=origin)


def start_from(
    request: StartRequest,
    *,
    observation: Observation | None = None,
    origin: RolloutOrigin | None = None,
) -> RolloutStart:
    """Build the start from a request and an optional observation."""
    return RolloutStart(
        task=request.task,
        seed=request.seed,
        instruction=request.instruction,
        action_kind=request.action_kind,
        observation=observation,
        anchor=None if origin is None else origin.anchor,
        K_head=None if origin is None else origin.K_head,
    )


def _fields_of(observation: Observation) -> ObservationFields:
    return ObservationFields.model_validate(observation, from_attributes=True)


def _observation_arrays(observation: Observation) -> dict[str, np.ndarray]:
    arrays = {
        "tactile_kpa": observation.tactile_kpa,
        "action_reached": observation.action_reached,
        **{IMAGE_PREFIX + camera: images for camera, images in observation.images.items()},
    }
    if observation.object_poses is not None:
        arrays["object_poses"] = observation.object_poses
    return arrays


def _origin_arrays(origin: RolloutOrigin) -> dict[str, np.ndarray]:
    return {
        **dict(zip(ANCHOR_NAMES, origin.anchor.as_tuple(), strict=True)),
        "K_head": origin.K_head,
    }


def _observation_from(
    fields: ObservationFields, arrays: Mapping[str, np.ndarray], *, where: str
) -> Observation:
    images = {
        name.removeprefix(IMAGE_PREFIX): array
        for name, array in arrays.items()
        if name.startswith(IMAGE_PREFIX)
    }
    found: dict[str, Any] = {
        "images": images,
        "tactile_kpa": _array(arrays, "tactile_kpa", where=where),
        "action_reached": _array(arrays, "action_reached", where=where),
        "object_poses": arrays.get("object_poses"),
    }
    check_observation_arrays(**found, where=where)
    return Observation(**dict(fields), **found)


def _origin_from(arrays: Mapping[str, np.ndarray], *, where: str) -> RolloutOrigin:
    poses = []
    for name in ANCHOR_NAMES:
        T = _array(arrays, name, where=where)
        if T.shape != (4, 4) or T.dtype != np.float64 or not np.isfinite(T).all():
            raise ShapeError(f"{where}: {name} got {T.dtype} {T.shape}, expected finite [4, 4]")
        R = T[:3, :3]
        bottom = np.array([0.0, 0.0, 0.0, 1.0])
        off = max(np.abs(R.T @ R - np.eye(3)).max(), np.abs(T[3] - bottom).max())
        if off > RIGID_TOLERANCE or np.linalg.det(R) < 0:
            raise DegenerateRotationError(
                f"{where}: {name} is not a rigid transform (off by {off:.1e}, expected at most "
                f"{RIGID_TOLERANCE:.0e})"
            )
        poses.append(T)
    K_head = _array(arrays, "K_head", where=where)
    if K_head.shape != (3, 3) or K_head.dtype != np.float64 or not np.isfinite(K_head).all():
        raise ShapeError(f"{where}: K_head got {K_head.dtype} {K_head.shape}, expected [3, 3]")
    return RolloutOrigin(AnchorPoses(*poses), K_head)


def _array(arrays: Mapping[str, np.ndarray], name: str, *, where: str) -> np.ndarray:
    if name not in arrays:
        listed = ", ".join(sorted(arrays)) or "none"
        raise InvalidInputError(f"{where}: array {name!r} is missing; got: {listed}")
    return arrays[name]


def _validated(model: type[ModelT], fields: object, *, where: str) -> ModelT:
    try:
        return model.model_validate(fields)
    except ValidationError as error:
        raise InvalidInputError(f"{where}: {first_problems(error)}") from error
