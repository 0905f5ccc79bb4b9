"""The video side of the joint model: codec and expert, small ones or Wan2.2's."""

import math
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any

import torch
from jaxtyping import Bool, Float, Float32, UInt8
from torch import Tensor, nn
from torch.nn import functional

from services.world_model.dynamics.features import principal_axes, root_scale
from services.world_model.network.attention import (
    NUM_MODULATIONS,
    Block,
    Heads,
    KeysValues,
    Stream,
    Text,
    angles,
    modulated_norm,
    rotate,
    split_axis,
    video_positions,
    zero_linear,
)
from services.world_model.network.conditioning import (
    ACTION_WIDTH,
    TIME_RANGE,
    ActionFeatures,
    Condition,
    PastCondition,
    after_first,
    two_layers,
    without_dropped,
)
from services.world_model.network.configuration import (
    FLOAT32_PARTS,
    FRAMES_PER_LATENT,
    LATENT_MEAN,
    LATENT_STD,
    RASTER_CELLS_PER_TOKEN,
    SPATIAL_FACTOR,
    NetworkConfig,
    WanConfig,
)
from services.world_model.network.inputs import ModelInputs
from services.world_model.network.instruction import TextFeatures
from services.world_model.network.kept import LastUsed

if TYPE_CHECKING:
    from diffusers import AutoencoderKLWan, WanTransformer3DModel

Latents = Float32[Tensor, "batch latents tokens channels"]
Images = Float32[Tensor, "batch time px px 3"]
_Raster = Float32[Tensor, "batch time 2 cells cells"]
_PastRaster = Float32[Tensor, "batch past 2 cells cells"]
_Shown = Float32[Tensor, "batch shown px px 3"]
_Patches = Float32[Tensor, "batch latents rows cols values"]
_Frames = Float[Tensor, "batch _channels _frames _rows _columns"]


class VideoExpert(nn.Module):
    """Visual stream: `tokens_per_frame` tokens per latent frame; past and first frame are clean."""

    def __init__(self, config: NetworkConfig) -> None:
        super().__init__()
        width = config.video_width
        self.tokens_across, self.num_views = config.tokens_across, config.num_views
        self.use_pose_raster = config.use_pose_raster
        self.add_condition = config.add_condition_to_tokens
        self.is_anchored = config.video_target == "residual"
        raster_width = 2 * FRAMES_PER_LATENT * RASTER_CELLS_PER_TOKEN**2
        # Residuals come with the latent that they are relative to.
        self.embed = nn.Linear((1 + self.is_anchored) * config.video_channels, width)
        self.embed_raster = nn.Linear(raster_width, width, bias=False)
        self.places = nn.Parameter(0.02 * torch.randn(config.tokens_per_latent, width))
        self.frames = nn.Parameter(0.02 * torch.randn(config.max_latents, 1, width))
        self.modulate = nn.Sequential(nn.SiLU(), zero_linear(width, NUM_MODULATIONS * width))
        self.modulate_out = nn.Sequential(nn.SiLU(), zero_linear(width, 2 * width))
        self.predict = zero_linear(width, config.video_channels)

    def start(
        self,
        noisy: Latents,
        first: Float32[Tensor, "batch tokens channels"],
        condition: Condition,
        raster: _Raster,
        past_raster: _PastRaster,
    ) -> Stream:
        """Tokens before the first layer.

        `noisy` are residuals, the first one zero, or plain latents, the first one clean; those of
        past images come before it. Rasters are of the head's view.
        """
        dtype, num_past = self.places.dtype, past_raster.shape[1]
        condition = condition.to(dtype)
        if self.is_anchored:
            noisy = torch.cat([noisy, first[:, None].expand_as(noisy)], dim=-1)
        frames = functional.pad(self.frames[: noisy.shape[1] - num_past], (0, 0, 0, 0, num_past, 0))
        tokens = self.embed(noisy.to(dtype)) + self.places.repeat(self.num_views, 1) + frames
        if self.add_condition:
            tokens = tokens + condition.vector[:, :, None]
        if self.use_pose_raster:
            shown = self.embed_raster(self.raster_tokens(raster, past_raster).to(dtype))
            tokens = tokens + functional.pad(shown, (0, 0, 0, tokens.shape[2] - shown.shape[2]))
        modulation = split_axis(self.modulate(condition.vector), -1, (NUM_MODULATIONS, -1))
        per_token = modulation.repeat_interleave(noisy.shape[2], dim=1)
        return Stream(tokens.flatten(1, 2), per_token, actions=condition.actions)

    def finish(self, stream: Stream, condition: Condition) -> Latents:
        """Predict the clean latents, or the velocity, as the configuration says."""
        condition = condition.to(self.places.dtype)
        tokens = split_axis(stream.tokens, 1, (condition.vector.shape[1], -1))
        ends = self.modulate_out(condition.vector)[:, :, None]
        shift, scale = ends.expand(-1, -1, tokens.shape[2], -1).chunk(2, dim=-1)
        return self.predict(modulated_norm(tokens, shift, scale)).float()

    def raster_tokens(
        self, raster: _Raster, past_raster: _PastRaster
    ) -> Float32[Tensor, "batch latents tokens values"]:
        """The rasters cut into image tokens: four steps, four by four cells and two hands each."""
        still = past_raster[:, :, None].expand(-1, -1, FRAMES_PER_LATENT, -1, -1, -1)
        groups = torch.cat([still, _by_latent(raster)], dim=1)
        cells = (self.tokens_across, RASTER_CELLS_PER_TOKEN)
        grid = split_axis(split_axis(groups, 5, cells), 4, cells)
        # [B, L, 4, 2, rows, 4, cols, 4] -> [B, L, rows, cols, 4, 2, 4, 4]
        return grid.permute(0, 1, 4, 6, 2, 3, 5, 7).flatten(4).flatten(2, 3)


class ViewTokens(nn.Module):
    """What tells apart the tokens of the head's view, of further ones, and of past images.

    Tokens of a missing view are all equal, so that nothing comes from them.
    """

    def __init__(self, config: NetworkConfig) -> None:
        super().__init__()
        width, num_further = config.video_width, len(config.further_views)
        self.num_places = config.tokens_per_latent
        self.views = nn.Parameter(0.02 * torch.randn(num_further, 1, width))
        self.absent = nn.Parameter(torch.zeros(num_further, 1, width))
        self.past = nn.Parameter(0.02 * torch.randn(config.past_images, 1, 1, width))

    def forward(
        self,
        tokens: Float[Tensor, "batch tokens width"],
        missing: Bool[Tensor, "batch further"],
    ) -> Float[Tensor, "batch tokens width"]:
        """Tokens, frame by frame and view by view, with their embeddings."""
        grid = split_axis(tokens, 1, (-1, 1 + len(self.views), self.num_places))
        num_later = grid.shape[1] - len(self.past)
        grid = grid + functional.pad(self.past, (0, 0, 0, 0, 0, 0, 0, num_later))
        further = torch.where(missing[:, None, :, None, None], self.absent, grid[:, :, 1:])
        return torch.cat([grid[:, :, :1], further + self.views], dim=2).flatten(1, 3)


class VisualCodec(nn.Module):
    """Linear tokenizer of 1 + 4k images by principal axes of 8×8×4 patches, in closed form.

    The first image forms a group of its own (repeated four times), followed by groups of four. A
    token covers two by two patches of one latent frame. Frozen once fitted on training images.
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
        """Images after the first, or those of the last latent only.

        The last latent is decoded separately, so that its images are bit-identical whether or not
        the others are decoded.
        """
        images = self.decode(latents[:, [0, -1]])[:, 1:]
        if all_images and latents.shape[1] > 2:
            images = torch.cat([self.decode(latents[:, :-1])[:, 1:], images], dim=1)
        return images

    def _patches(self, images: Images) -> _Patches:
        groups = _by_latent(images)
        grid = split_axis(split_axis(groups, 4, (-1, self.patch_px)), 3, (-1, self.patch_px))
        # [B, L, 4, rows, p, cols, p, 3] -> [B, L, rows, cols, 4, p, p, 3]
        return grid.permute(0, 1, 3, 5, 2, 4, 6, 7).flatten(4)


def _by_latent(steps: Float32[Tensor, "batch time ..."]) -> Float32[Tensor, "batch latents 4 ..."]:
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

    It maps 1 + 4k images to 1 + k latent frames of 48 channels at a sixteenth of the resolution. It
    is causal: a latent frame depends on earlier images only, and an image on earlier latents only.

    `window` is the number of latents that an image is decoded from, and `tile_px` the side of the
    tiles that images are decoded in; None for all latents and whole images.
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
        # The mean of the encoder's distribution, not a sample of it.
        latents = self.autoencoder.encode(pixels).latent_dist.mode()
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

    Latents are decoded one after another, with the decoder's cache of earlier frames. In the last
    block and the head, at the full resolution, only those frames are computed that the images
    depend on: three convolutions of three frames a block reach back two frames each. Blocks before
    them need every latent. At full size this saves 16.5 % of the decoder's work.
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
    values = (like.new_tensor(constant).view(-1, 1, 1, 1) for constant in (LATENT_MEAN, LATENT_STD))
    mean, std = values
    return mean, std


@dataclass(frozen=True)
class WanCondition:
    """Condition of the video tokens: `time` has the actions, too; `text` is shared by all."""

    time: Float32[Tensor, "batch latents width"]
    modulation: Float32[Tensor, "batch latents 6 width"]
    text: Text


@dataclass(frozen=True)
class WanConstants:
    """What conditions consist of apart from the flow time."""

    actions: Float32[Tensor, "batch latents width"]
    text: Text


class WanVideoCondition(nn.Module):
    """Times, actions and instructions as the transformer of Wan2.2 takes them.

    Modulations are computed per latent frame, each with its own time, 0 for the clean first one.
    Actions are added to the embedding of the time, with an effect of zero before training. Without
    them and tactile tokens, the video side equals diffusers' `WanTransformer3DModel`.
    """

    def __init__(self, config: NetworkConfig, wan: WanConfig, embedder: nn.Module) -> None:
        super().__init__()
        width = config.video_width
        self.embedder: Any = embedder
        self.actions = two_layers(FRAMES_PER_LATENT * ACTION_WIDTH, width, width)
        self.actions[-1] = zero_linear(width, width)
        self.commanded = nn.Parameter(torch.zeros(width))
        self.num_clean = config.num_clean_frames
        self.past = PastCondition(width) if config.past_images else None
        self.text_features = TextFeatures(wan)
        self.kept_texts: LastUsed[Text] | None = None

    def constants(self, inputs: ModelInputs, features: ActionFeatures) -> WanConstants:
        """What does not depend on the flow time."""
        groups = split_axis(features.per_hand[:, 1:, 1], 1, (-1, FRAMES_PER_LATENT)).flatten(2)
        actions = self.actions(groups.to(self.commanded.dtype)).float()
        actions = after_first(without_dropped(actions, inputs), self.num_clean)
        if self.past is not None:
            actions = actions + self.past(features.past, groups.shape[1])
        kind = inputs.commanded[:, None, None] * self.commanded.float()
        texts = inputs.instructions
        if self.kept_texts is None:
            return self.of(actions + kind, self.text_features.stack(texts))
        # Of every precision of matrix products; one by one, since other batches have other rows.
        precision = torch.is_autocast_enabled(actions.device.type)
        rows = self.kept_texts.of(
            [(text, precision) for text in texts],
            lambda missing: [
                self._embedded(self.text_features.stack([texts[index]])) for index in missing
            ],
        )
        return WanConstants(actions + kind, Text(rows[0].words, rows=tuple(rows)))

    def of(self, actions: Tensor, text: Float[Tensor, "batch words features"]) -> WanConstants:
        """What embedded actions [batch, latents, width] and text features contribute."""
        return WanConstants(actions, self._embedded(text))

    def _embedded(self, text: Float[Tensor, "batch words features"]) -> Text:
        return Text(self.embedder.text_embedder(text.to(self.embedder.time_proj.weight)))

    def at(self, constants: WanConstants, t: Float32[Tensor, "batch latents"]) -> WanCondition:
        """Conditions at these times; t is zero where tokens are clean."""
        waves = self.embedder.timesteps_proj(TIME_RANGE * t.flatten())
        time = split_axis(self.embedder.time_embedder(waves), 0, tuple(t.shape)) + constants.actions
        project = self.embedder.time_proj
        modulation = project(functional.silu(time).to(project.weight.dtype)).float()
        return WanCondition(time, split_axis(modulation, -1, (NUM_MODULATIONS, -1)), constants.text)


class WanBlock(Block):
    """One layer of Wan2.2, before and after the shared attention."""

    def __init__(self, block: nn.Module) -> None:
        super().__init__()
        self.block: Any = block

    def queries_keys_values(self, stream: Stream) -> tuple[Heads, Heads, Heads]:
        """Queries, keys and values for the shared attention."""
        attention = self.block.attn1
        shift, scale, *_ = self._modulation(stream)
        normed = self._modulated(self.block.norm1, stream.tokens, shift, scale)
        parts = (
            attention.norm_q(attention.to_q(normed)),
            attention.norm_k(attention.to_k(normed)),
            attention.to_v(normed),
        )
        heads = (attention.heads, -1)
        query, key, value = (split_axis(part, -1, heads).transpose(1, 2) for part in parts)
        if stream.turn is None:
            return query, key, value
        return rotate(query, stream.turn), rotate(key, stream.turn), value

    def finish(self, stream: Stream, attended: Float[Tensor, "batch tokens inner"]) -> Stream:
        """Add the outputs of the shared attention, of the text and of the feed-forward network."""
        block = self.block
        _, _, gate, ffn_shift, ffn_scale, ffn_gate = self._modulation(stream)
        tokens = self._gated(stream.tokens, block.attn1.to_out[0](attended), gate)
        normed = block.norm2(tokens.float()).to(tokens.dtype)
        if stream.text is not None:
            tokens = tokens + self._read(normed, stream.text)
        normed = self._modulated(block.norm3, tokens, ffn_shift, ffn_scale)
        tokens = self._gated(tokens, block.ffn(normed), ffn_gate)
        return replace(stream, tokens=tokens)

    def _read(self, tokens: Tensor, text: Text) -> Tensor:
        attention = self.block.attn2
        heads = (attention.heads, -1)

        def keys_values(words: Tensor) -> KeysValues:
            words = words.to(tokens.dtype)
            key, value = attention.norm_k(attention.to_k(words)), attention.to_v(words)
            return KeysValues(
                split_axis(key, -1, heads).transpose(1, 2),
                split_axis(value, -1, heads).transpose(1, 2),
            )

        known = text.keys_values(self, keys_values)
        query = split_axis(attention.norm_q(attention.to_q(tokens)), -1, heads).transpose(1, 2)
        read = functional.scaled_dot_product_attention(query, known.keys, known.values)
        out: Tensor = attention.to_out[0](read.transpose(1, 2).flatten(2))
        return out

    def _modulation(self, stream: Stream) -> tuple[Tensor, ...]:
        return (stream.modulation + self.block.scale_shift_table).unbind(2)

    @staticmethod
    def _modulated(norm: nn.Module, tokens: Tensor, shift: Tensor, scale: Tensor) -> Tensor:
        frames = split_axis(norm(tokens.float()), 1, (shift.shape[1], -1))
        changed = frames * (1.0 + scale[:, :, None]) + shift[:, :, None]
        return changed.flatten(1, 2).to(tokens.dtype)

    @staticmethod
    def _gated(tokens: Tensor, added: Tensor, gate: Tensor) -> Tensor:
        frames = split_axis(added.float(), 1, (gate.shape[1], -1)) * gate[:, :, None]
        return (tokens.float() + frames.flatten(1, 2)).to(tokens.dtype)


class WanVideoExpert(nn.Module):
    """Ends of the transformer: embeds latents and predicts velocities."""

    def __init__(self, config: NetworkConfig, transformer: "WanTransformer3DModel") -> None:
        super().__init__()
        self._side, self._head_width = config.tokens_across, config.head_width
        self._num_views = config.num_views
        self.patch_embedding = transformer.patch_embedding
        self.norm_out = transformer.norm_out
        self.proj_out = transformer.proj_out
        self.scale_shift_table = transformer.scale_shift_table

    def start(
        self,
        noisy: Latents,
        first: Float32[Tensor, "batch tokens channels"],
        condition: WanCondition,
        _: _Raster,
        past_raster: _PastRaster,
    ) -> Stream:
        """Tokens before the first layer; after past ones, the clean `first` latent frame."""
        num_past = past_raster.shape[1]
        latents = torch.cat([noisy[:, :num_past], first[:, None], noisy[:, num_past + 1 :]], dim=1)
        # The convolution has the size of its stride, so it is one product per token.
        weight = self.patch_embedding.weight
        matrix = weight.permute(0, 2, 3, 4, 1).flatten(1)
        embedded = functional.linear(latents.to(weight.dtype), matrix, self.patch_embedding.bias)
        # Past images have times before that of the first one, and all views the same places.
        positions = video_positions(noisy.shape[1], self._side)
        positions[:, 0] -= num_past
        positions = split_axis(positions, 0, (noisy.shape[1], -1)).repeat(1, self._num_views, 1)
        return Stream(
            embedded.flatten(1, 2),
            condition.modulation,
            turn=angles(positions.flatten(0, 1), self._head_width).to(noisy.device),
            text=condition.text,
        )

    def finish(self, stream: Stream, condition: WanCondition) -> Latents:
        """Predict the velocity, noise less data."""
        tokens = split_axis(stream.tokens, 1, (condition.time.shape[1], -1))
        ends = self.scale_shift_table + condition.time[:, :, None]
        shift, scale = ends[:, :, None].unbind(3)
        normed = self.norm_out(tokens.float()) * (1.0 + scale) + shift
        predicted: Tensor = self.proj_out(normed.to(tokens.dtype)).float()
        return predicted


def empty_transformer(
    config: WanConfig, *, num_layers: int, num_heads: int, head_width: int
) -> "WanTransformer3DModel":
    """Transformer on the meta device, in the precision of the configuration."""
    from diffusers import WanTransformer3DModel

    sizes = config.transformer_sizes(
        num_layers=num_layers, num_heads=num_heads, head_width=head_width
    )
    with torch.device("meta"):
        transformer = WanTransformer3DModel(**sizes)
    for name, parameter in transformer.named_parameters():
        is_exact = any(part in name for part in FLOAT32_PARTS)
        parameter.data = parameter.data.to(torch.float32 if is_exact else config.dtype)
    return transformer.eval()


def empty_autoencoder(config: WanConfig) -> "AutoencoderKLWan":
    """Video autoencoder on the meta device; always float32, as it is published."""
    from diffusers import AutoencoderKLWan

    with torch.device("meta"):
        autoencoder = AutoencoderKLWan(**config.autoencoder_sizes())
    return autoencoder.eval()
