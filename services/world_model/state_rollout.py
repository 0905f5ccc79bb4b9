"""Rollout state of a state model, and its snapshot."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float64, UInt8

from dextouch.errors import InvalidInputError
from dextouch.hands.actions import AnchorPoses, check_actions
from dextouch.schemas import ActionKind
from dextouch.streams import pack, unpack
from services.world_model.dynamics.memory import memory_arrays, memory_from_arrays
from services.world_model.dynamics.model import SceneMemory
from services.world_model.network.inputs import ACTION_KINDS, check_reach
from services.world_model.starts import check_geometry
from services.world_model.state_checkpoints import StateMetadata

MAX_SNAPSHOT_BYTES = 2**20


@dataclass(frozen=True)
class StateRollout:
    """State of a rollout: its start and the memory of its scene.

    `first_reached` and `reached` are relative to `anchor`, the poses of step 0; `num_moving` counts
    the latent steps in which hands moved.
    """

    task: str
    action_kind: ActionKind
    image: UInt8[np.ndarray, "h w 3"]
    anchor: AnchorPoses
    K_head: Float64[np.ndarray, "3 3"]
    first_reached: Float64[np.ndarray, "67"]
    memory: SceneMemory
    step: int = 0
    num_moving: int = 0


def rollout_bytes(state: StateRollout, digest: str) -> bytes:
    """Serialize the state together with the digest of its world."""
    fields = {
        "digest": digest,
        "task": state.task,
        "action_kind": state.action_kind,
        "step": state.step,
        "num_moving": state.num_moving,
    }
    arrays = {
        "image": state.image,
        "anchor": np.stack(state.anchor.as_tuple()),
        "K_head": state.K_head,
        "first_reached": state.first_reached,
    }
    return pack(fields, {**arrays, **memory_arrays(state.memory)})


def rollout_from_bytes(data: bytes, metadata: StateMetadata, digest: str) -> StateRollout:
    """Restore the state of a snapshot; validates untrusted bytes.

    Raises:
        InvalidInputError: not a snapshot of this world.
        NonFiniteError: NaN or infinity.
    """
    fields, arrays = unpack(data, max_bytes=MAX_SNAPSHOT_BYTES)
    if fields.get("digest") != digest:
        raise InvalidInputError(
            f"snapshot: made by world {str(fields.get('digest'))[:12]!r}, expected "
            f"{digest[:12]!r}; restore it in the world that made it"
        )
    config, name = metadata.dynamics, fields.get("task")
    step, moving = fields.get("step"), fields.get("num_moving")
    size = (config.image_px, config.image_px, 3)
    shapes = {"image": size, "anchor": (3, 4, 4), "K_head": (3, 3), "first_reached": (67,)}
    if (
        name not in config.tasks
        or fields.get("action_kind") not in ACTION_KINDS
        or not isinstance(step, int)
        or not isinstance(moving, int)
        or min(step, moving) < 0
        or arrays.get("image", np.zeros(0)).dtype != np.uint8
        or any(key not in arrays or arrays[key].shape != shapes[key] for key in shapes)
    ):
        raise InvalidInputError(
            f"snapshot: got {sorted(fields)} and arrays {sorted(arrays)}, expected those that "
            "this world's own snapshot writes"
        )
    anchor, K_head = AnchorPoses(*np.array(arrays["anchor"])), np.array(arrays["K_head"])
    check_geometry(anchor, K_head)
    memory = memory_from_arrays(arrays, config, metadata.num_members)
    if int(memory.start.task[0, 0]) != config.tasks.index(name):
        raise InvalidInputError(f"snapshot: its memory belongs to another task than {name!r}")
    first_reached = check_actions(arrays["first_reached"][None], where="snapshot")
    check_reach(first_reached)
    return StateRollout(
        task=name,
        action_kind=fields["action_kind"],
        image=arrays["image"],
        anchor=anchor,
        K_head=K_head,
        first_reached=first_reached[0],
        memory=memory,
        step=step,
        num_moving=moving,
    )
