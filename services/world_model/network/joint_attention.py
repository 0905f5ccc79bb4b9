"""Joint transformer layer of both experts.

Mixture-of-Transformers: each stream has its own projections, norms, modulation and feed-forward
network; only the attention is shared, over the tokens of both.
"""

from abc import ABC, abstractmethod
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from typing import Any

import torch
from jaxtyping import Bool, Float, Float32
from torch import Tensor, nn
from torch.nn import functional

from services.world_model.network.action_attention import ActionAttention
from services.world_model.network.axes import split_axis
from services.world_model.network.rotary import rotate

NUM_MODULATIONS = 6


@dataclass(frozen=True)
class KeysValues:
    """Keys and values of tokens in one layer."""

    keys: Float[Tensor, "batch heads tokens head_width"]
    values: Float[Tensor, "batch heads tokens head_width"]


@dataclass(frozen=True)
class Text:
    """Embedded words that video tokens attend to; `kept` has their keys and values by layer.

    The words do not depend on the flow time, so that the steps of a sampler can share one object.
    """

    words: Float[Tensor, "batch words width"]
    kept: dict[int, KeysValues] = field(default_factory=dict)

    def keys_values(self, layer: nn.Module, compute: Callable[[Tensor], KeysValues]) -> KeysValues:
        """Keys and values of the words in a layer, computed at most once."""
        number = id(layer)
        if number not in self.kept:
            self.kept[number] = compute(self.words)
        return self.kept[number]


@dataclass(frozen=True)
class Stream:
    """Tokens of one expert with their modulation: shift, scale and gate, twice.

    `modulation` is that of each token, or of each latent frame for the pretrained video expert,
    whose tokens also attend to `text`. `turn` has the angles of rotary positions, where used, and
    `actions` the action tokens of each group of tokens, for cross-attention.
    """

    tokens: Float[Tensor, "batch tokens width"]
    modulation: Float[Tensor, "batch groups 6 width"]
    turn: Float32[Tensor, "tokens angles"] | None = None
    text: Text | None = None
    actions: Float[Tensor, "batch parts keys width"] | None = None

    def split(self, num_tokens: int) -> tuple["Stream", "Stream"]:
        """The first tokens and the others, each with their modulation, positions and actions."""
        total = self.tokens.shape[1]

        def cut(values: Tensor, axis: int) -> list[Tensor]:
            first = num_tokens * values.shape[axis] // total
            return list(torch.split(values, [first, values.shape[axis] - first], dim=axis))

        parts: dict[str, Any] = {
            name: cut(values, 0 if name == "turn" else 1)
            for name in ("tokens", "modulation", "turn", "actions")
            if (values := getattr(self, name)) is not None
        }
        first, others = (
            replace(self, **{name: both[index] for name, both in parts.items()}) for index in (0, 1)
        )
        return first, others


def clean_mask(
    is_clean: Bool[Tensor, " tokens"],
) -> Bool[Tensor, "tokens tokens"]:
    """Attention mask: clean queries attend to clean keys only, noisy queries to all keys.

    Clean context therefore never depends on noise. Every query attends at least to itself.
    """
    return ~is_clean[:, None] | is_clean[None, :]


class Block(nn.Module, ABC):
    """One expert's part of a layer, before and after the shared attention."""

    @abstractmethod
    def queries_keys_values(
        self, stream: Stream
    ) -> tuple[
        Float[Tensor, "batch heads tokens head_width"],
        Float[Tensor, "batch heads tokens head_width"],
        Float[Tensor, "batch heads tokens head_width"],
    ]:
        """Queries, keys and values for the shared attention."""

    @abstractmethod
    def finish(self, stream: Stream, attended: Float[Tensor, "batch tokens inner"]) -> Stream:
        """Add the output of the attention, then that of the feed-forward network."""


class ExpertBlock(Block):
    """Block of an expert that is trained from scratch."""

    def __init__(
        self,
        *,
        width: int,
        num_heads: int,
        head_width: int,
        ffn_ratio: int,
        attends_to_actions: bool = False,
    ) -> None:
        super().__init__()
        inner = num_heads * head_width
        self.num_heads, self.head_width = num_heads, head_width
        self.to_qkv = nn.Linear(width, 3 * inner)
        self.to_out = nn.Linear(inner, width)
        # Normalized queries and keys bound the attention logits.
        self.query_norm = nn.RMSNorm(head_width, eps=1e-6)
        self.key_norm = nn.RMSNorm(head_width, eps=1e-6)
        self.ffn = nn.Sequential(
            nn.Linear(width, ffn_ratio * width),
            nn.GELU(approximate="tanh"),
            nn.Linear(ffn_ratio * width, width),
        )
        self.modulation = nn.Parameter(torch.zeros(NUM_MODULATIONS, width))
        self.action_attention = (
            ActionAttention(width=width, num_heads=num_heads, head_width=head_width)
            if attends_to_actions
            else None
        )

    def queries_keys_values(
        self, stream: Stream
    ) -> tuple[
        Float[Tensor, "batch heads tokens head_width"],
        Float[Tensor, "batch heads tokens head_width"],
        Float[Tensor, "batch heads tokens head_width"],
    ]:
        """Queries, keys and values for the shared attention."""
        shift, scale, *_ = (stream.modulation + self.modulation).unbind(dim=2)
        normed = modulated_norm(stream.tokens, shift, scale)
        heads = split_axis(self.to_qkv(normed), -1, (3, self.num_heads, self.head_width))
        query, key, value = heads.permute(2, 0, 3, 1, 4)
        query, key = self.query_norm(query), self.key_norm(key)
        if stream.turn is None:
            return query, key, value
        return rotate(query, stream.turn), rotate(key, stream.turn), value

    def finish(self, stream: Stream, attended: Float[Tensor, "batch tokens inner"]) -> Stream:
        """Add the output of the attention, of that to actions, and of the feed-forward network."""
        _, _, gate, ffn_shift, ffn_scale, ffn_gate = (stream.modulation + self.modulation).unbind(2)
        attended = attended.to(stream.tokens.dtype)
        tokens = stream.tokens + (1.0 + gate) * self.to_out(attended)
        if self.action_attention is not None and stream.actions is not None:
            tokens = tokens + self.action_attention(tokens, stream.actions)
        normed = modulated_norm(tokens, ffn_shift, ffn_scale)
        return replace(stream, tokens=tokens + (1.0 + ffn_gate) * self.ffn(normed))


class JointLayer(nn.Module):
    """One layer: two expert blocks around one attention, or the video block alone."""

    def __init__(self, video: Block, tactile: Block | None) -> None:
        super().__init__()
        self.video = video
        self.tactile = tactile

    def forward(
        self, video: Stream, tactile: Stream | None, mask: Bool[Tensor, "tokens tokens"]
    ) -> tuple[Stream, Stream | None]:
        """Update both streams through the shared attention."""
        query, key, value = self._queries_keys_values(video, tactile)
        attended = functional.scaled_dot_product_attention(query, key, value, attn_mask=mask)
        return self._finish(video, tactile, attended)

    def update_after(
        self, past: KeysValues | None, video: Stream, tactile: Stream | None
    ) -> tuple[Stream, Stream | None, KeysValues]:
        """Update tokens that attend to all of each other and of `past`.

        Returns:
            Both streams, and the keys and values that their tokens attended to.
        """
        query, key, value = self._queries_keys_values(video, tactile)
        if past is not None:
            key = torch.cat([past.keys, key], dim=2)
            value = torch.cat([past.values, value], dim=2)
        attended = functional.scaled_dot_product_attention(query, key, value)
        return *self._finish(video, tactile, attended), KeysValues(key, value)

    def _queries_keys_values(
        self, video: Stream, tactile: Stream | None
    ) -> tuple[Tensor, Tensor, Tensor]:
        query, key, value = self.video.queries_keys_values(video)
        if self.tactile is not None and tactile is not None:
            parts = zip((query, key, value), self.tactile.queries_keys_values(tactile), strict=True)
            # The pretrained expert may have less precise weights than the tactile one.
            query, key, value = (torch.cat([a, b.to(a.dtype)], dim=2) for a, b in parts)
        return query, key, value

    def _finish(
        self, video: Stream, tactile: Stream | None, attended: Tensor
    ) -> tuple[Stream, Stream | None]:
        attended = attended.transpose(1, 2).flatten(2)
        num_video = video.tokens.shape[1]
        seen = self.video.finish(video, attended[:, :num_video])
        if self.tactile is None or tactile is None:
            return seen, None
        return seen, self.tactile.finish(tactile, attended[:, num_video:])


def modulated_norm(
    tokens: Float[Tensor, "*batch width"],
    shift: Float[Tensor, "*batch width"],
    scale: Float[Tensor, "*batch width"],
) -> Float[Tensor, "*batch width"]:
    """Layer norm without learned weights, then scale and shift by the condition (AdaLN)."""
    return functional.layer_norm(tokens, tokens.shape[-1:]) * (1.0 + scale) + shift


def zero_linear(in_width: int, out_width: int) -> nn.Linear:
    """Linear layer initialized to zero, so that modulations and outputs start neutral."""
    layer = nn.Linear(in_width, out_width)
    nn.init.zeros_(layer.weight)
    nn.init.zeros_(layer.bias)
    return layer
