"""Codecs between images and video latents: a linear one that is fitted, and Wan2.2's."""

import math
from typing import TYPE_CHECKING, Any

import torch
from jaxtyping import Float, Float32, UInt8
from torch import Tensor, nn

from services.world_model.dynamics.features import principal_axes, root_scale
from services.world_model.network.attention import split_axis
from services.world_model.network.configuration import (
    FRAMES_PER_LATENT,
    LATENT_MEAN,
    LATENT_STD,
    SPATIAL_FACTOR,
    NetworkConfig,
    WanConfig,
)

if TYPE_CHECKING:
    from diffusers import AutoencoderKLWan

Latents = Float32[Tensor, "batch latents tokens channels"]
Images = Float32[Tensor, "batch time px px 3"]
_Shown = Float32[Tensor, "batch shown px px 3"]
_Patches = Float32[Tensor, "batch latents rows cols values"]
_Frames = Float[Tensor, "batch _channels _frames _rows _columns"]


class VisualCodec(nn.Module):
    """Linear tokenizer of 1 + 4k images by principal axes of 8×8×4 patches, in closed form.

    The first image, four times, is a group of its own. A token covers two by two patches of one
    latent frame.
    """

    mean: Tensor
    basis: Tensor
    scale: Tensor

    def __init__(self, config: NetworkConfig) -> None:
        super().__init__()
        self.patch_px = config.patch_px
        self.channels = config.codec_channels
        values = FRAMES_PER_LATENT * config.patch_px**2 * 3
        self.register_buffer("mean", torch.zeros(values))
        self.register_buffer("basis", torch.eye(values, config.codec_channels))
        self.register_buffer("scale", torch.ones(config.codec_channels))

    def fit(self, windows: UInt8[Tensor, "n time px px 3"]) -> None:
        """Fit mean and principal axes to windows of images."""
        size = len(self.mean)
        total = torch.zeros(size, dtype=torch.float64)
        moment = torch.zeros(size, size, dtype=torch.float64)
        count = 0
        # Part by part, which bounds the memory.
        for part in torch.split(windows, 16):
            patches = self._patches(to_unit(part)).reshape(-1, size)
            total += patches.sum(dim=0, dtype=torch.float64)
            moment += (patches.T @ patches).double()
            count += len(patches)
        mean = total / count
        basis, rms = principal_axes(moment / count - torch.outer(mean, mean), self.channels)
        self.mean.copy_(mean.float())
        self.basis.copy_(basis)
        self.scale.copy_(root_scale(rms))

    def encode(self, images: Images) -> Latents:
        """Latents of images in 0 … 1; time is 1 + 4k."""
        coded = ((self._patches(images) - self.mean) @ self.basis) / self.scale
        return _tokens_of(coded)

    def decode(self, latents: Latents) -> Images:
        """Images in 0 … 1; the first latent gives one image, the others four each."""
        coded = _patches_of(latents)
        patches = (coded * self.scale) @ self.basis.T + self.mean
        groups = split_axis(patches, 4, (FRAMES_PER_LATENT, self.patch_px, self.patch_px, 3))
        # [B, L, rows, cols, 4, p, p, 3] -> [B, L, 4, rows, p, cols, p, 3]
        images = groups.permute(0, 1, 4, 2, 5, 3, 6, 7).flatten(5, 6).flatten(3, 4)
        first = images[:, 0].mean(dim=1, keepdim=True)
        return torch.cat([first, images[:, 1:].flatten(1, 2)], dim=1).clamp(0.0, 1.0)

    def decode_future(self, latents: Latents, *, all_images: bool) -> _Shown:
        """Images after the first, or of the last latent, decoded apart to be bit-identical."""
        images = self.decode(latents[:, [0, -1]])[:, 1:]
        if all_images and latents.shape[1] > 2:
            images = torch.cat([self.decode(latents[:, :-1])[:, 1:], images], dim=1)
        return images

    def _patches(self, images: Images) -> _Patches:
        groups = by_latent(images)
        grid = split_axis(split_axis(groups, 4, (-1, self.patch_px)), 3, (-1, self.patch_px))
        # [B, L, 4, rows, p, cols, p, 3] -> [B, L, rows, cols, 4, p, p, 3]
        return grid.permute(0, 1, 3, 5, 2, 4, 6, 7).flatten(4)


def by_latent(steps: Float32[Tensor, "batch time ..."]) -> Float32[Tensor, "batch latents 4 ..."]:
    """Four steps for each latent frame: the first step four times, then groups of four."""
    first = steps[:, :1].expand(-1, FRAMES_PER_LATENT, *steps.shape[2:])
    return split_axis(torch.cat([first, steps[:, 1:]], dim=1), 1, (-1, FRAMES_PER_LATENT))


def _tokens_of(patches: _Patches) -> Latents:
    """Two by two patches as one token, row by row."""
    across = (patches.shape[2] // 2, 2)
    grid = split_axis(split_axis(patches, 3, across), 2, across).transpose(3, 4)
    return grid.flatten(4).flatten(2, 3)


def _patches_of(tokens: Latents) -> _Patches:
    """Inverse of `_tokens_of`."""
    across = math.isqrt(tokens.shape[2])
    grid = split_axis(split_axis(tokens, 2, (across, across)), 4, (2, 2, -1))
    return grid.transpose(3, 4).flatten(2, 3).flatten(3, 4)


def to_unit(images: UInt8[Tensor, "..."]) -> Float32[Tensor, "..."]:
    """Scale uint8 images to 0 … 1."""
    return images.float() / 255.0


def to_uint8(images: Float32[Tensor, "..."]) -> UInt8[Tensor, "..."]:
    """Convert images in 0 … 1 to uint8."""
    return (images * 255.0).round().clamp(0, 255).to(torch.uint8)


class WanVideoCodec(nn.Module):
    """The video autoencoder of Wan2.2, frozen; tokens are two by two normalized latents each.

    1 + 4k images are 1 + k latent frames of 48 channels at a sixteenth of the resolution. `window`
    is the number of latents that an image is decoded from, and `tile_px` the side of the tiles that
    images are decoded in; None for all latents and whole images.
    """

    def __init__(self, wan: WanConfig) -> None:
        super().__init__()
        self.window: int | None = None
        self.tile_px: int | None = None
        self.autoencoder: Any = empty_autoencoder(wan).requires_grad_(requires_grad=False)

    def fit(self, windows: UInt8[Tensor, "n time px px 3"]) -> None:
        """Do nothing: the autoencoder is pretrained."""

    @torch.no_grad()
    def encode(self, images: Images) -> Latents:
        """Latents of images in 0 … 1; time is 1 + 4k."""
        pixels = images.permute(0, 4, 1, 2, 3) * 2.0 - 1.0
        # One by one: rounding then depends on no other window, so that latents can be kept.
        # The mean of the encoder's distribution, not a sample of it.
        parts = [self.autoencoder.encode(one).latent_dist.mode() for one in torch.split(pixels, 1)]
        latents = torch.cat(parts)
        mean, std = _statistics(latents)
        return _tokens_of(((latents - mean) / std).permute(0, 2, 3, 4, 1))

    @torch.no_grad()
    def decode(self, tokens: Latents) -> Images:
        """Images in 0 … 1; the first latent gives one image, the others four each."""
        return _shown(self.autoencoder.decode(self._latents(tokens)).sample)

    @torch.no_grad()
    def decode_future(self, tokens: Latents, *, all_images: bool) -> _Shown:
        """Images after the first, or the last one alone.

        The last one equals that of all images to rounding. With `window`, every latent is decoded
        from itself and the `window - 1` latents before it, as the start of a video.
        """
        latents = self._latents(tokens)
        num_latents = latents.shape[2]
        window = self.window or num_latents
        if not all_images:
            pixels = self._decoded(latents[:, :, -window:], 1)
        elif window >= num_latents:
            pixels = self._decoded(latents, FRAMES_PER_LATENT * (num_latents - 1))
        else:
            ends = range(2, num_latents + 1)
            parts = [latents[:, :, max(0, end - window) : end] for end in ends]
            pixels = torch.cat([self._decoded(part, FRAMES_PER_LATENT) for part in parts], dim=2)
        return _shown(pixels)

    def _latents(self, tokens: Latents) -> _Frames:
        latents = _patches_of(tokens).permute(0, 4, 1, 2, 3)
        mean, std = _statistics(latents)
        return latents * std + mean

    def _decoded(self, latents: _Frames, num_images: int) -> _Frames:
        """The last images in -1 … 1, whole or in diffusers' tiles, blended where they overlap."""
        if self.tile_px is None or self.tile_px >= SPATIAL_FACTOR * latents.shape[-1]:
            return last_images(self.autoencoder, latents, num_images)
        side, stride = self.tile_px, self.tile_px - SPATIAL_FACTOR * (self.tile_px // 64)
        self.autoencoder.enable_tiling(side, side, stride, stride)
        # Of decoding alone.
        self.autoencoder.use_tiling = False
        pixels: Tensor = self.autoencoder.tiled_decode(latents).sample
        return pixels[:, :, -num_images:]


def _shown(pixels: _Frames) -> Images:
    return (pixels.permute(0, 2, 3, 4, 1) + 1.0) / 2.0


def last_images(
    autoencoder: Any,  # noqa: ANN401 - of diffusers
    latents: _Frames,
    num_images: int,
) -> Float[Tensor, "batch 3 shown height width"]:
    """The last images of a video in -1 … 1, by diffusers' decoder, to rounding.

    In the last block and the head, at the full resolution, only those frames are computed that the
    images depend on: three convolutions of three frames a block reach back two frames each. At full
    size this saves 16.5 % of the decoder's work.
    """
    from diffusers.models.autoencoders.autoencoder_kl_wan import unpatchify

    decoder = autoencoder.decoder
    latents = autoencoder.post_quant_conv(latents)
    # One place for each convolution that has a cache, as diffusers' own loop has.
    past: list[Any] = [None] * len(list(decoder.modules()))
    ending, images = _LastFrames(decoder), []
    # Frames of the video that follow the ones at hand.
    num_after = FRAMES_PER_LATENT * (latents.shape[2] - 1)
    for index, latent in enumerate(torch.split(latents, 1, dim=2)):
        place = [0]
        frames = decoder.mid_block(
            ending.convolved(decoder.conv_in, latent, 1), feat_cache=past, feat_idx=place
        )
        for block in decoder.up_blocks[:-1]:
            frames = block(frames, feat_cache=past, feat_idx=place, first_chunk=index == 0)
        images += ending.images(frames, num_images - num_after)
        num_after -= FRAMES_PER_LATENT
    pixels: Tensor = unpatchify(  # type: ignore[no-untyped-call]
        torch.cat(images, dim=2), patch_size=2
    )
    return pixels.clamp(-1.0, 1.0)


class _LastFrames:
    """Last block and head of the decoder in a stream of frames, for the last images alone."""

    def __init__(self, decoder: Any) -> None:  # noqa: ANN401 - modules of diffusers
        self._decoder = decoder
        self._past: dict[nn.Module, Tensor] = {}

    def convolved(self, convolution: Any, frames: _Frames, num: int) -> _Frames | None:  # noqa: ANN401
        """A causal convolution at the last `num` of the given frames, if it is positive."""
        num = min(num, frames.shape[2])
        if convolution in self._past:
            frames = torch.cat([self._past[convolution], frames], dim=2)
        self._past[convolution] = frames[:, :, -2:].clone()
        if num <= 0:
            return None
        before = frames[:, :, :-num][:, :, -2:]
        result: Tensor = convolution(frames[:, :, -num:], before)
        return result

    def images(self, frames: _Frames, num_images: int) -> list[_Frames]:
        """The last `num_images` of these frames; negative where others follow first."""
        resnets, act = self._decoder.up_blocks[-1].resnets, self._decoder.nonlinearity
        # Two convolutions a block, and the last one, each reach two frames further back.
        reach = num_images + 4 * len(resnets)
        for block in resnets:
            inside = self.convolved(block.conv1, act(block.norm1(frames)), reach)
            if inside is not None:
                inside = self.convolved(block.conv2, act(block.norm2(inside)), reach - 2)
            if inside is None:
                return []
            frames = inside + block.conv_shortcut(frames[:, :, -inside.shape[2] :])
            reach -= 4
        head = act(self._decoder.norm_out(frames))
        shown = self.convolved(self._decoder.conv_out, head, reach)
        return [] if shown is None else [shown]


def _statistics(
    like: Float[Tensor, "batch channels latents rows columns"],
) -> tuple[Float[Tensor, "channels 1 1 1"], Float[Tensor, "channels 1 1 1"]]:
    mean, std = like.new_tensor((LATENT_MEAN, LATENT_STD)).view(2, -1, 1, 1, 1)
    return mean, std


def empty_autoencoder(config: WanConfig) -> "AutoencoderKLWan":
    """Video autoencoder on the meta device; always float32, as it is published."""
    from diffusers import AutoencoderKLWan

    with torch.device("meta"):
        autoencoder = AutoencoderKLWan(**config.autoencoder_sizes())
    return autoencoder.eval()
