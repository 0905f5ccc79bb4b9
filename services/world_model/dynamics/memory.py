"""Batching, unbatching and serialization of scene memories."""

from collections.abc import Mapping, Sequence

import numpy as np
import torch
from torch import Tensor

from dextouch.errors import InvalidInputError, NonFiniteError
from dextouch.schemas import MAX_OBJECTS
from dextouch.tactile.layout import NUM_TAXELS
from services.world_model.dynamics.core import NUM_PADS, CoreState, SceneStart
from services.world_model.dynamics.features import (
    NUM_POINTS,
    SIZE_RANGE,
    DynamicsConfig,
    ObjectPoses,
)
from services.world_model.dynamics.members import named
from services.world_model.dynamics.model import SceneMemory

# Bound on metres, kilopascals and latents; this world never writes larger values.
_LARGEST = 1e6
# What every member knows has the axes members, batch, …; all else begins with the batch.
_OF_MEMBERS = ("start", "state", "success")
# Ranges within which this world writes values.
_RANGES = {
    "start.size": SIZE_RANGE,
    "state.hidden": (-1.0, 1.0),
    "state.position_m": (-1.0, 1.0),
    "state.axes": (-1.0, 1.0),
    "state.wrist_axes": (-1.0, 1.0),
    "success": (0.0, 1.0),
}


def stack_memories(memories: Sequence[SceneMemory]) -> SceneMemory:
    """Stack the memories of single rollouts into a batch."""
    return named(memories, lambda name, parts: torch.cat(parts, dim=_batch_axis(name)))


def memory_of(memory: SceneMemory, index: int) -> SceneMemory:
    """Memory of one rollout of a batch."""
    # Copies: a slice would keep the whole batch alive and share it with other rollouts.
    one = torch.tensor([index])
    return named([memory], lambda name, parts: parts[0].index_select(_batch_axis(name), one))


def _batch_axis(name: str) -> int:
    return int(name.partition(".")[0] in _OF_MEMBERS)


def memory_arrays(memory: SceneMemory) -> dict[str, np.ndarray]:
    """Arrays of a single rollout's memory, for a snapshot."""
    arrays: dict[str, np.ndarray] = {}

    def keep(name: str, parts: list[Tensor]) -> Tensor:
        arrays[name] = parts[0].contiguous().numpy()
        return parts[0]

    named([memory], keep)
    return arrays


def memory_from_arrays(
    arrays: Mapping[str, np.ndarray], config: DynamicsConfig, num_members: int
) -> SceneMemory:
    """Inverse of `memory_arrays`; validates untrusted arrays.

    Raises:
        InvalidInputError: missing arrays, wrong shapes or dtypes, or a task that the model does
            not have.
        NonFiniteError: NaN or infinity.
    """
    memory = named(
        [_empty(config, num_members)], lambda name, parts: _checked(name, arrays, parts[0])
    )
    task = memory.start.task
    if not bool(((task >= 0) & (task < len(config.tasks)) & (task == task[0, 0])).all()):
        raise InvalidInputError(
            f"snapshot: got task numbers {task.flatten().tolist()}, expected one of 0 … "
            f"{len(config.tasks) - 1} for all members"
        )
    return memory


def _empty(config: DynamicsConfig, members: int) -> SceneMemory:
    """The memory of one rollout with zeros: names, shapes and types of a snapshot."""
    objects = MAX_OBJECTS

    def zeros(*shape: int) -> Tensor:
        return torch.zeros(shape)

    def poses(*batch: int) -> ObjectPoses:
        return ObjectPoses(
            zeros(*batch, objects, 3), zeros(*batch, objects, 2, 3), zeros(*batch, objects)
        )

    start = SceneStart(
        objects=poses(members, 1),
        sd_m=zeros(members, 1, objects),
        size=zeros(members, 1, objects, 2),
        touch=zeros(members, 1, 2, config.touch_channels),
        pads_kpa=zeros(members, 1, NUM_PADS),
        task=torch.zeros((members, 1), dtype=torch.int64),
        commanded=zeros(members, 1),
    )
    state = CoreState(
        hidden=zeros(members, 1, config.width),
        position_m=zeros(members, 1, objects, 3),
        axes=zeros(members, 1, objects, 2, 3),
        wrist_m=zeros(members, 1, 2, 3),
        wrist_axes=zeros(members, 1, 2, 6),
    )
    return SceneMemory(
        start=start,
        state=state,
        poses=poses(1),
        disagreement_m=zeros(1),
        tactile_kpa=zeros(1, 2, NUM_TAXELS),
        success=zeros(members, 1),
        points_m=zeros(1, 2, NUM_POINTS, 3),
        num_still=torch.zeros(1, dtype=torch.int64),
    )


def _checked(name: str, arrays: Mapping[str, np.ndarray], expected: Tensor) -> Tensor:
    """One array of a snapshot as a tensor, within the range of what this world writes."""
    array, like = arrays.get(name), expected.numpy()
    if array is None or array.shape != like.shape or array.dtype != like.dtype:
        got = "nothing" if array is None else f"{array.dtype.name} {array.shape}"
        raise InvalidInputError(
            f"snapshot: {name} is {got}, expected {like.dtype.name} {like.shape} of this world's "
            "own snapshot"
        )
    if array.dtype.kind == "f" and not np.isfinite(array).all():
        raise NonFiniteError(f"snapshot: {name} contains NaN or infinity")
    if array.dtype.kind == "f" and np.abs(array).max() > _LARGEST:
        raise InvalidInputError(
            f"snapshot: {name} has values up to {np.abs(array).max():.3g}, expected at most "
            f"{_LARGEST:.0e}"
        )
    found = torch.from_numpy(np.array(array))
    return found.clamp(*_RANGES[name]) if name in _RANGES else found
