"""Training loop of networks of the evaluation, with a progress bar."""

from collections.abc import Callable, Iterator
from typing import Protocol, runtime_checkable

import torch
from torch import Tensor, nn

from services.evaluation.progress import Progress
from services.networks.optimizer import Budget, OptimizerLoop, OptimizerOptions


@runtime_checkable
class RateSettings(Protocol):
    """Settings that every training of this service has."""

    @property
    def seed(self) -> int:
        """Seed of weights and sampling."""

    @property
    def learning_rate(self) -> float:
        """Peak of the cosine schedule."""

    @property
    def weight_decay(self) -> float:
        """AdamW weight decay."""


def optimized(
    network: nn.Module,
    loss: Callable[[torch.Generator], Tensor],
    settings: RateSettings,
    *,
    limits: tuple[int, float],
    title: str,
    max_gradient_norm: float | None = 1.0,
) -> Iterator[Budget]:
    """Train a network; yields the used budget after each step.

    Args:
        network: module to train.
        loss: loss of a batch drawn with the generator.
        settings: seed, learning rate and weight decay.
        limits: largest number of steps, and CPU seconds.
        title: name beside the progress bar.
        max_gradient_norm: norm that gradients are clipped to; None: not clipped.
    """
    num_steps, max_cpu_s = limits
    generator = torch.Generator().manual_seed(settings.seed)
    budget = Budget(max_cpu_s, num_steps)
    options = OptimizerOptions(
        settings.learning_rate, settings.weight_decay, max_gradient_norm, fused=False
    )
    network.train()
    with Progress(title, num_steps) as progress:
        for value in OptimizerLoop(network, options, budget).run(lambda: loss(generator)):
            progress.advance(loss=value)
            yield budget
