"""Self-forcing: training on the model's own samples, as at deployment (Huang et al. 2025).

A rollout starts every chunk after the first from its own prediction, and a sampler of few steps
calls the network with latents of its own. Training of single windows at random times has seen
neither. Here the context of half the batches is predicted, and noisy latents are those that the
sampler itself reaches; the target is always the recorded future.
"""

from dataclasses import replace

import torch
from torch import Tensor

from dextouch.errors import InvalidInputError
from dextouch.hands.actions import poses_from_actions, reanchor
from services.world_model.network.flow_matching import sampling_times
from services.world_model.network.inputs import ModelInputs, PredictionRequest, build_inputs
from services.world_model.network.model import (
    FirstLatents,
    JointLatents,
    JointWorldModel,
    Sampling,
)
from services.world_model.network.video import to_uint8
from services.world_model.training.dataset import WindowBatch
from services.world_model.training.distribution import Processes

OWN_CONTEXT_SHARE = 0.5


def own_context(
    model: JointWorldModel,
    batch: WindowBatch,
    *,
    generator: torch.Generator,
    processes: Processes,
) -> WindowBatch:
    """Windows of one chunk from windows of two.

    Half of the batches are the second chunks, each with the last image and touch that the model
    predicts for the first chunk; the others are the first chunks.

    Raises:
        InvalidInputError: a model that is conditioned on contact geometry.
    """
    if model.config.use_contact_geometry:
        raise InvalidInputError(
            "distillation: got a model with contact geometry, expected one without: it would need "
            "the objects as they lie where its own first chunk ends"
        )
    middle = len(batch.requests[0].actions) // 2
    firsts = [replace(request, actions=request.actions[: middle + 1]) for request in batch.requests]
    if torch.rand((), generator=generator).item() >= OWN_CONTEXT_SHARE:
        return WindowBatch(
            firsts,
            batch.images[:, : middle + 1],
            batch.tactile_kpa[:, : middle + 1],
            batch.tactile_valid[:, : middle + 1],
        )
    one = model.noise(middle + 1, generator)
    noise = JointLatents(
        processes.randn([len(firsts), *one.video.shape[1:]], generator),
        processes.randn([len(firsts), *one.tactile.shape[1:]], generator),
    )
    inputs = build_inputs(firsts, model.config)
    future = model.predict(inputs, noise, sampling=Sampling(keep_context=False), all_images=False)
    images, touch = to_uint8(future.images[:, -1:]).cpu(), future.tactile_kpa[:, -1:].cpu()
    return WindowBatch(
        [
            _second(request, middle, image[0], felt[0])
            for request, image, felt in zip(batch.requests, images, touch, strict=True)
        ],
        torch.cat([images, batch.images[:, middle + 1 :]], dim=1),
        torch.cat([touch, batch.tactile_kpa[:, middle + 1 :]], dim=1),
        batch.tactile_valid[:, middle:],
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
    sampling = Sampling(num_steps, "euler", keep_context=False)
    noisy = model.sample(inputs, first, noise, sampling, stop_after=taken)
    times = sampling_times(num_steps, model.config.sampling_time_shift)
    return noisy, times[taken].expand(len(inputs)).to(noisy.video.device)
