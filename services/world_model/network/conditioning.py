"""Conditions of the experts: flow time, actions, instruction, action kind and scene.

Dual rate (equation 4 of the paper): video latent j is conditioned on a[4j-3 … 4j], tactile step t
on a_t, and index 0 on zeros.
"""

import math
from dataclasses import dataclass

import torch
from jaxtyping import Float, Float32
from torch import Tensor, nn

from services.world_model.network.attention import (
    CAMERA_DIM,
    HAND_DIM,
    ActionTokens,
    split_axis,
    two_layers,
    zero_linear,
)
from services.world_model.network.configuration import FRAMES_PER_LATENT, NetworkConfig
from services.world_model.network.inputs import GEOMETRY_SIZE, ModelInputs
from services.world_model.network.instruction import InstructionEncoder, SubwordEncoder

TIME_WIDTH = 64
TIME_RANGE = 1000.0
# Own hand, other hand, camera.
ACTION_WIDTH = 2 * HAND_DIM + CAMERA_DIM
MAX_DEVIATION = 10.0
_CAMERA_SCALE = torch.tensor([0.05] * 3 + [0.1] * 6)
_LAYOUT_SCALE = torch.tensor([0.1] * 3 + [0.5] * 6)
_NO_MOTION = torch.tensor([0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 1.0, 0.0])
_TYPICAL_LAYOUT = torch.tensor([0.0, 0.0, 0.5] + [0.0] * 6)


@dataclass(frozen=True)
class ActionFeatures:
    """Normalized actions as each hand sees them (own, other, camera); `past` is the right one's."""

    per_hand: Float32[Tensor, "batch time 2 67"]
    layout: Float32[Tensor, "batch 2 18"]
    past: Float32[Tensor, "batch past 69"]


class ActionNormalizer(nn.Module):
    """Statistics of training actions, kept in the checkpoint."""

    mean: Tensor
    std: Tensor

    def __init__(self) -> None:
        super().__init__()
        self.register_buffer("mean", torch.zeros(HAND_DIM))
        self.register_buffer("std", torch.ones(HAND_DIM))

    def fit(self, hands: Float32[Tensor, "n time 2 29"]) -> None:
        """Fit mean and deviation over windows; the three translation axes share one deviation."""
        flat = hands.reshape(-1, HAND_DIM).double()
        mean, std = flat.mean(dim=0), flat.std(dim=0)
        mean[:3] = 0.0
        std[:3] = flat[:, :3].square().mean().sqrt()
        std[:3] = std[:3].clamp_min(0.005)
        std[3:] = std[3:].clamp_min(0.02)
        self.mean.copy_(mean.float())
        self.std.copy_(std.float())

    def forward(self, inputs: ModelInputs) -> ActionFeatures:
        """Normalized features, clipped to ten deviations so that no input saturates the network."""
        device = inputs.camera.device
        layout = _bounded((inputs.layout - _TYPICAL_LAYOUT.to(device)) / _LAYOUT_SCALE.to(device))
        age = inputs.past_age[..., None]
        of_past = self._per_hand(inputs.past_hands, inputs.past_camera)[:, :, 1]
        return ActionFeatures(
            self._per_hand(inputs.hands, inputs.camera),
            torch.cat([layout, layout.flip(1)], dim=-1),
            torch.cat([of_past, torch.log1p(age / FRAMES_PER_LATENT), (age > 0).float()], dim=-1),
        )

    def _per_hand(self, hands: Tensor, camera: Tensor) -> Float32[Tensor, "batch time 2 67"]:
        own = _bounded((hands - self.mean) / self.std)
        device = camera.device
        camera = _bounded((camera - _NO_MOTION.to(device)) / _CAMERA_SCALE.to(device))
        return torch.cat([own, own.flip(2), camera], dim=-1)


class TimeEmbedding(nn.Module):
    """Embedding of a flow time in 0 … 1; float32 throughout."""

    def __init__(self, width: int) -> None:
        super().__init__()
        self.project = two_layers(TIME_WIDTH, width, width)

    def forward(self, t: Float32[Tensor, "..."]) -> Float32[Tensor, "*batch width"]:
        """Sines and cosines followed by two layers."""
        half = TIME_WIDTH // 2
        steps = torch.arange(half, dtype=torch.float32, device=t.device)
        rates = torch.exp(-math.log(1e4) * steps / half)
        angles = t[..., None] * TIME_RANGE * rates
        return self.project(torch.cat([angles.cos(), angles.sin()], dim=-1))


@dataclass(frozen=True)
class Condition:
    """What a group of tokens depends on: modulation of norms, tokens for cross-attention."""

    vector: Float[Tensor, "batch *groups width"]
    actions: Float[Tensor, "batch groups keys width"] | None = None

    def to(self, dtype: torch.dtype) -> "Condition":
        """In the precision of an expert; conditions themselves are computed in float32."""
        actions = None if self.actions is None else self.actions.to(dtype)
        return Condition(self.vector.to(dtype), actions)


@dataclass(frozen=True)
class Constants:
    """What conditions consist of apart from the flow time: terms of the vector, in their order."""

    terms: tuple[Float32[Tensor, "batch *groups width"], ...]
    actions: Float32[Tensor, "batch groups keys width"] | None = None

    def at(self, time: Float32[Tensor, "batch *groups width"]) -> Condition:
        """Condition at the embedded times."""
        return Condition(sum(self.terms, start=time), self.actions)


class ExpertCondition(nn.Module):
    """What both experts are conditioned on: the actions of `num_steps`, and contact geometry."""

    def __init__(self, config: NetworkConfig, *, width: int, num_steps: int) -> None:
        super().__init__()
        self.actions: nn.Sequential | None = None
        self.action_tokens: ActionTokens | None = None
        if config.action_conditioning == "cross_attention":
            self.action_tokens = ActionTokens(num_steps=num_steps, width=width)
        else:
            self.actions = two_layers(num_steps * ACTION_WIDTH, 2 * width, width)
        self.geometry: nn.Sequential | None = None
        if config.use_contact_geometry:
            self.geometry = two_layers(num_steps * 2 * GEOMETRY_SIZE, 2 * width, width)


class VideoCondition(ExpertCondition):
    """Condition of every latent frame."""

    def __init__(self, config: NetworkConfig) -> None:
        width = config.video_width
        super().__init__(config, width=width, num_steps=FRAMES_PER_LATENT)
        self.time = TimeEmbedding(width)
        self.static = StaticCondition(config, width)
        self.num_clean = config.num_clean_frames
        self.past = PastCondition(width) if config.past_images else None

    def constants(self, inputs: ModelInputs, features: ActionFeatures) -> Constants:
        """What does not depend on the flow time."""
        terms, tokens, num = [], None, self.num_clean
        # Of each latent frame after the first, as the right hand sees them.
        actions = split_axis(features.per_hand[:, 1:, 1], 1, (-1, FRAMES_PER_LATENT))
        if self.actions is not None:
            moved = without_dropped(self.actions(actions.flatten(2)), inputs)
            terms.append(after_first(moved, num))
        if self.action_tokens is not None:
            tokens = after_first(without_dropped(self.action_tokens(actions), inputs), num)
        if self.geometry is not None:
            near = split_axis(inputs.geometry[:, 1:], 1, (-1, FRAMES_PER_LATENT)).flatten(2)
            terms.append(after_first(without_dropped(self.geometry(near), inputs), num))
        if self.past is not None:
            terms.append(self.past(features.past, actions.shape[1]))
        return Constants((*terms, self.static(inputs)[:, None]), tokens)

    def at(self, constants: Constants, t: Float32[Tensor, "batch latents"]) -> Condition:
        """Conditions at these times; t is zero where tokens are clean."""
        return constants.at(self.time(t))


class PastCondition(nn.Module):
    """What the latent frames of past images depend on beside time: the poses then, and the age."""

    def __init__(self, width: int) -> None:
        super().__init__()
        self.layers = two_layers(ACTION_WIDTH + 2, width, width)
        self.layers[-1] = zero_linear(width, width)

    def forward(
        self, past: Float32[Tensor, "batch past 69"], num_later: int
    ) -> Float32[Tensor, "batch frames width"]:
        """Embeddings of the past, followed by zeros for the first frame and the later ones."""
        found: Tensor = self.layers(past).float()
        return nn.functional.pad(found, (0, 0, 0, 1 + num_later))


class TactileCondition(ExpertCondition):
    """Condition of every step and hand."""

    def __init__(self, config: NetworkConfig) -> None:
        width = config.tactile_width
        super().__init__(config, width=width, num_steps=1)
        self.layout: nn.Sequential | None = None
        self.scene: SceneEncoder | None = None
        if config.use_scene_encoder:
            self.layout = two_layers(2 * CAMERA_DIM, width, width)
            self.scene = SceneEncoder(width)
        self.time = TimeEmbedding(width)
        self.static = StaticCondition(config, width)

    def constants(self, inputs: ModelInputs, features: ActionFeatures) -> Constants:
        """What does not depend on the flow time."""
        terms, tokens = [], None
        if self.actions is not None:
            terms.append(
                after_first(without_dropped(self.actions(features.per_hand[:, 1:]), inputs))
            )
        if self.action_tokens is not None:
            tokens = self.action_tokens(features.per_hand[:, 1:, :, None])
            tokens = after_first(without_dropped(tokens, inputs)).flatten(1, 2)
        if self.geometry is not None:
            own = inputs.geometry[:, 1:]
            near = self.geometry(torch.cat([own, own.flip(2)], dim=-1))
            terms.append(after_first(without_dropped(near, inputs)))
        if self.scene is not None and self.layout is not None:
            terms.append((self.scene(inputs) + self.layout(features.layout))[:, None])
        return Constants((*terms, self.static(inputs)[:, None, None]), tokens)

    def at(self, constants: Constants, t: Float32[Tensor, "batch time"]) -> Condition:
        """Conditions at these times; t is zero where tokens are clean."""
        return constants.at(self.time(t)[:, :, None].expand(-1, -1, 2, -1))


class StaticCondition(nn.Module):
    """Condition that is constant over the window: instruction and kind of action."""

    def __init__(self, config: NetworkConfig, width: int) -> None:
        super().__init__()
        self.instruction: InstructionEncoder | SubwordEncoder
        if config.instruction_encoder == "subwords":
            self.instruction = SubwordEncoder(word_width=config.word_width, width=width)
        else:
            self.instruction = InstructionEncoder(
                num_buckets=config.num_word_buckets, word_width=config.word_width, width=width
            )
        self.commanded = nn.Parameter(torch.zeros(width))

    def forward(self, inputs: ModelInputs) -> Float32[Tensor, "batch width"]:
        """Embedding of the instruction, plus a learned vector for commanded actions."""
        return self.instruction(inputs.words) + inputs.commanded[:, None] * self.commanded


class SceneEncoder(nn.Module):
    """Encodes the first image, with a hand's raster at the first and last step, for each hand."""

    def __init__(self, width: int) -> None:
        super().__init__()
        self.layers = nn.Sequential(
            nn.Conv2d(5, 16, 4, stride=2, padding=1), nn.GELU(),
            nn.Conv2d(16, 24, 4, stride=2, padding=1), nn.GELU(),
            nn.Conv2d(24, 32, 4, stride=2, padding=1), nn.GELU(),
            nn.Conv2d(32, 32, 4, stride=2, padding=1), nn.GELU(),
            nn.AdaptiveAvgPool2d(4), nn.Flatten(), nn.Linear(32 * 16, width),
        )  # fmt: skip

    def forward(self, inputs: ModelInputs) -> Float32[Tensor, "batch 2 width"]:
        """One vector per hand; the left hand's image is mirrored."""
        image = inputs.first_image.permute(0, 3, 1, 2).float() / 127.5 - 1.0
        ends = inputs.raster[:, [0, -1]].transpose(1, 2)
        ends = nn.functional.interpolate(ends.flatten(0, 1), size=image.shape[-2:])
        both = image[:, None].expand(-1, 2, -1, -1, -1)
        views = torch.cat([both, split_axis(ends, 0, (-1, 2))], dim=2)
        views = torch.stack([views[:, 0].flip(-1), views[:, 1]], dim=1)
        return split_axis(self.layers(views.flatten(0, 1)), 0, (-1, 2))


def without_dropped(
    condition: Float32[Tensor, "batch later ..."], inputs: ModelInputs
) -> Float32[Tensor, "batch later ..."]:
    """The condition, and zeros for windows without actions."""
    return condition * inputs.acting.view(-1, *[1] * (condition.ndim - 1))


def after_first(
    condition: Float32[Tensor, "batch later ..."], num_clean: int = 1
) -> Float32[Tensor, "batch time ..."]:
    """Prepend zeros for index 0, which has no action (c_0 = 0), and for past images before it."""
    zeros = condition.new_zeros(len(condition), num_clean, *condition.shape[2:])
    return torch.cat([zeros, condition], dim=1)


def _bounded(features: Float32[Tensor, "..."]) -> Float32[Tensor, "..."]:
    return features.clamp(-MAX_DEVIATION, MAX_DEVIATION)
