"""Training losses: flow matching of video and tactile latents, and self-forcing.

Self-forcing (Huang et al. 2025) trains on the model's own samples, as at deployment: contexts of
half the batches are predicted, and noisy latents are those that the sampler reaches. Consistency
training (Song and Dhariwal 2023) instead asks for the same end from all times of a path.
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import Any, Literal

import torch
from jaxtyping import Bool, Float32
from torch import Tensor
from torch.nn import functional

from dextouch.errors import InvalidInputError
from dextouch.hands.actions import poses_from_actions, reanchor
from dextouch.tactile import CONTACT_THRESHOLD_KPA
from dextouch.tactile.layout import DEXTOUCH_V1, TactileLayout
from services.world_model.dynamics.tensor_trees import combined, mapped
from services.world_model.network.codecs import to_uint8
from services.world_model.network.configuration import Precision
from services.world_model.network.flow_matching import (
    MIN_TIME,
    add_noise,
    clean_from_velocity,
    implied_noise,
    sampling_times,
    training_times,
)
from services.world_model.network.inputs import ModelInputs, PredictionRequest, build_inputs
from services.world_model.network.model import (
    FirstLatents,
    JointLatents,
    JointWorldModel,
    Sampling,
    products_in,
)
from services.world_model.training.distribution import ALONE, Processes
from services.world_model.training.joint_dataset import WindowBatch

TouchLoss = Literal["all", "contact_or_changing"]
# A taxel that differs by this much from the step before is changing.
CHANGE_KPA = 0.5
OWN_CONTEXT_SHARE = 0.5


@dataclass(frozen=True)
class Losses:
    """Mean squared errors of the prediction, in units of the latents' variance."""

    video: Float32[Tensor, ""]
    tactile: Float32[Tensor, ""]


@dataclass(frozen=True)
class LossOptions:
    """Options of the losses.

    `context_noise` is the relative deviation of noise on the first latents. Of tactile tokens count
    `touch_loss`: all, or those in contact or changing, as in the paper. `precision` is that of the
    experts' matrix products. With `own_noisy`, noisy latents are those of the model's own sampler.
    With `consistency_steps`, the target is what the model itself predicts from the same path one
    such step earlier, recorded latents at its end. `text_dropout` and `action_dropout` are shares
    of windows; the smaller one is without both.
    """

    context_noise: float = 0.0
    touch_loss: TouchLoss = "all"
    precision: Precision = "float32"
    own_noisy: bool = False
    consistency_steps: int | None = None
    text_dropout: float = 0.0
    action_dropout: float = 0.0


@dataclass(frozen=True)
class Examples:
    """What the network is given for some windows, what it should answer, and how that counts.

    `counted` weighs errors of tactile tokens, 0 of those of which nothing was measured;
    `num_counted` is their sum over the windows of a step, per process; `share` is that of these
    windows.
    """

    inputs: ModelInputs
    first: FirstLatents
    noisy: JointLatents
    t: Float32[Tensor, " batch"]
    target: JointLatents
    counted: Float32[Tensor, "batch steps 2 tokens 1"]
    num_counted: Float32[Tensor, ""]
    share: float = 1.0

    def parts(self, count: int) -> Iterator["Examples"]:
        """The windows in equal parts, whose losses sum to that of all."""
        size = len(self.t) // count
        for start in range(0, len(self.t), size):
            rows = torch.arange(start, start + size, device=self.t.device)
            own: dict[str, Any] = {
                name: mapped(getattr(self, name), partial(torch.index_select, dim=0, index=rows))
                for name in ("first", "noisy", "t", "target", "counted")
            }
            inputs, share = self.inputs.rows(rows.tolist()), self.share / count
            yield replace(self, **own, inputs=inputs, share=share)


def examples_of(
    model: JointWorldModel,
    batch: WindowBatch,
    *,
    generator: torch.Generator,
    options: LossOptions = LossOptions(),
    processes: Processes = ALONE,
    num_parts: int = 1,
) -> Examples:
    """Windows of this process with random times and noise; images are encoded in `num_parts`."""
    device = model.device
    inputs = model.with_past(build_inputs(batch.requests, model.config).to(device))
    if options.text_dropout or options.action_dropout:
        drawn = processes.rand([len(inputs)], generator).to(device)
        inputs = inputs.without(drawn < options.text_dropout, drawn < options.action_dropout)
    tactile_kpa = batch.tactile_kpa.to(device)
    further = [None] * num_parts if batch.further is None else batch.further.chunk(num_parts)
    encoded = [
        model.targets(images.to(device), felt, None if views is None else views.to(device))
        for images, felt, views in zip(
            batch.images.chunk(num_parts), tactile_kpa.chunk(num_parts), further, strict=True
        )
    ]
    clean = combined(encoded, torch.cat)
    first = _with_noise(model.first_latents(inputs), options.context_noise, generator, processes)
    num_windows, shift = len(inputs) * processes.count, model.config.training_time_shift
    t = processes.own(training_times(num_windows, shift=shift, generator=generator)).to(device)
    noise = mapped(clean, lambda one: processes.randn(one.shape, generator).to(device))
    if options.own_noisy:
        noisy, t = own_noisy(model, inputs, first, noise, generator)
        noise = combined([noisy, clean], lambda pair: implied_noise(pair[0], pair[1], t))
    else:
        noisy = combined([clean, noise], lambda pair: add_noise(pair[0], pair[1], t))
    if options.consistency_steps is not None:
        earlier = (t - 1.0 / options.consistency_steps).clamp_min(0.0)
        with products_in(options.precision, device.type):
            clean = own_ends(model, inputs, first, clean, noise, earlier)
        noise = combined([noisy, clean], lambda pair: implied_noise(pair[0], pair[1], t))
    target = clean
    if model.config.prediction == "velocity":
        # Of the straight path from data to noise.
        target = combined([noise, clean], lambda pair: pair[0] - pair[1])
    valid = batch.tactile_valid.to(device)
    num_tokens, layout = clean.tactile.shape[3], model.config.tactile_layout
    is_measured = in_tokens(batch.measured_taxels.to(device)[:, None], num_tokens, layout)
    counted = (valid & valid[:, :1])[:, 1:, :, None] & is_measured
    if options.touch_loss == "contact_or_changing":
        counted = counted & contact_or_changing(tactile_kpa, num_tokens, layout)[:, 1:]
    weights = counted[..., None].float()
    num_counted = processes.mean(weights.sum())
    return Examples(inputs, first, noisy, t, target, weights, num_counted)


def errors(model: JointWorldModel, examples: Examples, precision: Precision) -> Losses:
    """Losses of examples, which sum over parts to those of a process, whose mean is the batch's."""
    with products_in(precision, examples.t.device.type):
        guess = model(examples.inputs, examples.first, examples.noisy, examples.t)
    target = examples.target
    video_error = (guess.video - target.video)[:, 1:].square()
    if model.config.further_views:
        # Tokens of missing views are right, whatever they are.
        shown = functional.pad(~examples.inputs.missing, (1, 0), value=True)
        counted = shown.repeat_interleave(model.config.tokens_per_latent, dim=1)
        video_error = video_error * counted[:, None, :, None]
    video = video_error.mean() * examples.share
    if not model.config.use_touch:
        return Losses(video, torch.zeros((), device=video.device))
    error = (guess.tactile - target.tactile)[:, 1:].square() * examples.counted
    tactile = error.sum() / (examples.num_counted * error.shape[-1]).clamp_min(1.0)
    return Losses(video, tactile)


def contact_or_changing(
    tactile_kpa: Float32[Tensor, "batch time 2 taxels"],
    num_tokens: int,
    layout: TactileLayout = DEXTOUCH_V1,
) -> Bool[Tensor, "batch time 2 tokens"]:
    """Tokens with a taxel in contact (≥ 2 kPa), now or first, or changing by at least 0.5 kPa."""
    before = torch.cat([tactile_kpa[:, :1], tactile_kpa[:, :-1]], dim=1)
    contact = tactile_kpa >= CONTACT_THRESHOLD_KPA
    taxels = contact | contact[:, :1] | ((tactile_kpa - before).abs() >= CHANGE_KPA)
    return in_tokens(taxels, num_tokens, layout)


def in_tokens(
    taxels: Bool[Tensor, "batch time 2 taxels"], num_tokens: int, layout: TactileLayout
) -> Bool[Tensor, "batch time 2 tokens"]:
    """Tokens of which any taxel is marked; there is one for each pad, or for the hand."""
    if num_tokens == 1:
        return taxels.any(dim=-1, keepdim=True)
    pads = torch.split(taxels, [pad.num_taxels for pad in layout.pads], dim=-1)
    return torch.stack([pad.any(dim=-1) for pad in pads], dim=-1)


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

    return mapped(first, shaken)


def own_context(
    model: JointWorldModel, batch: WindowBatch, *, generator: torch.Generator, processes: Processes
) -> WindowBatch:
    """Windows of one chunk from windows of two: of half the batches the second ones.

    Raises:
        InvalidInputError: a model with contact geometry, further views or past images.
    """
    if model.config.use_contact_geometry:
        raise InvalidInputError(
            "distillation: got a model with contact geometry, expected one without: it would need "
            "the objects as they lie where its own first chunk ends"
        )
    if model.config.further_views or model.config.past_images:
        raise InvalidInputError(
            "distillation: got a model with further views or past images, expected one without: "
            "the views and the past of its own chunks are not there in training"
        )
    middle = len(batch.requests[0].actions) // 2
    firsts = [replace(request, actions=request.actions[: middle + 1]) for request in batch.requests]
    if torch.rand((), generator=generator).item() >= OWN_CONTEXT_SHARE:
        kept = slice(middle + 1)
        return replace(
            batch,
            requests=firsts,
            images=batch.images[:, kept],
            tactile_kpa=batch.tactile_kpa[:, kept],
            tactile_valid=batch.tactile_valid[:, kept],
        )
    noise = mapped(
        model.noise(middle + 1, generator),
        lambda one: processes.randn([len(firsts), *one.shape[1:]], generator),
    )
    inputs = build_inputs(firsts, model.config)
    future = model.predict(inputs, noise, sampling=Sampling(keep_context=False), all_images=False)
    images, touch = to_uint8(future.images[:, -1:]).cpu(), future.tactile_kpa[:, -1:].cpu()
    each = zip(batch.requests, images, touch, strict=True)
    return WindowBatch(
        [_second(request, middle, image[0], felt[0]) for request, image, felt in each],
        torch.cat([images, batch.images[:, middle + 1 :]], dim=1),
        torch.cat([touch, batch.tactile_kpa[:, middle + 1 :]], dim=1),
        batch.tactile_valid[:, middle:],
        batch.measured_taxels,
    )


def _second(
    request: PredictionRequest, middle: int, image: Tensor, touch: Tensor
) -> PredictionRequest:
    """The request of a rollout's second chunk, anchored to the last action of the first."""
    return replace(
        request,
        first_image=image.numpy(),
        first_tactile_kpa=touch.numpy(),
        actions=reanchor(request.actions[middle:], 0),
        anchor=poses_from_actions(request.actions[middle : middle + 1], request.anchor).anchor(0),
    )


@torch.no_grad()
def own_noisy(
    model: JointWorldModel,
    inputs: ModelInputs,
    first: FirstLatents,
    noise: JointLatents,
    generator: torch.Generator,
) -> tuple[JointLatents, Tensor]:
    """Noisy latents and their time at a random step of the model's own sampler (Euler)."""
    num_steps = model.config.sampling_steps
    taken = int(torch.randint(num_steps, (), generator=generator))
    sampling = Sampling(num_steps, "euler", keep_context=False, stop_after=taken)
    noisy = model.sample(inputs, first, noise, sampling)
    times = sampling_times(num_steps, model.config.sampling_time_shift)
    return noisy, times[taken].expand(len(inputs)).to(noisy.video.device)


@torch.no_grad()
def own_ends(
    model: JointWorldModel,
    inputs: ModelInputs,
    first: FirstLatents,
    clean: JointLatents,
    noise: JointLatents,
    t: Float32[Tensor, " batch"],
) -> JointLatents:
    """Clean latents that the model predicts from straight paths at these times; given ones at 0."""
    noisy = combined([clean, noise], lambda pair: add_noise(pair[0], pair[1], t))
    guess = model(inputs, first, noisy, t.clamp_min(MIN_TIME))
    if model.config.prediction == "velocity":
        guess = combined([noisy, guess], lambda pair: clean_from_velocity(pair[0], pair[1], t))

    def ends(pair: Sequence[Tensor]) -> Tensor:
        is_end = (t == 0.0).view(-1, *[1] * (pair[0].ndim - 1))
        return torch.where(is_end, pair[0], pair[1])

    return combined([clean, guess], ends)
