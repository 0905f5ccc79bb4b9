"""The video expert of the joint model, and its conditions: a small one or Wan2.2's."""

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any, Final

import torch
from jaxtyping import Bool, Float, Float32
from torch import Tensor, nn
from torch.nn import functional

from services.world_model.network import conditioning
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
    two_layers,
    video_positions,
    zero_linear,
)
from services.world_model.network.codecs import Latents, by_latent
from services.world_model.network.configuration import (
    FLOAT32_PARTS,
    FRAMES_PER_LATENT,
    RASTER_CELLS_PER_TOKEN,
    NetworkConfig,
    WanConfig,
    num_latents,
)
from services.world_model.network.inputs import ModelInputs
from services.world_model.network.instruction import LastUsed, TextFeatures

if TYPE_CHECKING:
    from diffusers import WanTransformer3DModel

_ADAPTERS: Final = (".lora_down", ".lora_up")
_Raster = Float32[Tensor, "batch time 2 cells cells"]
_PastRaster = Float32[Tensor, "batch past 2 cells cells"]


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
        self.frames = nn.Parameter(0.02 * torch.randn(num_latents(config.max_steps), 1, width))
        self.modulate = nn.Sequential(nn.SiLU(), zero_linear(width, NUM_MODULATIONS * width))
        self.modulate_out = nn.Sequential(nn.SiLU(), zero_linear(width, 2 * width))
        self.predict = zero_linear(width, config.video_channels)

    def start(
        self,
        noisy: Latents,
        first: Float32[Tensor, "batch tokens channels"],
        condition: conditioning.Condition,
        raster: _Raster,
        past_raster: _PastRaster,
    ) -> Stream:
        """Tokens before the first layer; latents of past images come first, then a clean one."""
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

    def finish(self, stream: Stream, condition: conditioning.Condition) -> Latents:
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
        groups = torch.cat([still, by_latent(raster)], dim=1)
        cells = (self.tokens_across, RASTER_CELLS_PER_TOKEN)
        grid = split_axis(split_axis(groups, 5, cells), 4, cells)
        # [B, L, 4, 2, rows, 4, cols, 4] -> [B, L, rows, cols, 4, 2, 4, 4]
        return grid.permute(0, 1, 4, 6, 2, 3, 5, 7).flatten(4).flatten(2, 3)


class ViewTokens(nn.Module):
    """Embeddings of further views, past images, and missing views, whose tokens are all equal."""

    def __init__(self, config: NetworkConfig) -> None:
        super().__init__()
        width, num_further = config.video_width, len(config.further_views)
        self.num_places = config.tokens_per_latent
        self.views = nn.Parameter(0.02 * torch.randn(num_further, 1, width))
        self.absent = nn.Parameter(torch.zeros(num_further, 1, width))
        self.past = nn.Parameter(0.02 * torch.randn(config.past_images, 1, 1, width))

    def forward(
        self, tokens: Float[Tensor, "batch tokens width"], missing: Bool[Tensor, "batch further"]
    ) -> Float[Tensor, "batch tokens width"]:
        """Tokens, frame by frame and view by view, with their embeddings."""
        grid = split_axis(tokens, 1, (-1, 1 + len(self.views), self.num_places))
        num_later = grid.shape[1] - len(self.past)
        grid = grid + functional.pad(self.past, (0, 0, 0, 0, 0, 0, 0, num_later))
        further = torch.where(missing[:, None, :, None, None], self.absent, grid[:, :, 1:])
        return torch.cat([grid[:, :, :1], further + self.views], dim=2).flatten(1, 3)


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

    Actions are added to the embedding of the time of each latent frame, with an effect of zero
    before training. Without them and touch, the video side equals diffusers'
    `WanTransformer3DModel`.
    """

    def __init__(self, config: NetworkConfig, wan: WanConfig, embedder: nn.Module) -> None:
        super().__init__()
        width = config.video_width
        self.embedder: Any = embedder
        self.actions = two_layers(FRAMES_PER_LATENT * conditioning.ACTION_WIDTH, width, width)
        self.actions[-1] = zero_linear(width, width)
        self.commanded = nn.Parameter(torch.zeros(width))
        self.num_clean = config.num_clean_frames
        self.past = conditioning.PastCondition(width) if config.past_images else None
        self.text_features = TextFeatures(wan)
        self.kept_texts: LastUsed[Text] | None = None

    def constants(self, inputs: ModelInputs, features: conditioning.ActionFeatures) -> WanConstants:
        """What does not depend on the flow time."""
        groups = split_axis(features.per_hand[:, 1:, 1], 1, (-1, FRAMES_PER_LATENT)).flatten(2)
        actions = self.actions(groups.to(self.commanded.dtype)).float()
        actions = conditioning.after_first(
            conditioning.without_dropped(actions, inputs), self.num_clean
        )
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
        waves = self.embedder.timesteps_proj(conditioning.TIME_RANGE * t.flatten())
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


def empty_transformer(config: NetworkConfig, wan: WanConfig) -> "WanTransformer3DModel":
    """Transformer on the meta device, in the precision of the configuration."""
    from diffusers import WanTransformer3DModel

    sizes = wan.transformer_sizes(
        num_layers=config.num_layers, num_heads=config.num_heads, head_width=config.head_width
    )
    with torch.device("meta"):
        transformer = WanTransformer3DModel(**sizes)
    for name, parameter in transformer.named_parameters():
        is_exact = any(part in name for part in FLOAT32_PARTS)
        parameter.data = parameter.data.to(torch.float32 if is_exact else wan.dtype)
    return transformer.eval()


class AdaptedLinear(nn.Linear):
    """A linear layer with an adapter (LoRA, Hu et al. 2022); weight and bias keep their names.

    W x + b becomes W x + b + s U D x, with D of `rank` rows and U of `rank` columns that begins at
    zero. Adapters are float32 beside weights of any precision.
    """

    def __init__(self, base: nn.Linear, rank: int, scale: float) -> None:
        super().__init__(base.in_features, base.out_features, device="meta")
        self.weight, self.bias = base.weight, base.bias
        self.scale = scale
        self.lora_down = nn.Parameter(torch.empty(rank, base.in_features))
        self.lora_up = nn.Parameter(torch.zeros(base.out_features, rank))
        nn.init.kaiming_uniform_(self.lora_down, a=5**0.5)

    def forward(self, rows: Float[Tensor, "*batch given"]) -> Float[Tensor, "*batch made"]:
        """The layer's outputs with those of the adapter, in the precision of the former."""
        made = super().forward(rows)
        low = functional.linear(rows.to(self.lora_down.dtype), self.lora_down)
        return made + (self.scale * functional.linear(low, self.lora_up)).to(made.dtype)

    def merged_weight(self) -> Float[Tensor, "made given"]:
        """The weight of a linear layer with the same outputs, but for its precision."""
        change = self.scale * (self.lora_up.float() @ self.lora_down.float())
        return (self.weight.float() + change).to(self.weight.dtype)


def add_adapters(network: nn.Module, rank: int, scale: float) -> None:
    """Give every linear layer of a network an adapter, in place."""
    for parent in list(network.modules()):
        for name, child in parent.named_children():
            if type(child) is nn.Linear:
                setattr(parent, name, AdaptedLinear(child, rank, scale))


def is_adapter(name: str) -> bool:
    """Whether a tensor of this name belongs to an adapter."""
    return name.endswith(_ADAPTERS)


@torch.no_grad()
def merge_adapters(network: nn.Module) -> None:
    """Replace every layer that has an adapter by a linear layer with the same outputs, in place."""
    for parent in list(network.modules()):
        for name, child in parent.named_children():
            if isinstance(child, AdaptedLinear):
                plain = nn.Linear(child.in_features, child.out_features, device="meta")
                plain.weight, plain.bias = nn.Parameter(child.merged_weight()), child.bias
                setattr(parent, name, plain.requires_grad_(child.weight.requires_grad))
