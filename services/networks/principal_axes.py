"""Principal axes from second moments: an orthonormal basis with fixed signs, and its scales."""

import numpy as np
import torch
from jaxtyping import Float32, Float64
from torch import Tensor

# No channel is scaled up by more than sqrt(1 / this) relative to the strongest one.
MIN_RELATIVE_SCALE = 1e-3


def principal_axes(
    second_moment: Float64[Tensor, "dim dim"], num_channels: int
) -> tuple[Float32[Tensor, "dim channels"], Float32[Tensor, " channels"]]:
    """Strongest eigenvectors, strongest first, and the root mean square along each.

    Each vector's largest entry is made positive, so that equal data give an equal basis.
    """
    # Of data that touch few taxels, whose other rows are zero, torch's solver (MKL) can fail.
    values, vectors = map(torch.from_numpy, np.linalg.eigh(second_moment.numpy()))
    basis = vectors[:, -num_channels:].flip(1)
    largest = basis.abs().argmax(dim=0)
    signs = torch.sign(basis[largest, torch.arange(num_channels)])
    rms = values[-num_channels:].flip(0).clamp_min(0).sqrt()
    return (basis * signs).float(), rms.float()


def root_scale(rms: Float32[Tensor, " channels"]) -> Float32[Tensor, " channels"]:
    """Divisors that give channel c the amplitude sqrt(rms_c / rms_0).

    Full whitening would give the weakest channels, mostly noise, as much weight as the strongest;
    without whitening the strongest would dominate.
    """
    strongest = rms[0].clamp_min(1e-6)
    return torch.sqrt((rms / strongest).clamp_min(MIN_RELATIVE_SCALE)) * strongest


def root_pressure(tactile_kpa: Float32[Tensor, "..."]) -> Float32[Tensor, "..."]:
    """Square root of pressures; negative ones count as zero."""
    return tactile_kpa.clamp_min(0.0).sqrt()
