"""Attention of the joint model: rotary positions, actions, tokens of video and touch together."""

from abc import ABC, abstractmethod
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from functools import cache
from typing import Any

import numpy as np
import torch
from jaxtyping import Bool, Float, Float32, Float64
from torch import Tensor, nn
from torch.nn import functional
from torch.utils.checkpoint import checkpoint

from dextouch.hands.actions import unpack_action
from dextouch.hands.robot_hand import RobotHand
from services.world_model.network.configuration import FRAMES_PER_LATENT, NetworkConfig

HAND_DIM = 29
CAMERA_DIM = 9
# In the wrist frame fingers point along -z, the thumb along +x; the right palm faces +y, the left
# -y. So the mirror image of a left hand is y → -y; in the head camera's optical frame it is x → -x.
MIRROR_WRIST = np.array([1.0, -1.0, 1.0])
MIRROR_CAMERA = np.array([-1.0, 1.0, 1.0])
# Of the parts of an action: own hand, other hand, camera.
PART_DIMS = [HAND_DIM, HAND_DIM, CAMERA_DIM]
# Base of the rotary positions.
_THETA = 1e4
NUM_MODULATIONS = 6
Heads = Float[Tensor, "batch heads tokens head_width"]
Tokens = Float[Tensor, "batch tokens width"]
_Rows = Float[Tensor, "*batch width"]


@cache
def left_joint_signs() -> Float64[np.ndarray, "20"]:
    """Signs that map left joint angles to those of the right hand, by mirrored axes."""
    axes = [
        np.array([joint.axis for finger in RobotHand(side).fingers for joint in finger.joints])
        for side in ("left", "right")
    ]
    return np.sign(np.einsum("ij,ij->i", -MIRROR_WRIST * axes[0], axes[1]))


def mirror_pose_9d(
    pose: np.ndarray, *, mirror_to: np.ndarray, mirror_from: np.ndarray
) -> Float64[np.ndarray, "*batch 9"]:
    """S_to T S_from of 9-D poses: translation and two rotation columns keep their places."""
    signs = np.concatenate(
        [mirror_to, mirror_to * mirror_from[0], mirror_to * mirror_from[1]], dtype=np.float64
    )
    return np.asarray(pose, dtype=np.float64) * signs


def hand_features(actions: np.ndarray) -> Float64[np.ndarray, "*batch 2 29"]:
    """Left (mirrored) and right hand of actions [..., 67]: 9-D wrist pose and 20 angles (rad)."""
    parts = unpack_action(actions)
    wrist_left = mirror_pose_9d(parts.wrist_left, mirror_to=MIRROR_WRIST, mirror_from=MIRROR_WRIST)
    left = np.concatenate([wrist_left, parts.joints_left_rad * left_joint_signs()], axis=-1)
    right = np.concatenate([parts.wrist_right, parts.joints_right_rad], axis=-1)
    return np.stack([left, right], axis=-2).astype(np.float64)


def camera_features(actions: np.ndarray) -> Float64[np.ndarray, "*batch 2 9"]:
    """Head camera pose of actions [..., 67] as each hand sees it: mirrored for the left."""
    camera = np.asarray(unpack_action(actions).camera_head, dtype=np.float64)
    mirrored = mirror_pose_9d(camera, mirror_to=MIRROR_CAMERA, mirror_from=MIRROR_CAMERA)
    return np.stack([mirrored, camera], axis=-2)


def split_axis(tensor: Tensor, axis: int, sizes: tuple[int, ...]) -> Tensor:
    """Split one axis into several; one size may be -1. Typed, unlike `Tensor.unflatten`."""
    axis = axis % tensor.ndim
    return tensor.reshape(*tensor.shape[:axis], *sizes, *tensor.shape[axis + 1 :])


def video_positions(num_latents: int, side: int) -> Float32[Tensor, "tokens 3"]:
    """Latent, row and column of the tokens of square latent frames, row by row."""
    axes = (torch.arange(num_latents), torch.arange(side), torch.arange(side))
    return torch.cartesian_prod(*axes).float()


def tactile_positions(num_steps: int, tokens_per_step: int) -> Float32[Tensor, "tokens 3"]:
    """Positions of tactile tokens: a quarter of a latent apart, at row and column 0."""
    positions = torch.zeros(num_steps, tokens_per_step, 3)
    positions[..., 0] = torch.arange(num_steps)[:, None] / FRAMES_PER_LATENT
    return positions.flatten(0, 1)


def angles(positions: Float32[Tensor, "tokens 3"], head_width: int) -> Float32[Tensor, "tokens n"]:
    """Angle of each pair of a head's values; rows and columns take two sixths of the width each."""
    spatial = 2 * (head_width // 6)
    parts = []
    for axis, width in enumerate((head_width - 2 * spatial, spatial, spatial)):
        exponents = torch.arange(0, width, 2, dtype=torch.float64) / width
        parts.append(positions[:, axis, None].double() * _THETA**-exponents)
    return torch.cat(parts, dim=1).float()


def rotate(heads: Heads, turn: Float32[Tensor, "tokens n"]) -> Heads:
    """Turn each pair of values by its angle, in float32."""
    first, second = split_axis(heads.float(), -1, (-1, 2)).unbind(-1)
    cos, sin = turn.cos(), turn.sin()
    turned = torch.stack([first * cos - second * sin, first * sin + second * cos], dim=-1)
    return turned.flatten(-2).to(heads.dtype)


class ActionTokens(nn.Module):
    """Tokens of the actions of one latent frame or step."""

    def __init__(self, *, num_steps: int, width: int) -> None:
        super().__init__()
        self.parts = nn.ModuleList(two_layers(dim, width, width) for dim in PART_DIMS)
        self.steps = nn.Parameter(0.02 * torch.randn(num_steps, 1, width))

    def forward(
        self, actions: Float32[Tensor, "*batch steps 67"]
    ) -> Float32[Tensor, "*batch tokens width"]:
        """Three tokens for each step."""
        parts = zip(self.parts, torch.split(actions, PART_DIMS, dim=-1), strict=True)
        tokens = torch.stack([embed(part) for embed, part in parts], dim=-2)
        return (tokens + self.steps).flatten(-3, -2)


class ActionAttention(nn.Module):
    """Attention of each group of tokens to the action tokens of that group, instead of AdaLN.

    Dual rate (equation 4 of the paper): tokens of video latent j attend to the actions 4j-3 … 4j,
    those of tactile step t to action t, and those of index 0 to nothing, which is without biases no
    change.
    """

    def __init__(self, *, width: int, num_heads: int, head_width: int) -> None:
        super().__init__()
        inner = num_heads * head_width
        self.num_heads = num_heads
        self.norm = nn.LayerNorm(width)
        self.to_query = nn.Linear(width, inner, bias=False)
        self.to_key_value = nn.Linear(width, 2 * inner, bias=False)
        self.query_norm = nn.RMSNorm(head_width, eps=1e-6)
        self.key_norm = nn.RMSNorm(head_width, eps=1e-6)
        self.to_out = nn.Linear(inner, width, bias=False)

    def forward(
        self, tokens: Tokens, actions: Float32[Tensor, "batch groups keys width"]
    ) -> Tokens:
        """What the tokens take from their actions; groups are consecutive and of one size."""
        groups = split_axis(self.norm(tokens), 1, (actions.shape[1], -1)).flatten(0, 1)
        query = split_axis(self.to_query(groups), -1, (self.num_heads, -1)).transpose(1, 2)
        both = split_axis(self.to_key_value(actions.flatten(0, 1)), -1, (2, self.num_heads, -1))
        both = both.permute(2, 0, 3, 1, 4)
        attended = functional.scaled_dot_product_attention(
            self.query_norm(query), self.key_norm(both[0]), both[1]
        )
        return self.to_out(attended.transpose(1, 2).flatten(2)).reshape(tokens.shape)


@dataclass(frozen=True)
class KeysValues:
    """Keys and values of tokens in one layer."""

    keys: Heads
    values: Heads


@dataclass(frozen=True)
class Text:
    """Embedded words that video tokens attend to; `kept` has their keys and values by layer.

    Steps of a sampler share one object; a batch may be of texts of single `rows`, which others
    share.
    """

    words: Float[Tensor, "batch words width"]
    kept: dict[int, KeysValues] = field(default_factory=dict)
    rows: tuple["Text", ...] = ()

    def keys_values(self, layer: nn.Module, compute: Callable[[Tensor], KeysValues]) -> KeysValues:
        """Keys and values of the words in a layer, computed at most once."""
        number = id(layer)
        if number not in self.kept:
            each = [row.keys_values(layer, compute) for row in self.rows]
            if not each:
                self.kept[number] = compute(self.words)
            elif all(one is each[0] for one in each):
                shape = (len(each), -1, -1, -1)
                keys, values = each[0].keys.expand(shape), each[0].values.expand(shape)
                self.kept[number] = KeysValues(keys, values)
            else:
                keys, values = (torch.cat([vars(o)[n] for o in each]) for n in ("keys", "values"))
                self.kept[number] = KeysValues(keys, values)
        return self.kept[number]


@dataclass(frozen=True)
class Stream:
    """Tokens of one expert with their modulation: shift, scale and gate, twice.

    `modulation` is that of each token, or of each latent frame for the pretrained video expert,
    whose tokens also attend to `text`. `turn` has the angles of rotary positions, where used, and
    `actions` the action tokens of each group of tokens, for cross-attention.
    """

    tokens: Tokens
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
            replace(self, **{name: both[i] for name, both in parts.items()}) for i in (0, 1)
        )
        return first, others


def clean_mask(is_clean: Bool[Tensor, " tokens"]) -> Bool[Tensor, "tokens tokens"]:
    """Attention mask: clean queries attend to clean keys only, noisy queries to all keys."""
    return ~is_clean[:, None] | is_clean[None, :]


class Block(nn.Module, ABC):
    """One expert's part of a layer, before and after the shared attention."""

    @abstractmethod
    def queries_keys_values(self, stream: Stream) -> tuple[Heads, Heads, Heads]:
        """Queries, keys and values for the shared attention."""

    @abstractmethod
    def finish(self, stream: Stream, attended: Float[Tensor, "batch tokens inner"]) -> Stream:
        """Add the output of the attention, then that of the feed-forward network."""


class ExpertBlock(Block):
    """Block of an expert of some width that is trained from scratch."""

    def __init__(self, config: NetworkConfig, width: int) -> None:
        super().__init__()
        num_heads, head_width = config.num_heads, config.head_width
        inner = num_heads * head_width
        self.num_heads, self.head_width = num_heads, head_width
        self.to_qkv = nn.Linear(width, 3 * inner)
        self.to_out = nn.Linear(inner, width)
        # Normalized queries and keys bound the attention logits.
        self.query_norm = nn.RMSNorm(head_width, eps=1e-6)
        self.key_norm = nn.RMSNorm(head_width, eps=1e-6)
        self.ffn = nn.Sequential(
            nn.Linear(width, config.ffn_ratio * width),
            nn.GELU(approximate="tanh"),
            nn.Linear(config.ffn_ratio * width, width),
        )
        self.modulation = nn.Parameter(torch.zeros(NUM_MODULATIONS, width))
        self.action_attention = (
            ActionAttention(width=width, num_heads=num_heads, head_width=head_width)
            if config.action_conditioning == "cross_attention"
            else None
        )

    def queries_keys_values(self, stream: Stream) -> tuple[Heads, Heads, Heads]:
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
    """One layer: two expert blocks around one shared attention, or the video block alone."""

    def __init__(self, video: Block, tactile: Block | None) -> None:
        super().__init__()
        self.video = video
        self.tactile = tactile
        # Whether training computes the layer again instead of keeping its activations.
        self.recompute = False

    def forward(
        self, video: Stream, tactile: Stream | None, mask: Bool[Tensor, "tokens tokens"]
    ) -> tuple[Stream, Stream | None]:
        """Update both streams through the shared attention."""
        if not self.recompute or not torch.is_grad_enabled():
            return self._update(video, tactile, mask)

        def update() -> tuple[Stream, Stream | None]:
            # Keys and values of the text are computed again, too.
            text = None if video.text is None else Text(video.text.words)
            return self._update(replace(video, text=text), tactile, mask)

        updated, touched = checkpoint(update, use_reentrant=False, preserve_rng_state=False)
        return replace(updated, text=video.text), touched

    def _update(
        self, video: Stream, tactile: Stream | None, mask: Tensor
    ) -> tuple[Stream, Stream | None]:
        query, key, value = self._queries_keys_values(video, tactile)
        attended = functional.scaled_dot_product_attention(query, key, value, attn_mask=mask)
        return self._finish(video, tactile, attended)

    def update_after(
        self, past: KeysValues | None, video: Stream, tactile: Stream | None
    ) -> tuple[Stream, Stream | None, KeysValues]:
        """Update tokens that attend to each other and `past`; also returns keys and values."""
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


def modulated_norm(tokens: _Rows, shift: _Rows, scale: _Rows) -> _Rows:
    """Layer norm without learned weights, then scale and shift by the condition (AdaLN)."""
    return functional.layer_norm(tokens, tokens.shape[-1:]) * (1.0 + scale) + shift


def two_layers(in_width: int, hidden_width: int, out_width: int) -> nn.Sequential:
    """Linear, SiLU, linear."""
    return nn.Sequential(
        nn.Linear(in_width, hidden_width), nn.SiLU(), nn.Linear(hidden_width, out_width)
    )


def zero_linear(in_width: int, out_width: int) -> nn.Linear:
    """Linear layer initialized to zero, so that modulations and outputs start neutral."""
    layer = nn.Linear(in_width, out_width)
    nn.init.zeros_(layer.weight)
    nn.init.zeros_(layer.bias)
    return layer
