"""Training losses: flow matching of video and tactile latents."""

from dataclasses import dataclass
from typing import Literal

import torch
from jaxtyping import Bool, Float32
from torch import Tensor

from dextouch.tactile import CONTACT_THRESHOLD_KPA
from dextouch.tactile.layout import NUM_TIP_TAXELS
from services.world_model.network.attention import split_axis
from services.world_model.network.configuration import Precision
from services.world_model.network.flow_matching import (
    add_noise,
    implied_noise,
    training_times,
    velocity,
)
from services.world_model.network.inputs import build_inputs
from services.world_model.network.model import (
    FirstLatents,
    JointLatents,
    JointWorldModel,
    products_in,
)
from services.world_model.training.dataset import WindowBatch
from services.world_model.training.distribution import ALONE, Processes
from services.world_model.training.self_forcing import own_noisy

TouchLoss = Literal["all", "contact_or_changing"]
# A taxel that differs by this much from the step before is changing.
CHANGE_KPA = 0.5


@dataclass(frozen=True)
class Losses:
    """Mean squared errors of the prediction, in units of the latents' variance."""

    video: Float32[Tensor, ""]
    tactile: Float32[Tensor, ""]


@dataclass(frozen=True)
class LossOptions:
    """Options of the losses.

    `context_noise` is the relative deviation of noise on the first latents, which makes the model
    robust to starting from its own output. `touch_loss` says which tactile tokens count: all of
    them, so that the model also learns to predict the absence of contact, or only those in contact
    or changing, as in the paper. `precision` is that of the experts' matrix products. With
    `own_noisy`, noisy latents are those that the model's own sampler reaches.
    """

    context_noise: float = 0.0
    touch_loss: TouchLoss = "all"
    precision: Precision = "float32"
    own_noisy: bool = False


def losses(
    model: JointWorldModel,
    batch: WindowBatch,
    *,
    generator: torch.Generator,
    options: LossOptions = LossOptions(),
    processes: Processes = ALONE,
) -> Losses:
    """Errors of the prediction at random times.

    Args:
        model: the network.
        batch: the true windows.
        generator: source of times and noise.
        options: what counts, and in which precision.
        processes: processes whose batches together are the whole one; losses are this process's
            contributions to it, which have the whole one's loss as their mean.
    """
    device = model.device
    inputs = build_inputs(batch.requests, model.config).to(device)
    tactile_kpa = batch.tactile_kpa.to(device)
    clean = model.targets(batch.images.to(device), tactile_kpa)
    first = _with_noise(model.first_latents(inputs), options.context_noise, generator, processes)
    num_windows, shift = len(inputs) * processes.count, model.config.training_time_shift
    t = processes.own(training_times(num_windows, shift=shift, generator=generator)).to(device)
    noise = JointLatents(
        processes.randn(clean.video.shape, generator).to(device),
        processes.randn(clean.tactile.shape, generator).to(device),
    )
    if options.own_noisy:
        noisy, t = own_noisy(model, inputs, first, noise, generator)
        noise = JointLatents(
            implied_noise(noisy.video, clean.video, t),
            implied_noise(noisy.tactile, clean.tactile, t),
        )
    else:
        noisy = JointLatents(
            add_noise(clean.video, noise.video, t), add_noise(clean.tactile, noise.tactile, t)
        )
    target = clean
    if model.config.prediction == "velocity":
        target = JointLatents(
            velocity(clean.video, noise.video), velocity(clean.tactile, noise.tactile)
        )
    with products_in(options.precision, device.type):
        guess = model(inputs, first, noisy, t)
    video = (guess.video - target.video)[:, 1:].square().mean()
    if not model.config.use_touch:
        return Losses(video, torch.zeros((), device=device))
    valid = batch.tactile_valid.to(device)
    counted = (valid & valid[:, :1])[:, 1:, :, None]
    if options.touch_loss == "contact_or_changing":
        tokens = contact_or_changing(tactile_kpa, clean.tactile.shape[3])
        counted = counted & tokens[:, 1:]
    weights = counted[..., None].float().expand(-1, -1, -1, clean.tactile.shape[3], -1)
    error = (guess.tactile - target.tactile)[:, 1:].square() * weights
    tactile = error.sum() / (processes.mean(weights.sum()) * error.shape[-1]).clamp_min(1.0)
    return Losses(video, tactile)


def contact_or_changing(
    tactile_kpa: Float32[Tensor, "batch time 2 320"], num_tokens: int
) -> Bool[Tensor, "batch time 2 tokens"]:
    """Tokens with a taxel in contact, at this or the first step, or changing since the last step.

    In contact: at least 2 kPa; changing: by at least 0.5 kPa. With six tokens these are those of
    the five fingertips and the palm, with one that of the whole hand.
    """
    before = torch.cat([tactile_kpa[:, :1], tactile_kpa[:, :-1]], dim=1)
    contact = tactile_kpa >= CONTACT_THRESHOLD_KPA
    taxels = contact | contact[:, :1] | ((tactile_kpa - before).abs() >= CHANGE_KPA)
    if num_tokens == 1:
        return taxels.any(dim=-1, keepdim=True)
    tips = split_axis(taxels[..., :NUM_TIP_TAXELS], -1, (num_tokens - 1, -1)).any(dim=-1)
    return torch.cat([tips, taxels[..., NUM_TIP_TAXELS:].any(dim=-1, keepdim=True)], dim=-1)


def _with_noise(
    first: FirstLatents, context_noise: float, generator: torch.Generator, processes: Processes
) -> FirstLatents:
    if context_noise == 0.0:
        return first

    def shaken(latents: Tensor) -> Tensor:
        # A random amount for each window, from none to the full share.
        amount = processes.rand([len(latents), *[1] * (latents.ndim - 1)], generator)
        noise = processes.randn(latents.shape, generator).to(latents.device)
        return latents + context_noise * amount.to(noise.device) * processes.std(latents) * noise

    return FirstLatents(shaken(first.video), shaken(first.tactile))
