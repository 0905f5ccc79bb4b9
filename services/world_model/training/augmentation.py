"""First images as other cameras would take them: light, colour, sharpness, noise, compression."""

from dataclasses import replace

import numpy as np
import torch
from jaxtyping import Float32
from torch import Tensor
from torch.nn import functional

from dextouch.images import decode_jpeg, encode_jpeg
from services.world_model.dynamics.start_reader import FirstStep

# Standard deviations of the logarithm of gain, of each channel's gain, of contrast and of gamma.
_GAIN, _TINT, _CONTRAST, _GAMMA = 0.15, 0.08, 0.15, 0.15
_MOST_NOISE = 0.03
# Shifts of the image, of which the intrinsics know all but a remainder (standard deviation).
_MOST_SHIFT_PX, _UNKNOWN_SHIFT_PX = 1.5, 0.15
_JPEG_SHARE, _JPEG_QUALITY = 0.2, (25, 95)
_PLAIN_SHARE = 0.15


def as_another_camera(
    first: FirstStep, generator: torch.Generator
) -> tuple[Float32[Tensor, "batch 3 px px"], FirstStep]:
    """Images in 0 … 1 that other cameras might take, and steps with the intrinsics of these.

    A share of the images stays as it is.
    """
    count, px = len(first.image), first.image.shape[1]

    def normal(*shape: int) -> Tensor:
        return torch.randn((count, *shape), generator=generator)

    def uniform(*shape: int) -> Tensor:
        return torch.rand((count, *shape), generator=generator)

    plain = uniform() < _PLAIN_SHARE
    original = first.image.permute(0, 3, 1, 2).float() / 255
    shift_px = (2 * uniform(2) - 1) * _MOST_SHIFT_PX
    image = _shifted(original, shift_px)
    image = image * (_GAIN * normal(1, 1, 1) + _TINT * normal(3, 1, 1)).exp()
    mean = image.mean((1, 2, 3), keepdim=True)
    image = mean + (image - mean) * (_CONTRAST * normal(1, 1, 1)).exp()
    image = image.clamp(0.0, 1.0).pow((_GAMMA * normal(1, 1, 1)).exp())
    image = torch.lerp(image, _blurred(image), (2 * uniform(1, 1, 1) - 1).clamp_min(0.0))
    image = image + normal(3, px, px) * _MOST_NOISE * uniform(1, 1, 1).square()
    image = _compressed(image.clamp(0.0, 1.0), uniform(2).numpy())
    K = first.K_head.clone()
    K[:, :2, 2] += torch.where(plain[:, None], 0.0, shift_px + _UNKNOWN_SHIFT_PX * normal(2))
    return torch.where(plain[:, None, None, None], original, image), replace(first, K_head=K)


def _shifted(
    image: Float32[Tensor, "batch 3 px px"], shift_px: Float32[Tensor, "batch 2"]
) -> Float32[Tensor, "batch 3 px px"]:
    """Content moved right and down, with repeated borders."""
    count, px = len(image), image.shape[-1]
    affine = torch.eye(2, 3).repeat(count, 1, 1)
    affine[:, :, 2] = -2 * shift_px / px
    grid = functional.affine_grid(affine, list(image.shape), align_corners=False)
    return functional.grid_sample(image, grid, padding_mode="border", align_corners=False)


def _blurred(image: Float32[Tensor, "batch 3 px px"]) -> Float32[Tensor, "batch 3 px px"]:
    """A binomial kernel of three pixels."""
    weights = torch.tensor([0.25, 0.5, 0.25])
    kernel = (weights[:, None] * weights).expand(3, 1, 3, 3)
    return functional.conv2d(
        functional.pad(image, (1, 1, 1, 1), mode="replicate"), kernel, groups=3
    )


def _compressed(image: Float32[Tensor, "batch 3 px px"], draw: np.ndarray) -> Tensor:
    """A share of the images after compression as JPEG."""
    low, high = _JPEG_QUALITY
    for index in np.flatnonzero(draw[:, 0] < _JPEG_SHARE):
        pixels = (image[index].permute(1, 2, 0) * 255).round().byte().numpy()
        quality = int(low + (high - low) * draw[index, 1])
        decoded = decode_jpeg(encode_jpeg(pixels, quality=quality)).copy()
        image[index] = torch.from_numpy(decoded).permute(2, 0, 1).float() / 255
    return image
