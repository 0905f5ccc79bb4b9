"""Command features of the core: palms and fingertips relative to the objects at the start.

Success is decided within millimetres, which a wrist pose relative to its own start does not
resolve. Distances are compressed by asinh(d / 1 cm), so that a millimetre near an object and a
decimetre far from it both change a feature by about a tenth.
"""

import torch
from jaxtyping import Float32
from torch import Tensor

from services.world_model.dynamics.configuration import MAX_OBJECTS
from services.world_model.dynamics.hand_motion import NUM_POINTS
from services.world_model.dynamics.objects import ObjectPoses

NEAR_M = 0.01
# Features are computed at these two of the four steps of a latent: the middle and the end.
LOOKS = (2, 4)
_HAND_SIZE = NUM_POINTS * MAX_OBJECTS * 6
NUM_FEATURES = len(LOOKS) * (2 * _HAND_SIZE + 2 * NUM_POINTS) + 2 * 6 + 2 * 20


def compressed(distance_m: Float32[Tensor, "..."]) -> Float32[Tensor, "..."]:
    """asinh(d / 1 cm) / 2: linear near zero, logarithmic far away."""
    return torch.asinh(distance_m / NEAR_M) / 2


def command_features(
    points_m: Float32[Tensor, "batch latents looks 2 6 3"],
    axes: Float32[Tensor, "batch latents 2 6"],
    joints_rad: Float32[Tensor, "batch latents 2 20"],
    objects: ObjectPoses,
) -> Float32[Tensor, "batch latents features"]:
    """Features of every latent step.

    For each point of a hand and each object: the offset in world axes, and its components along
    the object's z axis, its x axis and across both. Empty slots give zeros. Then the points'
    heights, the wrists' axes and the joint angles.

    Args:
        points_m: wrists and fingertips in the world at the `LOOKS` of each latent.
        axes: wrist axes at each latent's end.
        joints_rad: joint angles at each latent's end.
        objects: poses at the start [batch, objects]; constant over the sequence.
    """
    position = objects.position_m[:, None, None, None, None]
    offset = points_m[..., None, :] - position
    z, x = objects.axes[:, :, 0], objects.axes[:, :, 1]
    across = torch.linalg.cross(z, x)
    frame = torch.stack([z, x, across], dim=-2)
    own = torch.einsum("blshpoi,boai->blshpoa", offset, frame)
    relative = compressed(torch.cat([offset, own], dim=-1))
    relative = relative * objects.present[:, None, None, None, None, :, None]
    heights = compressed(points_m[..., 2])
    return torch.cat(
        [relative.flatten(2), heights.flatten(2), axes.flatten(2), joints_rad.flatten(2) * 2.0],
        dim=-1,
    )
