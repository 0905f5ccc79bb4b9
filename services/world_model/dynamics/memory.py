"""Batching, unbatching and serialization of scene memories."""

from collections.abc import Mapping, Sequence
from dataclasses import fields

import numpy as np
import torch
from torch import Tensor

from dextouch.errors import InvalidInputError, NonFiniteError
from dextouch.tactile.layout import NUM_TAXELS
from services.world_model.dynamics.configuration import MAX_OBJECTS, DynamicsConfig
from services.world_model.dynamics.core import NUM_PADS, CoreState, SceneStart
from services.world_model.dynamics.hand_motion import NUM_POINTS
from services.world_model.dynamics.model import SceneMemory
from services.world_model.dynamics.objects import ObjectPoses

_STATE = tuple(one.name for one in fields(CoreState))
# Bound on metres, kilopascals and latents; this world never writes larger values.
_LARGEST = 1e6


def stack_memories(memories: Sequence[SceneMemory]) -> SceneMemory:
    """Stack the memories of single rollouts into a batch."""
    members = range(len(memories[0].start))
    return SceneMemory(
        start=tuple(
            SceneStart(
                _stack_poses([memory.start[m].objects for memory in memories]),
                torch.cat([memory.start[m].sd_m for memory in memories]),
                torch.cat([memory.start[m].touch for memory in memories]),
                torch.cat([memory.start[m].pads_kpa for memory in memories]),
                torch.cat([memory.start[m].task for memory in memories]),
                torch.cat([memory.start[m].commanded for memory in memories]),
            )
            for m in members
        ),
        states=tuple(_stack_states([memory.states[m] for memory in memories]) for m in members),
        poses=_stack_poses([memory.poses for memory in memories]),
        disagreement_m=torch.cat([memory.disagreement_m for memory in memories]),
        tactile_kpa=torch.cat([memory.tactile_kpa for memory in memories]),
        success=torch.cat([memory.success for memory in memories], dim=1),
        points_m=torch.cat([memory.points_m for memory in memories]),
        num_still=torch.cat([memory.num_still for memory in memories]),
    )


def memory_of(memory: SceneMemory, index: int) -> SceneMemory:
    """Memory of one rollout of a batch."""
    # Copies: a slice would keep the whole batch alive and share it with other rollouts.
    one = torch.tensor([index])
    return SceneMemory(
        start=tuple(
            SceneStart(
                start.objects[one],
                start.sd_m[one],
                start.touch[one],
                start.pads_kpa[one],
                start.task[one],
                start.commanded[one],
            )
            for start in memory.start
        ),
        states=tuple(
            CoreState(**{name: getattr(state, name)[one] for name in _STATE})
            for state in memory.states
        ),
        poses=memory.poses[one],
        disagreement_m=memory.disagreement_m[one],
        tactile_kpa=memory.tactile_kpa[one],
        success=memory.success[:, one],
        points_m=memory.points_m[one],
        num_still=memory.num_still[one],
    )


def _stack_poses(poses: list[ObjectPoses]) -> ObjectPoses:
    return ObjectPoses(
        torch.cat([each.position_m for each in poses]),
        torch.cat([each.axes for each in poses]),
        torch.cat([each.present for each in poses]),
    )


def _stack_states(states: list[CoreState]) -> CoreState:
    parts = {name: torch.cat([getattr(state, name) for state in states]) for name in _STATE}
    return CoreState(**parts)


def memory_arrays(memory: SceneMemory) -> dict[str, np.ndarray]:
    """Arrays of a single rollout's memory, for a snapshot."""
    first = memory.start[0]
    tensors: dict[str, Tensor] = {
        "start_position_m": torch.cat([start.objects.position_m for start in memory.start]),
        "start_axes": torch.cat([start.objects.axes for start in memory.start]),
        "start_present": torch.cat([start.objects.present for start in memory.start]),
        "start_sd_m": torch.cat([start.sd_m for start in memory.start]),
        "touch": first.touch[0],
        "pads_kpa": first.pads_kpa[0],
        "task": first.task,
        "commanded": first.commanded,
        "success": memory.success[:, 0],
        "position_m": memory.poses.position_m[0],
        "axes": memory.poses.axes[0],
        "present": memory.poses.present[0],
        "disagreement_m": memory.disagreement_m,
        "tactile_kpa": memory.tactile_kpa[0],
        "points_m": memory.points_m[0],
        "num_still": memory.num_still,
    }
    for name in _STATE:
        tensors[f"state_{name}"] = torch.cat([getattr(state, name) for state in memory.states])
    return {name: tensor.contiguous().numpy() for name, tensor in tensors.items()}


def memory_from_arrays(
    arrays: Mapping[str, np.ndarray], config: DynamicsConfig, num_members: int
) -> SceneMemory:
    """Inverse of `memory_arrays`; validates untrusted arrays.

    Raises:
        InvalidInputError: missing arrays, wrong shapes or dtypes, or a task that the model does
            not have.
        NonFiniteError: NaN or infinity.
    """
    found = _checked(arrays, config, num_members)
    task = int(found["task"][0])
    if not 0 <= task < len(config.tasks):
        raise InvalidInputError(
            f"snapshot: got task number {task}, expected 0 … {len(config.tasks) - 1}"
        )
    starts = tuple(
        SceneStart(
            ObjectPoses(
                found["start_position_m"][m : m + 1],
                found["start_axes"][m : m + 1],
                found["start_present"][m : m + 1],
            ),
            found["start_sd_m"][m : m + 1],
            found["touch"][None],
            found["pads_kpa"][None],
            found["task"],
            found["commanded"],
        )
        for m in range(num_members)
    )
    return SceneMemory(
        start=starts,
        states=tuple(
            CoreState(
                **{name: _bounded(name, found[f"state_{name}"][m : m + 1]) for name in _STATE}
            )
            for m in range(num_members)
        ),
        poses=ObjectPoses(found["position_m"][None], found["axes"][None], found["present"][None]),
        disagreement_m=found["disagreement_m"],
        tactile_kpa=found["tactile_kpa"][None],
        success=found["success"][:, None].clamp(0.0, 1.0),
        points_m=found["points_m"][None],
        num_still=found["num_still"],
    )


def _bounded(name: str, values: Tensor) -> Tensor:
    """Part of a core's state, within what cores write."""
    return values.clamp(-1.0, 1.0) if name != "wrist_m" else values


def _checked(
    arrays: Mapping[str, np.ndarray], config: DynamicsConfig, num_members: int
) -> dict[str, Tensor]:
    objects = MAX_OBJECTS
    expected: dict[str, tuple[tuple[int, ...], str]] = {
        "start_position_m": ((num_members, objects, 3), "float32"),
        "start_axes": ((num_members, objects, 2, 3), "float32"),
        "start_present": ((num_members, objects), "float32"),
        "start_sd_m": ((num_members, objects), "float32"),
        "touch": ((2, config.touch_channels), "float32"),
        "pads_kpa": ((NUM_PADS,), "float32"),
        "task": ((1,), "int64"),
        "commanded": ((1,), "float32"),
        "state_hidden": ((num_members, config.width), "float32"),
        "state_position_m": ((num_members, objects, 3), "float32"),
        "state_axes": ((num_members, objects, 2, 3), "float32"),
        "state_wrist_m": ((num_members, 2, 3), "float32"),
        "state_wrist_axes": ((num_members, 2, 6), "float32"),
        "success": ((num_members,), "float32"),
        "position_m": ((objects, 3), "float32"),
        "axes": ((objects, 2, 3), "float32"),
        "present": ((objects,), "float32"),
        "disagreement_m": ((1,), "float32"),
        "tactile_kpa": ((2, NUM_TAXELS), "float32"),
        "points_m": ((2, NUM_POINTS, 3), "float32"),
        "num_still": ((1,), "int64"),
    }
    found: dict[str, Tensor] = {}
    for name, (shape, dtype) in expected.items():
        array = arrays.get(name)
        if array is None or array.shape != shape or array.dtype.name != dtype:
            got = "nothing" if array is None else f"{array.dtype.name} {array.shape}"
            raise InvalidInputError(
                f"snapshot: {name} is {got}, expected {dtype} {shape} of this world's own snapshot"
            )
        if array.dtype.kind == "f" and not np.isfinite(array).all():
            raise NonFiniteError(f"snapshot: {name} contains NaN or infinity")
        if array.dtype.kind == "f" and np.abs(array).max() > _LARGEST:
            raise InvalidInputError(
                f"snapshot: {name} has values up to {np.abs(array).max():.3g}, expected at most "
                f"{_LARGEST:.0e}"
            )
        found[name] = torch.from_numpy(np.array(array))
    return found
