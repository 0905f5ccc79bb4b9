"""Moving average of weights and learning-rate schedule, shared by the small networks."""

import math

import torch
from torch import nn

_WARMUP_STEPS = 100


class WeightAverage:
    """Exponential moving average of a network's weights, with a shorter memory at first.

    Args:
        network: its current weights initialize the average.
        decay: decay after many updates, such as 0.995.
    """

    def __init__(self, network: nn.Module, decay: float) -> None:
        self._decay, self._num_updates = decay, 0
        self._weights = {name: value.clone() for name, value in network.state_dict().items()}

    @torch.no_grad()
    def update(self, network: nn.Module) -> None:
        """Update the average with the current weights."""
        self._num_updates += 1
        decay = min(self._decay, (1 + self._num_updates) / (10 + self._num_updates))
        for name, value in network.state_dict().items():
            self._weights[name].lerp_(value, 1 - decay)

    def copy_to(self, network: nn.Module) -> None:
        """Overwrite a network's weights with the average."""
        network.load_state_dict(self._weights)


def cosine_rate(peak: float, step: int, num_steps: int) -> float:
    """Learning rate of a step: linear warm-up, then half a cosine down to a hundredth."""
    warm = min(1.0, (step + 1) / _WARMUP_STEPS)
    return peak * warm * (0.01 + 0.99 * 0.5 * (1 + math.cos(math.pi * step / num_steps)))
