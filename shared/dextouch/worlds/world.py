"""The World protocol of the twin, world models and, one day, a real robot; checks; fixed batches.

A world is functional: `step` maps a state to a new one, so that a failed step leaves the old state
unchanged, a step can be replayed, and a rollout can branch.
"""

import time
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from typing import Any, Generic, Protocol, TypeVar, runtime_checkable

import numpy as np
from jaxtyping import Float32, Float64, UInt8

from dextouch.errors import (
    DegenerateRotationError,
    DexTouchError,
    InvalidInputError,
    LimitExceededError,
    ShapeError,
    UnknownNameError,
)
from dextouch.hands.actions import (
    ACTION_DIM,
    IDENTITY_POSE_9D,
    POSE_SLICES,
    WRIST_LEFT,
    AnchorPoses,
)
from dextouch.schemas import (
    EVERYTHING,
    Observation,
    ReturnSelector,
    RolloutStart,
    WorldDescription,
    check_observation_arrays,
)

State = TypeVar("State")


@dataclass(frozen=True)
class StartedRollout(Generic[State]):
    """Result of a start: state, first observation, and the anchor poses of actions."""

    state: State
    observation: Observation
    anchor: AnchorPoses
    K_head: Float64[np.ndarray, "3 3"]


@dataclass(frozen=True)
class SteppedRollout(Generic[State]):
    """Result of an action chunk: the new state and the requested observation of its K steps."""

    state: State
    observation: Observation
    info: dict[str, float] = field(default_factory=dict)


@runtime_checkable
class World(Protocol[State]):
    """A world. Implementations need not be thread-safe.

    Each call of one with an attribute `is_quick` that is true takes well below a millisecond. It is
    then made in the event loop itself: changing to another thread and back would take longer.
    """

    @property
    def description(self) -> WorldDescription:
        """Capabilities of this world."""
        ...

    def reset(self, start: RolloutStart) -> StartedRollout[State]:
        """Start a rollout.

        Raises:
            UnknownNameError: a task that this world lacks.
            InvalidInputError: an unsupported kind of start.
        """
        ...

    def step(
        self,
        state: State,
        actions: Float64[np.ndarray, "steps 67"],
        *,
        seed: int,
        selector: ReturnSelector = EVERYTHING,
    ) -> SteppedRollout[State]:
        """Advance by one action chunk, which the world validates (`check_actions`).

        Row i of actions [K, 67] is the pose at step i+1 of the chunk, relative to the rollout's
        step 0 (measured poses), of the action kind the rollout was started with. The state is from
        `reset`, `step` or `restore`, and is not changed. Equal state, actions and seed of the noise
        give an equal observation, regardless of other rollouts. The result equals
        `Observation.selected` of the full one, so a world can skip rendering unrequested images;
        the new state does not depend on the selector.

        Raises:
            InvalidInputError: wrong shape, NaN, infinity, or out of reach; nothing has changed.
            LimitExceededError: more steps than `max_chunk_steps`, in a world model.
            EndedError: the world cannot continue from this state, for the given reason; the state
                remains valid for `snapshot`.
        """
        ...

    def snapshot(self, state: State) -> bytes:
        """Serialize a state (without pickle) for `restore` of the same world."""
        ...

    def restore(self, data: bytes) -> State:
        """Restore the state of a snapshot; raises InvalidInputError for one of another world."""
        ...


@runtime_checkable
class BatchWorld(World[State], Protocol[State]):
    """A world that advances several rollouts together faster than one by one."""

    def step(
        self,
        state: State,
        actions: Float64[np.ndarray, "steps 67"],
        *,
        seed: int,
        selector: ReturnSelector = EVERYTHING,
    ) -> SteppedRollout[State]:
        """`step_batch` of one rollout."""
        chunks = np.asarray(actions)[None]
        return self.step_batch([state], chunks, seeds=[seed], selectors=[selector])[0]

    def step_batch(
        self,
        states: Sequence[State],
        actions: Float64[np.ndarray, "batch steps 67"],
        *,
        seeds: Sequence[int],
        selectors: Sequence[ReturnSelector] | None = None,
    ) -> list[SteppedRollout[State]]:
        """`step` for each entry; results do not depend on the other entries.

        Chunks have one length; there is one seed per rollout, and one selector: None requests
        everything.
        """
        ...


@runtime_checkable
class ReconstructingWorld(World[State], Protocol[State]):
    """A world model with codecs, whose own error is the least that its predictions can have."""

    def reconstruct(
        self,
        images: UInt8[np.ndarray, "steps h w 3"],
        tactile_kpa: Float32[np.ndarray, "steps 2 taxels"],
    ) -> tuple[UInt8[np.ndarray, "later h w 3"], Float32[np.ndarray, "later 2 taxels"]]:
        """Encode and decode head images and touch of 1 + 4k consecutive steps.

        Returns images and touch of the steps after the first.
        """
        ...


def check_start(start: RolloutStart, description: WorldDescription) -> RolloutStart:
    """Validate a start and keep only images of this world's cameras."""
    if start.task not in description.tasks:
        raise UnknownNameError("task", start.task, list(description.tasks))
    if start.action_kind not in description.action_kinds:
        raise UnknownNameError("action kind", start.action_kind, list(description.action_kinds))
    way = "task_seed" if start.observation is None else "observation"
    if way not in description.starts_from:
        raise InvalidInputError(
            f"world {description.name}: got a start from {way}, expected one of "
            f"{', '.join(description.starts_from)}"
        )
    if start.observation is None:
        return start
    if len(start.observation) != 1:
        raise ShapeError(f"start: observation has {len(start.observation)} steps, expected 1")
    images = start.observation.images
    more = tuple(camera for camera in description.optional_cameras if camera in images)
    cameras = description.cameras + more
    used = {camera: images[camera] for camera in cameras if camera in images}
    observation = replace(start.observation, images=used)
    size_px = None if description.scales_images else _size_px(description)
    _check_fits(observation, description, size_px, cameras, where="start")
    return replace(start, observation=observation)


def check_chunk(
    actions: np.ndarray, description: WorldDescription
) -> Float64[np.ndarray, "steps 67"]:
    """Validate the length of an action chunk and return it as float64.

    Its numbers are validated by the world, which every `World` does before it changes anything.
    """
    checked = np.asarray(actions, dtype=np.float64)
    if checked.ndim != 2 or checked.shape[1] != ACTION_DIM or len(checked) == 0:
        raise ShapeError(f"chunk: got shape {checked.shape}, expected [K ≥ 1, {ACTION_DIM}]")
    if len(checked) % description.chunk_multiple:
        raise ShapeError(
            f"chunk: got {len(checked)} steps, expected a multiple of {description.chunk_multiple}",
            got=len(checked),
            multiple=description.chunk_multiple,
        )
    if len(checked) > description.max_chunk_steps:
        raise LimitExceededError(
            f"chunk: got {len(checked)} steps, expected at most {description.max_chunk_steps}",
            got=len(checked),
            maximum=description.max_chunk_steps,
        )
    return checked


def check_selector(selector: ReturnSelector, description: WorldDescription) -> None:
    """Refuse cameras that the world lacks."""
    known = description.cameras + description.optional_cameras
    for camera in selector.cameras or ():
        if camera not in known:
            raise UnknownNameError("camera", camera, list(known))


def asked_cameras(selector: ReturnSelector, usual: tuple[str, ...]) -> tuple[str, ...]:
    """Cameras that a selector asks for: the usual ones, or in the order of their names here."""
    return usual if selector.cameras is None else tuple(dict.fromkeys(selector.cameras))


def check_answer(
    observation: Observation,
    description: WorldDescription,
    *,
    first_step: int,
    num_steps: int,
    selector: ReturnSelector = EVERYTHING,
) -> None:
    """Validate a world's response to a chunk; of `steps="last"` only the last step is expected.

    Raises:
        NonFiniteError: NaN or infinity in the response, as extreme actions may cause.
        DexTouchError: wrong length, size or step: the world violates its description.
    """
    if selector.steps == "last":
        first_step, num_steps = first_step + num_steps - 1, 1
    cameras = asked_cameras(selector, description.cameras)
    where = f"answer of world {description.name} (the rollout stays as it was)"
    if (observation.first_step, len(observation)) != (first_step, num_steps):
        raise DexTouchError(
            f"{where}: got {len(observation)} steps from {observation.first_step}, expected "
            f"{num_steps} from {first_step}"
        )
    try:
        _check_fits(observation, description, _size_px(description), cameras, where=where)
    except (ShapeError, DegenerateRotationError) as error:
        raise DexTouchError(error.message) from error


def _check_fits(
    observation: Observation,
    description: WorldDescription,
    size_px: tuple[int, int] | None,
    cameras: tuple[str, ...],
    *,
    where: str,
) -> None:
    seen = observation.images, observation.tactile_kpa, observation.action_reached
    check_observation_arrays(*seen, observation.object_poses, where=where)
    if (num_taxels := observation.tactile_kpa.shape[-1]) != description.num_taxels:
        layout = description.tactile_layout
        raise ShapeError(
            f"{where}: tactile_kpa holds {num_taxels} taxels of one hand, expected "
            f"{description.num_taxels} of layout "
            f"{'dextouch_v1' if layout is None else layout.name!r}"
        )
    if observation.images.keys() != set(cameras):
        raise ShapeError(
            f"{where}: got images of {sorted(observation.images)}, expected of {sorted(cameras)}"
        )
    for camera, images in observation.images.items():
        if 0 in images.shape:
            raise ShapeError(f"{where}: images of {camera} are empty, {images.shape}")
        if size_px is not None and images.shape[1:3] != size_px:
            raise ShapeError(
                f"{where}: images of {camera} are {images.shape[1:3]} px, expected {size_px}"
            )


def _size_px(description: WorldDescription) -> tuple[int, int]:
    return description.image_height_px, description.image_width_px


_NOTHING = ReturnSelector(cameras=(), steps="last")


class FixedBatchWorld(BatchWorld[State]):
    """Pads the batches of a world with `step_batch` to a fixed size, for results equal bit for bit.

    Matrix products of another batch size round differently, so that a rollout depends on how many
    others are stepped with it. With a fixed size it does not, at the cost of computing `size`
    entries for every chunk.
    """

    def __init__(self, world: BatchWorld[State], size: int) -> None:
        if size < 1:
            raise InvalidInputError(f"fixed batch: got a size of {size}, expected at least 1")
        self._world = world
        self._size = size

    @property
    def description(self) -> WorldDescription:
        """That of the world."""
        return self._world.description

    def reset(self, start: RolloutStart) -> StartedRollout[State]:
        """See World."""
        return self._world.reset(start)

    def step_batch(
        self,
        states: Sequence[State],
        actions: Float64[np.ndarray, "batch steps 67"],
        *,
        seeds: Sequence[int],
        selectors: Sequence[ReturnSelector] | None = None,
    ) -> list[SteppedRollout[State]]:
        """See BatchWorld; raises InvalidInputError for more entries than the fixed size."""
        missing = self._size - len(states)
        if missing < 0:
            raise InvalidInputError(
                f"fixed batch: got {len(states)} entries, expected at most {self._size}"
            )
        requested = [EVERYTHING] * len(states) if selectors is None else list(selectors)
        found = self._world.step_batch(
            [*states, *[states[-1]] * missing],
            np.concatenate([actions, np.repeat(actions[-1:], missing, axis=0)]),
            seeds=[*seeds, *[seeds[-1]] * missing],
            selectors=[*requested, *[_NOTHING] * missing],
        )
        return found[: len(states)]

    def snapshot(self, state: State) -> bytes:
        """See World."""
        return self._world.snapshot(state)

    def restore(self, data: bytes) -> State:
        """See World."""
        return self._world.restore(data)


def first_chunk_s(world: World[Any]) -> float:
    """Start a rollout and advance it by one chunk; returns the duration.

    In a model, a wrist moves by a millimetre, since a scene at rest is not computed.

    Raises DexTouchError if the world begins nothing from black images, or cannot continue.
    """
    began_s = time.perf_counter()
    description = world.description
    started = world.reset(_plain_start(description))
    held = np.repeat(started.observation.action_reached[-1:], description.chunk_multiple, axis=0)
    if description.kind == "model":
        held[:, WRIST_LEFT.start] += 1e-3
    stepped = world.step(started.state, held, seed=0)
    world.restore(world.snapshot(stepped.state))
    return time.perf_counter() - began_s


def _plain_start(description: WorldDescription) -> RolloutStart:
    """A task and seed where the world takes them, otherwise black images and hands at rest."""
    task, kind = description.tasks[0], description.action_kinds[0]
    if "task_seed" in description.starts_from:
        return RolloutStart(task, 0, "", kind)
    height_px, width_px = description.image_height_px, description.image_width_px
    still = np.zeros((1, ACTION_DIM))
    for pose in POSE_SLICES:
        still[:, pose] = IDENTITY_POSE_9D
    images = {
        camera: np.zeros((1, height_px, width_px, 3), np.uint8) for camera in description.cameras
    }
    touch_kpa = np.zeros((1, 2, description.num_taxels), np.float32)
    observation = Observation(
        first_step=0,
        images=images,
        tactile_kpa=touch_kpa,
        action_reached=still,
        reached_is_measured=True,
    )
    K_head = np.array([[width_px, 0, width_px / 2], [0, width_px, height_px / 2], [0, 0, 1.0]])
    anchor = AnchorPoses(np.eye(4), np.eye(4), np.eye(4))
    return RolloutStart(task, 0, "", kind, observation, anchor, K_head)
