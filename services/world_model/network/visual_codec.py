"""Visual codec: latent tokens of 1 + 4k images by principal axes of 8×8×4 patches.

The first image forms a group of its own (repeated four times), followed by groups of four, as in
causal video autoencoders. Closed form: fitted once on training images, then frozen in the
checkpoint.
"""

import torch
from jaxtyping import Float32, UInt8
from torch import Tensor, nn

from services.networks.principal_axes import principal_axes, root_scale
from services.world_model.network.axes import split_axis
from services.world_model.network.configuration import FRAMES_PER_LATENT, NetworkConfig


class VisualCodec(nn.Module):
    """Linear tokenizer; a token covers two by two patches of one latent frame."""

    mean: Tensor
    basis: Tensor
    scale: Tensor

    def __init__(self, config: NetworkConfig) -> None:
        super().__init__()
        self.patch_px = config.patch_px
        self.tokens_across = config.tokens_across
        self.channels = config.codec_channels
        values = FRAMES_PER_LATENT * config.patch_px**2 * 3
        self.register_buffer("mean", torch.zeros(values))
        self.register_buffer("basis", torch.eye(values, config.codec_channels))
        self.register_buffer("scale", torch.ones(config.codec_channels))

    def fit(self, windows: UInt8[Tensor, "n time px px 3"], *, batch: int = 16) -> None:
        """Fit mean and principal axes to windows of images."""
        size = len(self.mean)
        total = torch.zeros(size, dtype=torch.float64)
        moment = torch.zeros(size, size, dtype=torch.float64)
        count = 0
        for part in torch.split(windows, batch):
            patches = self._patches(to_unit(part)).reshape(-1, size)
            total += patches.sum(dim=0, dtype=torch.float64)
            moment += (patches.T @ patches).double()
            count += len(patches)
        mean = total / count
        basis, rms = principal_axes(moment / count - torch.outer(mean, mean), self.channels)
        self.mean.copy_(mean.float())
        self.basis.copy_(basis)
        self.scale.copy_(root_scale(rms))

    def encode(
        self, images: Float32[Tensor, "batch time px px 3"]
    ) -> Float32[Tensor, "batch latents tokens channels"]:
        """Latents of images in 0 … 1; time is 1 + 4k."""
        coded = ((self._patches(images) - self.mean) @ self.basis) / self.scale
        # [B, L, rows, cols, 2, 2, C]: two by two patches become one token.
        across = self.tokens_across
        grid = split_axis(split_axis(coded, 3, (across, 2)), 2, (across, 2)).transpose(3, 4)
        return grid.flatten(4).flatten(2, 3)

    def decode(
        self, latents: Float32[Tensor, "batch latents tokens channels"]
    ) -> Float32[Tensor, "batch time px px 3"]:
        """Images in 0 … 1; the first latent gives one image, the others four each."""
        across = self.tokens_across
        grid = split_axis(split_axis(latents, 2, (across, across)), 4, (2, 2, self.channels))
        coded = grid.transpose(3, 4).flatten(2, 3).flatten(3, 4)
        patches = (coded * self.scale) @ self.basis.T + self.mean
        groups = split_axis(patches, 4, (FRAMES_PER_LATENT, self.patch_px, self.patch_px, 3))
        # [B, L, rows, cols, 4, p, p, 3] -> [B, L, 4, rows, p, cols, p, 3]
        images = groups.permute(0, 1, 4, 2, 5, 3, 6, 7).flatten(5, 6).flatten(3, 4)
        first = images[:, 0].mean(dim=1, keepdim=True)
        return torch.cat([first, images[:, 1:].flatten(1, 2)], dim=1).clamp(0.0, 1.0)

    def decode_future(
        self, latents: Float32[Tensor, "batch latents tokens channels"], *, all_images: bool
    ) -> Float32[Tensor, "batch shown px px 3"]:
        """Images after the first, or those of the last latent only.

        The last latent is decoded separately, so that its images are bit-identical whether or not
        the others are decoded.
        """
        images = self.decode(latents[:, [0, -1]])[:, 1:]
        if all_images and latents.shape[1] > 2:
            images = torch.cat([self.decode(latents[:, :-1])[:, 1:], images], dim=1)
        return images

    def _patches(
        self, images: Float32[Tensor, "batch time px px 3"]
    ) -> Float32[Tensor, "batch latents rows cols values"]:
        first = images[:, :1].expand(-1, FRAMES_PER_LATENT, -1, -1, -1)
        padded = torch.cat([first, images[:, 1:]], dim=1)
        groups = split_axis(padded, 1, (-1, FRAMES_PER_LATENT))
        grid = split_axis(split_axis(groups, 4, (-1, self.patch_px)), 3, (-1, self.patch_px))
        # [B, L, 4, rows, p, cols, p, 3] -> [B, L, rows, cols, 4, p, p, 3]
        return grid.permute(0, 1, 3, 5, 2, 4, 6, 7).flatten(4)


def to_unit(images: UInt8[Tensor, "..."]) -> Float32[Tensor, "..."]:
    """Scale uint8 images to 0 … 1."""
    return images.float() / 255.0


def to_uint8(images: Float32[Tensor, "..."]) -> UInt8[Tensor, "..."]:
    """Convert images in 0 … 1 to uint8."""
    return (images * 255.0).round().clamp(0, 255).to(torch.uint8)
