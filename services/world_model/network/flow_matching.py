"""Flow matching (Lipman et al. 2023): noisy latents for training, and sampling.

Straight paths: x_t = (1 - t) x_0 + t ε, t from 0 (data) to 1 (noise). The network predicts x_0, or
the velocity v = ε - x_0 = (x_t - x_0) / t, whose squared error is that of x_0 over t². The last
step of either solver returns the predicted x_0 exactly.
"""

from collections.abc import Callable
from itertools import islice, pairwise

import torch
from jaxtyping import Float32
from torch import Tensor

from dextouch.errors import InvalidInputError
from services.world_model.network.configuration import Sampler
from services.world_model.network.solvers import SOLVERS

# Lower bound of training times: velocities divide by them.
MIN_TIME = 1e-3
Denoiser = Callable[[Tensor, Tensor, Tensor], tuple[Tensor, Tensor]]


def shift_time(t: Float32[Tensor, " n"], shift: float) -> Float32[Tensor, " n"]:
    """Shift times towards noise: s t / (1 + (s - 1) t); 0 and 1 stay fixed."""
    return shift * t / (1.0 + (shift - 1.0) * t)


def training_times(
    batch: int, *, shift: float, generator: torch.Generator
) -> Float32[Tensor, " batch"]:
    """Random times in (0, 1], biased towards noise, where the actions matter most."""
    return shift_time(torch.rand(batch, generator=generator), shift).clamp_min(MIN_TIME)


def add_noise(
    clean: Float32[Tensor, "batch ..."],
    noise: Float32[Tensor, "batch ..."],
    t: Float32[Tensor, " batch"],
) -> Float32[Tensor, "batch ..."]:
    """x_t = (1 - t) x_0 + t ε; exact at both ends."""
    spread = t.view(-1, *[1] * (clean.ndim - 1))
    return (1.0 - spread) * clean + spread * noise


def implied_noise(
    noisy: Float32[Tensor, "batch ..."],
    clean: Float32[Tensor, "batch ..."],
    t: Float32[Tensor, " batch"],
) -> Float32[Tensor, "batch ..."]:
    """The noise from which `noisy` is on the straight path to `clean`; t > 0."""
    return clean + (noisy - clean) / t.view(-1, *[1] * (clean.ndim - 1))


def velocity(
    clean: Float32[Tensor, "batch ..."], noise: Float32[Tensor, "batch ..."]
) -> Float32[Tensor, "batch ..."]:
    """Velocity of the straight path from data to noise: ε - x_0."""
    return noise - clean


def clean_from_velocity(
    noisy: Float32[Tensor, "batch ..."],
    velocity: Float32[Tensor, "batch ..."],
    t: Float32[Tensor, " batch"],
) -> Float32[Tensor, "batch ..."]:
    """x_0 = x_t - t v."""
    return noisy - t.view(-1, *[1] * (noisy.ndim - 1)) * velocity


def sampling_times(num_steps: int, shift: float) -> Float32[Tensor, " times"]:
    """Times from 1 to 0 of a sampler with this many steps."""
    return shift_time(torch.linspace(1.0, 0.0, num_steps + 1), shift)


def sample(
    denoise: Denoiser,
    noise: tuple[Float32[Tensor, "batch ..."], Float32[Tensor, "batch ..."]],
    *,
    num_steps: int,
    shift: float,
    sampler: Sampler = "euler",
    stop_after: int | None = None,
) -> tuple[Float32[Tensor, "batch ..."], Float32[Tensor, "batch ..."]]:
    """Integrate from noise to data, for both streams at once.

    Args:
        denoise: maps noisy video, noisy touch and times [batch] to predictions of the clean ones.
        noise: initial noise of both streams.
        num_steps: network calls, at least one; with one the sample is the first prediction.
        shift: shift of the time grid.
        sampler: solver, the same for both streams.
        stop_after: steps to take of these, for noisy latents on the way; None for all.
    """
    if num_steps < 1:
        raise InvalidInputError(f"sampling: got {num_steps} steps, expected at least 1")
    video, tactile = noise
    of_video, of_tactile = SOLVERS[sampler](), SOLVERS[sampler]()
    times = sampling_times(num_steps, shift).tolist()
    for t, t_next in islice(pairwise(times), stop_after):
        guess_video, guess_tactile = denoise(
            video, tactile, torch.full((len(video),), t, device=video.device)
        )
        video = of_video.step(video, guess_video, t, t_next)
        tactile = of_tactile.step(tactile, guess_tactile, t, t_next)
    return video, tactile
