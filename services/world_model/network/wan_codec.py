"""Visual codec of the full-size model: the video autoencoder of Wan2.2, frozen.

It maps 1 + 4k images to 1 + k latent frames of 48 channels at a sixteenth of the resolution. It is
causal: a latent frame depends on earlier images only, and an image on earlier latents only.
"""

import torch
from jaxtyping import Float, Float32, UInt8
from torch import Tensor, nn

from services.world_model.network.axes import split_axis
from services.world_model.network.configuration import FRAMES_PER_LATENT, NetworkConfig
from services.world_model.wan.configuration import (
    LATENT_CHANNELS,
    LATENT_MEAN,
    LATENT_STD,
    WanConfig,
)
from services.world_model.wan.networks import empty_autoencoder


class WanVideoCodec(nn.Module):
    """Latent tokens, two by two latents each, with mean 0 and deviation 1 by channel."""

    def __init__(self, config: NetworkConfig, wan: WanConfig) -> None:
        super().__init__()
        self._tokens_across = config.tokens_across
        self.autoencoder = empty_autoencoder(wan).requires_grad_(requires_grad=False)

    def fit(self, windows: UInt8[Tensor, "n time px px 3"]) -> None:
        """Do nothing: the autoencoder is pretrained."""

    @torch.no_grad()
    def encode(
        self, images: Float32[Tensor, "batch time px px 3"]
    ) -> Float32[Tensor, "batch latents tokens channels"]:
        """Latents of images in 0 … 1; time is 1 + 4k."""
        pixels = images.permute(0, 4, 1, 2, 3) * 2.0 - 1.0
        # The mean of the encoder's distribution, not a sample of it.
        latents = self.autoencoder.encode(pixels).latent_dist.mode()
        mean, std = _statistics(latents)
        grid = ((latents - mean) / std).permute(0, 2, 3, 4, 1)
        across = self._tokens_across
        tokens = split_axis(split_axis(grid, 3, (across, 2)), 2, (across, 2)).transpose(3, 4)
        return tokens.flatten(4).flatten(2, 3)

    @torch.no_grad()
    def decode(
        self, tokens: Float32[Tensor, "batch latents tokens channels"]
    ) -> Float32[Tensor, "batch time px px 3"]:
        """Images in 0 … 1; the first latent gives one image, the others four each."""
        across = self._tokens_across
        grid = split_axis(split_axis(tokens, 2, (across, across)), 4, (2, 2, LATENT_CHANNELS))
        latents = grid.transpose(3, 4).flatten(2, 3).flatten(3, 4).permute(0, 4, 1, 2, 3)
        mean, std = _statistics(latents)
        pixels = self.autoencoder.decode(latents * std + mean).sample
        return (pixels.permute(0, 2, 3, 4, 1) + 1.0) / 2.0

    def decode_future(
        self, tokens: Float32[Tensor, "batch latents tokens channels"], *, all_images: bool
    ) -> Float32[Tensor, "batch shown px px 3"]:
        """Images after the first, or the last four; all are decoded, since they depend in order."""
        images = self.decode(tokens)
        return images[:, 1:] if all_images else images[:, -FRAMES_PER_LATENT:]


def _statistics(
    like: Float[Tensor, "batch channels latents rows columns"],
) -> tuple[Float[Tensor, "channels 1 1 1"], Float[Tensor, "channels 1 1 1"]]:
    values = (like.new_tensor(constant).view(-1, 1, 1, 1) for constant in (LATENT_MEAN, LATENT_STD))
    mean, std = values
    return mean, std
