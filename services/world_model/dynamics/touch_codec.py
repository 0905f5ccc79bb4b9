"""Linear codec of a hand's taxels for the core: principal axes of the root of pressure."""

import torch
from jaxtyping import Float32
from torch import Tensor, nn

from dextouch.tactile.layout import NUM_TAXELS
from services.networks.principal_axes import principal_axes, root_pressure

# Pads with a lower peak pressure count as free when contact is learned.
FREE_KPA = 2.0


class TouchCodec(nn.Module):
    """Frozen encoder and decoder of one hand's taxels, the same for left and right.

    Latents are in units of the strongest axis' amplitude, so that their squared error is
    proportional to that of the root of pressure. Decoded pressure is bounded by `peak_kpa`, the
    highest pressure in training.
    """

    basis: Tensor
    scale: Tensor
    peak_kpa: Tensor

    def __init__(self, num_channels: int) -> None:
        super().__init__()
        self.register_buffer("basis", torch.eye(NUM_TAXELS, num_channels))
        self.register_buffer("scale", torch.ones(()))
        self.register_buffer("peak_kpa", torch.full((), 1e3))

    @torch.no_grad()
    def fit(self, tactile_kpa: Float32[Tensor, "n 320"], *, peak_kpa: float | None = None) -> None:
        """Fit axes, scale and peak to training touch of single hands.

        Args:
            tactile_kpa: sample of the training data.
            peak_kpa: highest pressure of all training data; None uses that of the sample.
        """
        roots = root_pressure(tactile_kpa).double()
        # Not centred: the mean touch is not a touch that occurs.
        basis, rms = principal_axes(roots.T @ roots / len(roots), self.basis.shape[1])
        self.basis.copy_(basis)
        self.scale.copy_(rms[0].clamp_min(1e-3))
        peak = float(tactile_kpa.max()) if peak_kpa is None else peak_kpa
        self.peak_kpa.fill_(max(peak, FREE_KPA))

    def encode(self, tactile_kpa: Float32[Tensor, "*b 320"]) -> Float32[Tensor, "*b channels"]:
        """Latents; pressures are clipped to 0 … peak."""
        bounded = torch.minimum(tactile_kpa, self.peak_kpa)
        return (root_pressure(bounded) @ self.basis) / self.scale

    def decode(self, latents: Float32[Tensor, "*b channels"]) -> Float32[Tensor, "*b 320"]:
        """Pressures in kPa between zero and the peak."""
        roots = ((latents * self.scale) @ self.basis.T).clamp_min(0.0)
        return torch.minimum(roots.square(), self.peak_kpa)
