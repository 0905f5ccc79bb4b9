"""Contact geometry as a condition of the joint model: hand points relative to the objects' boxes.

The same features that the state model's core receives (`services.world_model.dynamics.features`),
for the objects as they lie at the first step of a window: millimetres decide contact, which pixels
of a centimetre and actions relative to each hand's own start do not show.
"""

from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Float32, Float64

from dextouch.errors import InvalidInputError
from dextouch.geometry import transform_from_pose
from dextouch.hands.actions import AnchorPoses
from dextouch.schemas import MAX_OBJECTS
from services.world_model.dynamics.features import LOOKS, SLOT_SIZE, slot_features
from services.world_model.dynamics.hand_motion import hand_motion

_PER_SLOT = SLOT_SIZE // len(LOOKS) + 6 + 1
# Of a hand: every slot's features, its box and whether it holds an object; and the side.
GEOMETRY_SIZE = MAX_OBJECTS * _PER_SLOT + 1
_PER_M = 10.0


@dataclass(frozen=True)
class ObjectsAtStart:
    """Objects at the first step of a window.

    `poses` are x y z (m), qw qx qy qz in the world; `boxes_m` the middle and the half sizes of each
    object's box in its frame.
    """

    poses: Float64[np.ndarray, "objects 7"]
    boxes_m: Float64[np.ndarray, "objects 6"]

    def __post_init__(self) -> None:
        count = len(self.poses)
        if count > MAX_OBJECTS or len(self.boxes_m) != count:
            raise InvalidInputError(
                f"objects: got {count} poses and {len(self.boxes_m)} boxes, expected one each of "
                f"at most {MAX_OBJECTS} objects"
            )


def contact_geometry(
    actions: Float64[np.ndarray, "time 67"], anchor: AnchorPoses, objects: ObjectsAtStart | None
) -> Float32[np.ndarray, "time 2 size"]:
    """Features [time, hand, `GEOMETRY_SIZE`] of every step; zero in slots without an object."""
    points_m = torch.from_numpy(hand_motion(actions, anchor).points_m)[:, None]
    steps = len(points_m)
    slots = torch.zeros(steps, 2, MAX_OBJECTS, _PER_SLOT)
    if objects is not None and len(objects.poses):
        T = torch.from_numpy(transform_from_pose(objects.poses)).float()
        boxes = torch.from_numpy(objects.boxes_m).float()
        count = len(boxes)
        each = slot_features(
            points_m,
            T[None, :, :3, 3].expand(steps, -1, -1),
            T[None, :, :3, :3].expand(steps, -1, -1, -1),
            boxes[None].expand(steps, -1, -1),
        )
        known = torch.cat([boxes * _PER_M, torch.ones(count, 1)], dim=-1)
        slots[:, :, :count] = torch.cat([each, known.expand(steps, 2, -1, -1)], dim=-1)
    side = torch.tensor([-1.0, 1.0])[None, :, None].expand(steps, -1, -1)
    return torch.cat([slots.flatten(2), side], dim=-1).numpy()
