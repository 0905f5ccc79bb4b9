"""Principal-axes tokenizer: one token per hand in closed form, the default of the world model.

Tips keep all sixteen values, palms their strongest axes. It is fitted in a second and loses little
touch, but learns nothing about the hand; `services.world_model.network.split_hands` does.
"""

import torch
from jaxtyping import Float32
from torch import Tensor

from dextouch.tactile.layout import NUM_TAXELS, NUM_TIP_TAXELS
from services.networks.principal_axes import principal_axes, root_pressure, root_scale
from services.world_model.network.configuration import NetworkConfig
from services.world_model.network.tactile_tokenizer import TactileTokenizer

# Amplitude of palms relative to that of tips; the best value in an ablation on touch.
PALM_SCALE = 0.7


class PrincipalAxesTokenizer(TactileTokenizer):
    """Tips as they are and palms along their principal axes, as one token."""

    tip_scale: Tensor
    palm_basis: Tensor
    palm_scale: Tensor

    def __init__(self, config: NetworkConfig) -> None:
        super().__init__(num_tokens=1, channels=NUM_TIP_TAXELS + config.palm_channels)
        num_palm = NUM_TAXELS - NUM_TIP_TAXELS
        self.register_buffer("tip_scale", torch.ones(()))
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

    def encode(
        self, tactile_kpa: Float32[Tensor, "*batch 320"]
    ) -> Float32[Tensor, "*batch 1 channels"]:
        """Latents; pressures below zero count as zero."""
        roots = root_pressure(tactile_kpa)
        tips = roots[..., :NUM_TIP_TAXELS] / self.tip_scale
        palm = (roots[..., NUM_TIP_TAXELS:] @ self.palm_basis) / self.palm_scale
        return torch.cat([tips, palm], dim=-1)[..., None, :]

    def decode(
        self, latents: Float32[Tensor, "*batch 1 channels"]
    ) -> Float32[Tensor, "*batch 320"]:
        """Pressures in kPa, never below zero."""
        tips = latents[..., 0, :NUM_TIP_TAXELS] * self.tip_scale
        palm = (latents[..., 0, NUM_TIP_TAXELS:] * self.palm_scale) @ self.palm_basis.T
        return torch.cat([tips, palm], dim=-1).clamp_min(0.0).square()
