"""Video side of the full-size model: the transformer of Wan2.2 around the shared attention.

Equal to diffusers' `WanTransformer3DModel` if there are no tactile tokens and no actions. Each
latent frame has its own time, 0 for the clean first one, so modulations are computed per latent
frame, not per token. Actions are added to the embedding of the time, with an effect of zero before
training.
"""

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any

import torch
from jaxtyping import Float, Float32
from torch import Tensor, nn
from torch.nn import functional

from services.world_model.network.axes import split_axis
from services.world_model.network.conditioning import (
    ACTION_WIDTH,
    TIME_RANGE,
    ActionFeatures,
    after_first,
    two_layers,
)
from services.world_model.network.configuration import FRAMES_PER_LATENT, NetworkConfig
from services.world_model.network.inputs import ModelInputs
from services.world_model.network.joint_attention import (
    NUM_MODULATIONS,
    Block,
    KeysValues,
    Stream,
    Text,
    zero_linear,
)
from services.world_model.network.rotary import angles, rotate, video_positions
from services.world_model.wan.configuration import WanConfig
from services.world_model.wan.text import TextFeatures

if TYPE_CHECKING:
    from diffusers import WanTransformer3DModel


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
    """Times, actions and instructions as the transformer of Wan2.2 takes them."""

    def __init__(self, config: NetworkConfig, wan: WanConfig, embedder: nn.Module) -> None:
        super().__init__()
        width = config.video_width
        self.embedder: Any = embedder
        self.actions = two_layers(FRAMES_PER_LATENT * ACTION_WIDTH, width, width)
        self.actions[-1] = zero_linear(width, width)
        self.commanded = nn.Parameter(torch.zeros(width))
        self.text_features = TextFeatures(wan)

    def forward(
        self,
        inputs: ModelInputs,
        features: ActionFeatures,
        t: Float32[Tensor, "batch latents"],
    ) -> WanCondition:
        """Conditions; t is zero where the latent is clean."""
        return self.at(self.constants(inputs, features), t)

    def constants(self, inputs: ModelInputs, features: ActionFeatures) -> WanConstants:
        """What does not depend on the flow time."""
        groups = split_axis(features.per_hand[:, 1:, 1], 1, (-1, FRAMES_PER_LATENT)).flatten(2)
        actions = after_first(self.actions(groups.to(self.commanded.dtype))).float()
        kind = inputs.commanded[:, None, None] * self.commanded.float()
        return self._constants(actions + kind, self.text_features.stack(inputs.instructions))

    def of(
        self,
        t: Float32[Tensor, "batch latents"],
        actions: Float32[Tensor, "batch latents width"],
        text: Float[Tensor, "batch words features"],
    ) -> WanCondition:
        """Conditions from embedded actions and text features."""
        return self.at(self._constants(actions, text), t)

    def _constants(self, actions: Tensor, text: Tensor) -> WanConstants:
        weight = self.embedder.time_proj.weight
        return WanConstants(actions, Text(self.embedder.text_embedder(text.to(weight))))

    def at(self, constants: WanConstants, t: Float32[Tensor, "batch latents"]) -> WanCondition:
        """Conditions at these times."""
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

    def queries_keys_values(
        self, stream: Stream
    ) -> tuple[
        Float[Tensor, "batch heads tokens head_width"],
        Float[Tensor, "batch heads tokens head_width"],
        Float[Tensor, "batch heads tokens head_width"],
    ]:
        """Queries, keys and values for the shared attention."""
        attention = self.block.attn1
        shift, scale, *_ = self._modulation(stream)
        normed = self._modulated(self.block.norm1, stream.tokens, shift, scale)
        query, key, value = (
            split_axis(part, -1, (attention.heads, -1)).transpose(1, 2)
            for part in (
                attention.norm_q(attention.to_q(normed)),
                attention.norm_k(attention.to_k(normed)),
                attention.to_v(normed),
            )
        )
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
        """What tokens take from the text by cross-attention."""
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
        """Shift, scale and gate of each latent frame, twice."""
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
        self.patch_embedding = transformer.patch_embedding
        self.norm_out = transformer.norm_out
        self.proj_out = transformer.proj_out
        self.scale_shift_table = transformer.scale_shift_table

    def start(
        self,
        noisy: Float32[Tensor, "batch latents tokens channels"],
        first: Float32[Tensor, "batch tokens channels"],
        condition: WanCondition,
        _: Float32[Tensor, "batch time 2 cells cells"],
    ) -> Stream:
        """Tokens before the first layer; the first latent frame is the clean `first`."""
        latents = torch.cat([first[:, None], noisy[:, 1:]], dim=1)
        # The convolution has the size of its stride, so it is one product per token.
        weight = self.patch_embedding.weight
        matrix = weight.permute(0, 2, 3, 4, 1).flatten(1)
        embedded = functional.linear(latents.to(weight.dtype), matrix, self.patch_embedding.bias)
        positions = video_positions(noisy.shape[1], self._side)
        return Stream(
            embedded.flatten(1, 2),
            condition.modulation,
            turn=angles(positions, self._head_width).to(noisy.device),
            text=condition.text,
        )

    def finish(
        self, stream: Stream, condition: WanCondition
    ) -> Float32[Tensor, "batch latents tokens channels"]:
        """Predict the velocity, noise less data."""
        tokens = split_axis(stream.tokens, 1, (condition.time.shape[1], -1))
        ends = self.scale_shift_table + condition.time[:, :, None]
        shift, scale = ends[:, :, None].unbind(3)
        normed = self.norm_out(tokens.float()) * (1.0 + scale) + shift
        predicted: Tensor = self.proj_out(normed.to(tokens.dtype)).float()
        return predicted
