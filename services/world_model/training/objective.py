"""Training losses: flow matching of video and tactile latents."""

from dataclasses import dataclass

import torch
from jaxtyping import Float32
from torch import Tensor

from services.world_model.network.flow_matching import add_noise, training_times
from services.world_model.network.inputs import ModelInputs
from services.world_model.network.model import FirstLatents, JointLatents, JointWorldModel
from services.world_model.training.dataset import WindowBatch


@dataclass(frozen=True)
class Losses:
    """Mean squared errors of the predicted residuals, in units of their variance."""

    video: Float32[Tensor, ""]
    tactile: Float32[Tensor, ""]


def losses(
    model: JointWorldModel,
    inputs: ModelInputs,
    batch: WindowBatch,
    *,
    generator: torch.Generator,
    context_noise: float = 0.0,
) -> Losses:
    """x_0-prediction errors at random times, with equal weight for every tactile token.

    The paper weights only tokens in contact or changing, so that idle pads are never trained. With
    equal weights the model also learns to predict the absence of contact.

    Args:
        model: the network.
        inputs: from `build_inputs` of the batch's requests.
        batch: the true windows.
        generator: source of times and noise.
        context_noise: relative deviation of noise on the first latents, which makes the model
            robust to starting from its own output.
    """
    target = model.residuals(batch.images, batch.tactile_kpa)
    first = _with_noise(model.first_latents(inputs), context_noise, generator)
    t = training_times(len(inputs), shift=model.config.training_time_shift, generator=generator)
    noisy = JointLatents(
        add_noise(target.video, torch.randn(target.video.shape, generator=generator), t),
        add_noise(target.tactile, torch.randn(target.tactile.shape, generator=generator), t),
    )
    guess = model(inputs, first, noisy, t)
    video = (guess.video - target.video)[:, 1:].square().mean()
    valid = (batch.tactile_valid & batch.tactile_valid[:, :1])[:, 1:, :, None, None].float()
    error = (guess.tactile - target.tactile)[:, 1:].square() * valid
    tactile = error.sum() / (valid.sum() * error.shape[-2:].numel()).clamp_min(1.0)
    return Losses(video, tactile)


def _with_noise(
    first: FirstLatents, context_noise: float, generator: torch.Generator
) -> FirstLatents:
    if context_noise == 0.0:
        return first

    def shaken(latents: Tensor) -> Tensor:
        # A random amount for each window, from none to the full share.
        amount = torch.rand(len(latents), *[1] * (latents.ndim - 1), generator=generator)
        noise = torch.randn(latents.shape, generator=generator)
        return latents + context_noise * amount * latents.std() * noise

    return FirstLatents(shaken(first.video), shaken(first.tactile))
