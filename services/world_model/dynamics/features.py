"""Contact geometry: hand points relative to the surface of every object at its present pose.

Success is decided within millimetres, which a wrist pose relative to its own start does not
resolve. Distances are compressed by asinh(d / 1 cm), so that a millimetre near an object and a
decimetre far from it both change a feature by about a tenth. The scale is the same for all tasks.
"""

import torch
from jaxtyping import Float32
from torch import Tensor

from services.world_model.dynamics.hand_motion import NUM_POINTS

NEAR_M = 0.01
# Features are computed at these of the four steps of a latent: hands may shake within one.
LOOKS = (1, 2, 3, 4)
# The wrist is left out: it touches nothing.
_FIRST_POINT = 1
_PER_POINT = 7
SLOT_SIZE = len(LOOKS) * (NUM_POINTS - _FIRST_POINT) * _PER_POINT


def compressed(distance_m: Float32[Tensor, "..."]) -> Float32[Tensor, "..."]:
    """asinh(d / 1 cm) / 2: linear near zero, logarithmic far away."""
    return torch.asinh(distance_m / NEAR_M) / 2


def slot_features(
    points_m: Float32[Tensor, "batch looks 2 points 3"],
    position_m: Float32[Tensor, "batch objects 3"],
    R: Float32[Tensor, "batch objects 3 3"],
    boxes_m: Float32[Tensor, "batch objects 6"],
) -> Float32[Tensor, "batch 2 objects features"]:
    """Features of each hand and object at one latent step.

    For each point: its distance to the object's box, negative inside; its offset from the box's
    middle, in the object's frame; its offset from the object, in the world's.

    Args:
        points_m: points of both hands in the world at the `LOOKS`.
        position_m: of the objects' frames in the world.
        R: rotations of the objects' frames to the world.
        boxes_m: middle and half sizes of each object's box in its frame.
    """
    points_m = points_m[..., _FIRST_POINT:, None, :]
    offset = points_m - position_m[:, None, None, None]
    boxes = boxes_m[:, None, None, None]
    middle, half = boxes[..., :3], boxes[..., 3:]
    from_middle = torch.einsum("blhpsi,bsij->blhpsj", offset, R) - middle
    beyond = from_middle.abs() - half
    distance = beyond.clamp_min(0.0).norm(dim=-1, keepdim=True)
    distance = distance + beyond.amax(-1, keepdim=True).clamp_max(0.0)
    each = compressed(torch.cat([distance, from_middle, offset], dim=-1))
    return each.permute(0, 2, 4, 1, 3, 5).flatten(3)
