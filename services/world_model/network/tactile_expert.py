"""Tactile expert: embeds tactile latents for the joint layers and predicts clean ones."""

import torch
from jaxtyping import Float, Float32
from torch import Tensor, nn

from services.world_model.network.attention import (
    NUM_MODULATIONS,
    ExpertBlock,
    Stream,
    angles,
    modulated_norm,
    split_axis,
    tactile_positions,
    zero_linear,
)
from services.world_model.network.conditioning import Condition
from services.world_model.network.configuration import NetworkConfig


class TactileExpert(nn.Module):
    """Tactile stream: the tokens of each step and hand, one or one per pad; the first is clean."""

    def __init__(self, config: NetworkConfig, *, num_tokens: int, channels: int) -> None:
        super().__init__()
        width = config.tactile_width
        self._num_tokens = num_tokens
        # Rotary positions in the time of the pretrained video expert, which has them.
        self._head_width = None if config.wan is None else config.head_width
        self._add_condition = config.add_condition_to_tokens
        self._is_anchored = config.tactile_target == "residual"
        # Residuals come with the latent that they are relative to.
        self.embed = nn.Linear((1 + self._is_anchored) * channels, width)
        self.hands = nn.Parameter(0.02 * torch.randn(2, width))
        self.steps = nn.Parameter(0.02 * torch.randn(config.max_steps, 1, width))
        self.modulate = nn.Sequential(nn.SiLU(), zero_linear(width, NUM_MODULATIONS * width))
        self.modulate_out = nn.Sequential(nn.SiLU(), zero_linear(width, 2 * width))
        self.predict = zero_linear(width, channels)
        # A single token per hand needs no embedding of its pad.
        self.pads = nn.Parameter(0.02 * torch.randn(num_tokens, width)) if num_tokens > 1 else None

    @staticmethod
    def block(config: NetworkConfig) -> ExpertBlock:
        """This expert's block of one joint layer."""
        return ExpertBlock(
            width=config.tactile_width,
            num_heads=config.num_heads,
            head_width=config.head_width,
            ffn_ratio=config.ffn_ratio,
            attends_to_actions=config.action_conditioning == "cross_attention",
        )

    def start(
        self,
        noisy: Float32[Tensor, "batch time 2 tokens channels"],
        first: Float32[Tensor, "batch 2 tokens channels"],
        condition: Condition,
    ) -> Stream:
        """Tokens before the first layer.

        `noisy` are residuals, the first ones zero, or plain latents, the first ones clean.
        """
        steps, dtype = self.steps[: noisy.shape[1]], self.steps.dtype
        condition = condition.to(dtype)
        if self._is_anchored:
            noisy = torch.cat([noisy, first[:, None].expand_as(noisy)], dim=-1)
        # In this order, so that sums with one token per hand are those of older releases.
        tokens = self.embed(noisy.to(dtype)) + self.hands[:, None] + steps[:, None]
        if self._add_condition:
            tokens = tokens + condition.vector[..., None, :]
        if self.pads is not None:
            tokens = tokens + self.pads
        modulation = self._for_each_token(self.modulate(condition.vector))
        modulation = split_axis(modulation, -1, (NUM_MODULATIONS, -1))
        turn = None
        if self._head_width is not None:
            positions = tactile_positions(noisy.shape[1], 2 * self._num_tokens)
            turn = angles(positions, self._head_width).to(noisy.device)
        return Stream(
            tokens.flatten(1, 3), modulation.flatten(1, 3), turn=turn, actions=condition.actions
        )

    def finish(
        self, stream: Stream, condition: Condition
    ) -> Float32[Tensor, "batch time 2 tokens channels"]:
        """Predict the clean latents, or the velocity, as the configuration says."""
        condition = condition.to(self.steps.dtype)
        tokens = split_axis(stream.tokens, 1, (condition.vector.shape[1], 2, self._num_tokens))
        shift, scale = self._for_each_token(self.modulate_out(condition.vector)).chunk(2, dim=-1)
        return self.predict(modulated_norm(tokens, shift, scale)).float()

    def _for_each_token(
        self, of_hand: Float[Tensor, "batch time 2 width"]
    ) -> Float[Tensor, "batch time 2 tokens width"]:
        """Repeat what all tokens of a hand share."""
        return of_hand[..., None, :].expand(-1, -1, -1, self._num_tokens, -1)
