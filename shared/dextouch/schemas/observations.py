"""Observations of rollouts, and the binary codec that server, client and store share.

Sent as JPEG, images take a tenth of the bytes, at the price of small errors: the array
`image/CAMERA`, uint8 [n, h, w, 3], is replaced by `jpeg/CAMERA`, uint8, the n files one behind the
other, and `jpeg_bytes/CAMERA`, int32 [n], their sizes.
"""

import itertools
import math
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, replace
from typing import Any, Final, Literal, TypeVar

import numpy as np
from jaxtyping import Float32, Float64, UInt8
from pydantic import BaseModel, Field, ValidationError, field_validator
from pydantic_core import from_json

from dextouch.errors import (
    DegenerateRotationError,
    InvalidInputError,
    LimitExceededError,
    NonFiniteError,
    ShapeError,
)
from dextouch.frozen_model import FrozenModel
from dextouch.geometry import rigid_error
from dextouch.hands.actions import ACTION_DIM, AnchorPoses, all_finite
from dextouch.images import decode_jpeg, encode_jpeg, jpeg_size
from dextouch.schemas.common import first_problems
from dextouch.schemas.rollouts import (
    WIRE_NAMES,
    ActionKind,
    RolloutInfo,
    RolloutUncertainty,
    StartRequest,
    Uncertainty,
)
from dextouch.streams import pack, unpack
from dextouch.tactile import MAX_CELLS
from dextouch.tactile.layout import NUM_TAXELS

# Tolerance of the norm of a unit quaternion in float32.
QUATERNION_TOLERANCE: Final = 1e-3
OBSERVED_ARRAYS = ("images", "tactile_kpa", "action_reached", "object_poses")
ANCHOR_NAMES = tuple(AnchorPoses.__dataclass_fields__)
RIGID_TOLERANCE = 1e-6
ModelT = TypeVar("ModelT", bound=BaseModel)
IMAGE_PREFIX: Final = "image/"
JPEG_PREFIX: Final = "jpeg/"
SIZES_PREFIX: Final = "jpeg_bytes/"
CHANNELS: Final = 3


class ReturnSelector(FrozenModel):
    """Requested part of an observation.

    Attributes:
        cameras: names of cameras; if omitted all of the world but the optional ones, an empty list
            means none. In a query, where an empty list cannot be written, none is `cameras=`.
        steps: all steps of the chunk, or only its last one.
        tactile: whether touch is sent.
        images: how images are sent; JPEG takes a tenth of the bytes, but is not exact.
    """

    cameras: tuple[str, ...] | None = None
    steps: Literal["last", "all"] = "all"
    tactile: bool = True
    images: Literal["raw", "jpeg"] = Field(default="raw", exclude_if=lambda how: how == "raw")

    @field_validator("cameras")
    @classmethod
    def _one_empty_name_means_none(cls, cameras: tuple[str, ...] | None) -> tuple[str, ...] | None:
        return () if cameras == ("",) else cameras

    def wants(self, camera: str) -> bool:
        """Whether images of this camera are requested."""
        return self.cameras is None or camera in self.cameras


EVERYTHING: Final = ReturnSelector()


@dataclass(frozen=True)
class Observation:
    """Images, touch and measurements over n consecutive steps of the model grid.

    `action_reached` is the pose and joint reading as an action, relative to the rollout's step 0:
    measured by a twin or a robot; in an imagined world, which does not sense joints, the commanded
    actions (`reached_is_measured` says which). `object_poses` are T_world_object (x y z in m, qw qx
    qy qz) as estimated by an imagined world, in the order of the description's `object_names`; None
    in worlds without object poses, such as a robot. `uncertainty` is about the whole chunk.
    """

    first_step: int
    images: dict[str, UInt8[np.ndarray, "n h w 3"]]
    tactile_kpa: Float32[np.ndarray, "n 2 taxels"]
    action_reached: Float64[np.ndarray, "n 67"]
    reached_is_measured: bool
    success: bool | None = None
    object_poses: Float32[np.ndarray, "n objects 7"] | None = None
    uncertainty: Uncertainty | None = None

    def __len__(self) -> int:
        return len(self.tactile_kpa)

    @property
    def last_step(self) -> int:
        """Index of the last step."""
        return self.first_step + len(self) - 1

    def last(self) -> "Observation":
        """The last step only."""
        # Not by `replace`, which takes longer than all the rest.
        return Observation(
            self.last_step,
            {camera: images[-1:] for camera, images in self.images.items()},
            self.tactile_kpa[-1:],
            self.action_reached[-1:],
            self.reached_is_measured,
            self.success,
            None if self.object_poses is None else self.object_poses[-1:],
            self.uncertainty,
        )

    def selected(self, selector: ReturnSelector) -> "Observation":
        """Apply a selector: the requested cameras, and all steps or the last one.

        The last step is an observation of one step that begins where the chunk ends. Touch is
        always kept; whether it is sent is decided by the sender.
        """
        chosen = self.last() if selector.steps == "last" else self
        if selector.cameras is None:
            return chosen
        images = {camera: rows for camera, rows in chosen.images.items() if selector.wants(camera)}
        return replace(chosen, images=images)


def rollout_uncertainty(observations: Iterable[Observation]) -> RolloutUncertainty:
    """The uncertainty of a whole rollout, from its observations in their order."""
    uncertainty = RolloutUncertainty()
    for seen in observations:
        uncertainty = uncertainty.after(seen.uncertainty, last_step=seen.last_step)
    return uncertainty


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


_UINT8: Final = np.dtype(np.uint8)
_FLOAT32: Final = np.dtype(np.float32)
_FLOAT64: Final = np.dtype(np.float64)


def check_observation_arrays(
    images: Mapping[str, np.ndarray],
    tactile_kpa: np.ndarray,
    action_reached: np.ndarray,
    object_poses: np.ndarray | None = None,
    *,
    where: str,
) -> None:
    """Check that the arrays of an observation are consistent and finite.

    Raises ShapeError for dtypes, lengths or shapes, NonFiniteError in touch, actions or object
    poses, DegenerateRotationError for an object's quaternion that is not of length 1.
    """
    num_steps = len(tactile_kpa) if tactile_kpa.ndim else 0
    if num_steps == 0:
        raise ShapeError(f"{where}: got 0 steps, expected at least 1")
    # How many taxels there are is a fact of the glove; worlds check it by their layout.
    num_taxels = tactile_kpa.shape[-1] if tactile_kpa.ndim == 3 else NUM_TAXELS
    if not 1 <= num_taxels <= MAX_CELLS:
        raise ShapeError(f"{where}: got {num_taxels} taxels, expected 1 … {MAX_CELLS}")
    _check_array("tactile_kpa", tactile_kpa, (_FLOAT32, (num_steps, 2, num_taxels)), where)
    _check_array("action_reached", action_reached, (_FLOAT64, (num_steps, ACTION_DIM)), where)
    size_px = next((array.shape[1:3] for array in images.values() if array.ndim == 4), (0, 0))
    for camera, array in images.items():
        _check_array(f"images of {camera}", array, (_UINT8, (num_steps, *size_px, 3)), where)
    if object_poses is not None:
        _check_object_poses(object_poses, num_steps, where)


def _check_object_poses(poses: np.ndarray, num_steps: int, where: str) -> None:
    num_objects = poses.shape[1] if poses.ndim == 3 else 1
    if num_objects == 0:
        raise ShapeError(f"{where}: object_poses got 0 objects, expected at least 1 or no poses")
    _check_array("object_poses", poses, (_FLOAT32, (num_steps, num_objects, 7)), where)
    off = np.abs(np.linalg.norm(poses[:, :, 3:], axis=2) - 1.0)
    if off.max() > QUATERNION_TOLERANCE:
        step, index = np.unravel_index(off.argmax(), off.shape)
        raise DegenerateRotationError(
            f"{where}: object_poses hold a quaternion (qw qx qy qz) of step {step}, object {index} "
            f"whose length is off 1 by {off.max():.1e}, expected at most {QUATERNION_TOLERANCE:.0e}"
        )


def _check_array(
    name: str, array: np.ndarray, expected: "tuple[np.dtype[Any], tuple[int, ...]]", where: str
) -> None:
    dtype, shape = expected
    if array.dtype != dtype or array.shape != shape:
        raise ShapeError(
            f"{where}: {name} got {array.dtype} {list(array.shape)}, expected {dtype} {list(shape)}"
        )
    if dtype.kind == "f" and not all_finite(array):
        raise NonFiniteError(f"{where}: {name} holds NaN or infinity, expected finite numbers")


class ObservationFields(FrozenModel):
    """The non-array fields of an observation."""

    model_config = WIRE_NAMES

    first_step: int
    reached_is_measured: bool
    success: bool | None = None
    uncertainty: Uncertainty | None = Field(
        default=None, exclude_if=lambda one: one is None, alias="doubt"
    )


class AnswerFields(FrozenModel):
    """The fields of a response with an observation."""

    rollout: RolloutInfo
    observation: ObservationFields
    info: dict[str, float] = Field(default={})


class JsonArray(FrozenModel):
    """An array within JSON.

    Attributes:
        dtype: of numpy, such as `uint8` or `float32`.
        shape: the number of entries along each axis.
        data: its bytes in C order, little endian, as base64.
    """

    dtype: str
    shape: tuple[int, ...]
    data: str


class JsonAnswer(FrozenModel):
    """A response with an observation as JSON; MessagePack holds the same without base64.

    Attributes:
        arrays: of n steps, by name: `image/CAMERA` uint8 [n, h, w, 3], or `jpeg/CAMERA` with
            `jpeg_bytes/CAMERA`; `tactile_kpa` float32 [n, 2, taxels], left hand first;
            `action_reached` float64 [n, 67]; with the first observation `K_head` [3, 3] and the
            poses `T_world_wrist_left`, `T_world_wrist_right`, `T_world_camera_head` [4, 4].
    """

    fields: AnswerFields
    arrays: dict[str, JsonArray]


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


def answer_parts(
    rollout: RolloutInfo,
    observation: Observation,
    *,
    selector: ReturnSelector = EVERYTHING,
    info: dict[str, float] | None = None,
    origin: RolloutOrigin | None = None,
) -> tuple[dict[str, Any], dict[str, np.ndarray]]:
    """Fields and arrays of a response: the rollout's progress and its observation as selected.

    `pack` encodes them, and `decode_answer` is the inverse of both if touch is selected.
    """
    arrays = _observation_arrays(observation)
    if not selector.tactile:
        del arrays["tactile_kpa"]
    if selector.images == "jpeg":
        arrays = encode_images(arrays)
    if origin is not None:
        arrays |= _origin_arrays(origin)
    # As of AnswerFields, but each part is validated once.
    fields = {
        "rollout": rollout.model_dump(mode="json"),
        "observation": _fields_of(observation),
        "info": {name: float(value) for name, value in (info or {}).items()},
    }
    return fields, arrays


def decode_answer(data: bytes, *, max_bytes: int) -> RolloutAnswer:
    """Decode a packed response that holds touch; raises InvalidInputError if it is not valid."""
    raw, arrays = unpack(data, max_bytes=max_bytes)
    fields = validate_fields(AnswerFields, raw, where="answer")
    if any(name.startswith(JPEG_PREFIX) for name in arrays):
        arrays = decode_images(arrays, max_bytes=max_bytes, where="answer")
    origin = _origin_from(arrays, where="answer") if "K_head" in arrays else None
    observation = _observation_from(fields.observation, arrays, where="answer")
    return RolloutAnswer(fields.rollout, observation, fields.info, origin)


def encode_observation(observation: Observation) -> bytes:
    """Encode an observation alone, for a world's snapshot."""
    return pack(_fields_of(observation), _observation_arrays(observation))


def decode_observation(data: bytes, *, max_bytes: int) -> Observation:
    """Inverse of `encode_observation`; raises InvalidInputError if it is not valid."""
    raw, arrays = unpack(data, max_bytes=max_bytes)
    fields = validate_fields(ObservationFields, raw, where="observation")
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
    fields = {"start": request.model_dump(mode="json"), "observation": observation}
    return pack(fields, arrays)


def decode_start(data: bytes, *, max_bytes: int) -> tuple[StartRequest, RolloutStart]:
    """Decode a start request of an untrusted source; raises InvalidInputError if it is invalid."""
    return start_of_parts(*unpack(data, max_bytes=max_bytes))


def start_of_parts(
    raw: Mapping[str, Any], arrays: Mapping[str, np.ndarray]
) -> tuple[StartRequest, RolloutStart]:
    """A start request of fields and arrays of an untrusted source; raises as `decode_start`."""
    fields = validate_fields(StartFields, raw, where="start")
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
    known = {} if origin is None else vars(origin)
    return RolloutStart(**request.model_dump(exclude={"world"}), observation=observation, **known)


def _fields_of(observation: Observation) -> dict[str, Any]:
    """The JSON of `ObservationFields`, made by hand in a fifth of the time."""
    success, uncertainty = observation.success, observation.uncertainty
    fields = {
        "first_step": int(observation.first_step),
        "reached_is_measured": bool(observation.reached_is_measured),
        "success": None if success is None else bool(success),
    }
    return (
        fields if uncertainty is None else fields | {"doubt": uncertainty.model_dump(mode="json")}
    )


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
    return vars(origin.anchor) | {"K_head": origin.K_head}


def _observation_from(
    fields: ObservationFields, arrays: Mapping[str, np.ndarray], *, where: str
) -> Observation:
    images = {
        name.removeprefix(IMAGE_PREFIX): array
        for name, array in arrays.items()
        if name.startswith(IMAGE_PREFIX)
    }
    tactile_kpa, action_reached = (_array(arrays, name, where) for name in OBSERVED_ARRAYS[1:3])
    found = (images, tactile_kpa, action_reached, arrays.get("object_poses"))
    known: dict[str, Any] = dict(zip(OBSERVED_ARRAYS, found, strict=True))
    check_observation_arrays(**known, where=where)
    return Observation(**dict(fields), **known)


def _origin_from(arrays: Mapping[str, np.ndarray], *, where: str) -> RolloutOrigin:
    poses = [_matrix(arrays, name, 4, where) for name in ANCHOR_NAMES]
    for name, T in zip(ANCHOR_NAMES, poses, strict=True):
        if (off := rigid_error(T)) > RIGID_TOLERANCE:
            raise DegenerateRotationError(
                f"{where}: {name} is not a rigid transform (off by {off:.1e}, expected at most "
                f"{RIGID_TOLERANCE:.0e})"
            )
    return RolloutOrigin(AnchorPoses(*poses), _matrix(arrays, "K_head", 3, where))


def _matrix(arrays: Mapping[str, np.ndarray], name: str, size: int, where: str) -> np.ndarray:
    matrix = _array(arrays, name, where)
    if matrix.shape != (size, size) or matrix.dtype != np.float64 or not np.isfinite(matrix).all():
        raise ShapeError(
            f"{where}: {name} got {matrix.dtype} {matrix.shape}, expected finite [{size}, {size}]"
        )
    return matrix


def _array(arrays: Mapping[str, np.ndarray], name: str, where: str) -> np.ndarray:
    if name not in arrays:
        listed = ", ".join(sorted(arrays)) or "none"
        raise InvalidInputError(f"{where}: array {name!r} is missing; got: {listed}")
    return arrays[name]


def validate_fields(model: type[ModelT], fields: object, *, where: str) -> ModelT:
    """A model of decoded fields, or of JSON as bytes; an InvalidInputError begins with `where`."""
    try:
        # Not model_validate_json, which converts unknown parts once per mistake.
        return model.model_validate(from_json(fields) if isinstance(fields, bytes) else fields)
    except ValidationError as error:
        raise InvalidInputError(f"{where}: {first_problems(error)}") from error
    except ValueError as error:
        raise InvalidInputError(f"{where}: Invalid JSON: {error}") from error


def encode_images(arrays: Mapping[str, np.ndarray]) -> dict[str, np.ndarray]:
    """Arrays of a response with its images as JPEG of quality 90."""
    found = {}
    for name, array in arrays.items():
        if not name.startswith(IMAGE_PREFIX):
            found[name] = array
            continue
        camera, files = name.removeprefix(IMAGE_PREFIX), [encode_jpeg(image) for image in array]
        found[JPEG_PREFIX + camera] = np.frombuffer(b"".join(files), np.uint8)
        found[SIZES_PREFIX + camera] = np.array([len(file) for file in files], np.int32)
    return found


def decode_images(
    arrays: Mapping[str, np.ndarray], *, max_bytes: int, where: str
) -> dict[str, np.ndarray]:
    """Inverse of `encode_images`, for a response that may hold JPEG.

    Raises InvalidInputError for sizes that do not fit, LimitExceededError for more than `max_bytes`
    once decoded, CorruptDataError for anything but JPEG.
    """
    found = {}
    for name, array in arrays.items():
        if name.startswith(JPEG_PREFIX):
            camera = name.removeprefix(JPEG_PREFIX)
            sizes = arrays.get(SIZES_PREFIX + camera)
            found[IMAGE_PREFIX + camera] = _decoded(
                array, sizes, max_bytes=max_bytes, where=f"{where}: images of {camera}"
            )
        elif not name.startswith(SIZES_PREFIX):
            found[name] = array
    return found


def _decoded(
    data: np.ndarray, sizes: np.ndarray | None, *, max_bytes: int, where: str
) -> np.ndarray:
    if sizes is None or sizes.dtype != np.int32 or sizes.ndim != 1 or (sizes < 1).any():
        raise InvalidInputError(f"{where}: the sizes of the JPEG files are missing or not positive")
    ends = [0, *itertools.accumulate(int(size) for size in sizes)]
    if data.dtype != np.uint8 or data.ndim != 1 or ends[-1] != len(data) or len(sizes) == 0:
        raise InvalidInputError(
            f"{where}: got {data.dtype} {list(data.shape)}, expected {ends[-1]} bytes of "
            f"{len(sizes)} JPEG files"
        )
    files = [data[start:end].tobytes() for start, end in itertools.pairwise(ends)]
    shapes = {jpeg_size(file, where=where) for file in files}
    if len(shapes) != 1:
        raise InvalidInputError(f"{where}: got sizes {sorted(shapes)} px, expected one size")
    decoded_bytes = len(files) * CHANNELS * math.prod(*shapes)
    if decoded_bytes > max_bytes:
        raise LimitExceededError(
            f"{where}: {decoded_bytes} bytes when decoded, expected at most {max_bytes}"
        )
    return np.stack([decode_jpeg(file, where=where) for file in files])
