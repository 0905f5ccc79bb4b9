"""Learned tactile tokenizers: what Split-Hands and Grid share.

`dextouch train tokenizer` trains one, and the paper's form of the world model uses it
(`dextouch train world-model --preset paper --tokenizer PATH`).
"""

from abc import abstractmethod

import torch
from jaxtyping import Float32
from torch import Tensor

from dextouch.tactile.layout import NUM_TAXELS
from services.networks.principal_axes import root_pressure
from services.world_model.network.axes import split_axis
from services.world_model.network.configuration import NetworkConfig
from services.world_model.network.tactile_tokenizer import TactileTokenizer

NUM_PADS = 6


class LearnedTokenizer(TactileTokenizer):
    """Autoencoder of root pressures in units of their root mean square."""

    root_scale: Tensor

    def __init__(self, config: NetworkConfig) -> None:
        num_tokens = NUM_PADS if config.tactile_tokens == "pad" else 1
        super().__init__(num_tokens=num_tokens, channels=config.tactile_channels // num_tokens)
        self.register_buffer("root_scale", torch.ones(()))

    @abstractmethod
    def encode_roots(self, roots: Float32[Tensor, "n 320"]) -> Float32[Tensor, "n latents"]:
        """Latents of scaled root pressures."""

    @abstractmethod
    def decode_roots(self, latents: Float32[Tensor, "n latents"]) -> Float32[Tensor, "n 320"]:
        """Scaled root pressures of latents; values may be below zero."""

    def fit(self, tactile_kpa: Float32[Tensor, "n 2 320"]) -> None:
        """Fit the scale and `peak_kpa`; the weights are learned by gradient."""
        self.root_scale.copy_(root_pressure(tactile_kpa).square().mean().sqrt().clamp_min(1e-3))
        self.peak_kpa.copy_(tactile_kpa.max())

    def encode(
        self, tactile_kpa: Float32[Tensor, "*batch 320"]
    ) -> Float32[Tensor, "*batch tokens channels"]:
        """Latents; pressures below zero count as zero."""
        roots = root_pressure(tactile_kpa).reshape(-1, NUM_TAXELS) / self.root_scale
        latents = self.encode_roots(roots)
        return latents.reshape(*tactile_kpa.shape[:-1], self.num_tokens, self.channels)

    def decode(
        self, latents: Float32[Tensor, "*batch tokens channels"]
    ) -> Float32[Tensor, "*batch 320"]:
        """Pressures in kPa, never below zero."""
        return self.roots(latents).clamp_min(0.0).square()

    def roots(
        self, latents: Float32[Tensor, "*batch tokens channels"]
    ) -> Float32[Tensor, "*batch 320"]:
        """Root pressures (√kPa), which the loss compares; values may be below zero."""
        flat = latents.reshape(-1, self.num_tokens * self.channels)
        return split_axis(self.decode_roots(flat), 0, latents.shape[:-2]) * self.root_scale
