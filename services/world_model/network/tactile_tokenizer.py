"""Tactile tokenizer ("Split-Hands"): one latent for the pressures of each hand and step.

All ten fingertips share one encoder and both palms another; a pad is identified by its position in
the hand's latent. Pressures are encoded by their square root, which gives light touch more weight.
Tips keep all sixteen values, palms their strongest axes. Closed form, fitted once, then frozen.
"""

import torch
from jaxtyping import Float32
from torch import Tensor, nn

from dextouch.tactile.layout import NUM_TAXELS, NUM_TIP_TAXELS
from services.world_model.network.configuration import NetworkConfig
from services.world_model.network.principal_axes import principal_axes, root_scale

# Amplitude of palms relative to that of tips; the best value in an ablation on touch.
PALM_SCALE = 0.7
# For checkpoints without a stored training peak: twice the peak of eight demonstrations of the
# twin's first two tasks.
UNKNOWN_PEAK_KPA = 200.0


class TactileTokenizer(nn.Module):
    """Frozen encoder and decoder of taxels; zero pressure is the zero latent.

    `peak_kpa` is the highest pressure in training.
    """

    tip_scale: Tensor
    peak_kpa: Tensor
    palm_basis: Tensor
    palm_scale: Tensor

    def __init__(self, config: NetworkConfig) -> None:
        super().__init__()
        num_palm = NUM_TAXELS - NUM_TIP_TAXELS
        self.channels = NUM_TIP_TAXELS + config.palm_channels
        self.register_buffer("tip_scale", torch.ones(()))
        self.register_buffer("peak_kpa", torch.full((), UNKNOWN_PEAK_KPA))
        self.register_buffer("palm_basis", torch.eye(num_palm, config.palm_channels))
        self.register_buffer("palm_scale", torch.ones(config.palm_channels))

    def fit(self, tactile_kpa: Float32[Tensor, "n 2 320"]) -> None:
        """Fit scales and palm axes to training touch (both hands alike)."""
        roots = root_pressure(tactile_kpa).double()
        palms = roots[..., NUM_TIP_TAXELS:].reshape(-1, NUM_TAXELS - NUM_TIP_TAXELS)
        # Not centred: the mean touch is not a touch that occurs.
        basis, rms = principal_axes(palms.T @ palms / len(palms), self.palm_basis.shape[1])
        tips_rms = roots[..., :NUM_TIP_TAXELS].square().mean().sqrt()
        self.palm_basis.copy_(basis)
        self.palm_scale.copy_(root_scale(rms) * PALM_SCALE)
        self.tip_scale.copy_(tips_rms.clamp_min(1e-3).float())
        self.peak_kpa.copy_(tactile_kpa.max())

    def bounded(
        self,
        tactile_kpa: Float32[Tensor, "batch steps 2 320"],
        first_kpa: Float32[Tensor, "batch 2 320"],
    ) -> Float32[Tensor, "batch steps 2 320"]:
        """Clip decoded pressures to the larger of the training peak and the first touch's peak."""
        highest_kpa = torch.maximum(first_kpa.flatten(1).amax(dim=1), self.peak_kpa)
        return torch.minimum(tactile_kpa, highest_kpa[:, None, None, None])

    def encode(
        self, tactile_kpa: Float32[Tensor, "*batch 320"]
    ) -> Float32[Tensor, "*batch channels"]:
        """Latents; pressures below zero count as zero."""
        roots = root_pressure(tactile_kpa)
        tips = roots[..., :NUM_TIP_TAXELS] / self.tip_scale
        palm = (roots[..., NUM_TIP_TAXELS:] @ self.palm_basis) / self.palm_scale
        return torch.cat([tips, palm], dim=-1)

    def decode(self, latents: Float32[Tensor, "*batch channels"]) -> Float32[Tensor, "*batch 320"]:
        """Pressures in kPa, never below zero."""
        tips = latents[..., :NUM_TIP_TAXELS] * self.tip_scale
        palm = (latents[..., NUM_TIP_TAXELS:] * self.palm_scale) @ self.palm_basis.T
        return torch.cat([tips, palm], dim=-1).clamp_min(0.0).square()


def root_pressure(tactile_kpa: Float32[Tensor, "..."]) -> Float32[Tensor, "..."]:
    """Square root of pressures; negative ones count as zero."""
    return tactile_kpa.clamp_min(0.0).sqrt()
