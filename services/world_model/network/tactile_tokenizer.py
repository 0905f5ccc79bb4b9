"""Interface of tactile tokenizers, which turn the pressures of a hand into tokens and back.

All of them work on the square root of pressure, which gives light touch more weight, and are frozen
while a world model is trained on their latents. `NetworkConfig.tokenizer` chooses one.
"""

from abc import ABC, abstractmethod

import torch
from jaxtyping import Float32
from torch import Tensor, nn

# For checkpoints without a stored training peak: twice the peak of eight demonstrations of the
# twin's first two tasks.
UNKNOWN_PEAK_KPA = 200.0


class TactileTokenizer(nn.Module, ABC):
    """Encoder and decoder of the taxels of one hand; zero pressure is the zero latent.

    `peak_kpa` is the highest pressure in training.

    Args:
        num_tokens: tokens per hand.
        channels: latent values of each token.
    """

    peak_kpa: Tensor

    def __init__(self, *, num_tokens: int, channels: int) -> None:
        super().__init__()
        self.num_tokens, self.channels = num_tokens, channels
        self.register_buffer("peak_kpa", torch.full((), UNKNOWN_PEAK_KPA))

    @abstractmethod
    def fit(self, tactile_kpa: Float32[Tensor, "n 2 320"]) -> None:
        """Fit what follows from training touch in closed form, including `peak_kpa`."""

    @abstractmethod
    def encode(
        self, tactile_kpa: Float32[Tensor, "*batch 320"]
    ) -> Float32[Tensor, "*batch tokens channels"]:
        """Latents; pressures below zero count as zero."""

    @abstractmethod
    def decode(
        self, latents: Float32[Tensor, "*batch tokens channels"]
    ) -> Float32[Tensor, "*batch 320"]:
        """Pressures in kPa, never below zero."""

    def bounded(
        self,
        tactile_kpa: Float32[Tensor, "batch steps 2 320"],
        first_kpa: Float32[Tensor, "batch 2 320"],
    ) -> Float32[Tensor, "batch steps 2 320"]:
        """Clip decoded pressures to the larger of the training peak and the first touch's peak."""
        highest_kpa = torch.maximum(first_kpa.flatten(1).amax(dim=1), self.peak_kpa)
        return torch.minimum(tactile_kpa, highest_kpa[:, None, None, None])
