"""Rotary positions in three dimensions, as in Wan2.2: latent time, row and column.

Tactile tokens lie on the time axis of the video, at a quarter of a latent per step, so that step 4j
has the time of latent j, which ends with it. They have no place in the image; their row and column
are 0.
"""

import torch
from jaxtyping import Float, Float32
from torch import Tensor

from services.world_model.network.axes import split_axis
from services.world_model.network.configuration import FRAMES_PER_LATENT

_THETA = 1e4


def video_positions(num_latents: int, side: int) -> Float32[Tensor, "tokens 3"]:
    """Latent, row and column of the tokens of square latent frames, row by row."""
    axes = (torch.arange(num_latents), torch.arange(side), torch.arange(side))
    return torch.cartesian_prod(*axes).float()


def tactile_positions(num_steps: int, tokens_per_step: int) -> Float32[Tensor, "tokens 3"]:
    """Positions of tactile tokens, step by step."""
    positions = torch.zeros(num_steps, tokens_per_step, 3)
    positions[..., 0] = torch.arange(num_steps)[:, None] / FRAMES_PER_LATENT
    return positions.flatten(0, 1)


def angles(positions: Float32[Tensor, "tokens 3"], head_width: int) -> Float32[Tensor, "tokens n"]:
    """Angle of each pair of a head's values; rows and columns take two sixths of the width each.

    Computed in float64, since angles grow with time.
    """
    spatial = 2 * (head_width // 6)
    parts = []
    for axis, width in enumerate((head_width - 2 * spatial, spatial, spatial)):
        exponents = torch.arange(0, width, 2, dtype=torch.float64) / width
        parts.append(positions[:, axis, None].double() * _THETA**-exponents)
    return torch.cat(parts, dim=1).float()


def rotate(
    heads: Float[Tensor, "batch heads tokens width"], turn: Float32[Tensor, "tokens n"]
) -> Float[Tensor, "batch heads tokens width"]:
    """Turn each pair of values by its angle, in float32."""
    first, second = split_axis(heads.float(), -1, (-1, 2)).unbind(-1)
    cos, sin = turn.cos(), turn.sin()
    turned = torch.stack([first * cos - second * sin, first * sin + second * cos], dim=-1)
    return turned.flatten(-2).to(heads.dtype)
