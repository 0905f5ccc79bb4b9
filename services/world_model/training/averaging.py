"""Training loop of start readers and recurrent cores, which keeps their averaged weights."""

import copy
from collections.abc import Callable
from typing import TypeVar

from torch import Tensor, nn

from services.networks.optimizer import (
    Budget,
    OptimizerLoop,
    OptimizerOptions,
    half_cosine,
    update_average,
)
from services.world_model.settings import CoreSettings, ReaderSettings

_WARMUP_STEPS = 100
OnStep = Callable[[int, float], None]
Network = TypeVar("Network", bound=nn.Module)


def train_averaged(
    network: Network,
    loss: Callable[[], Tensor],
    settings: ReaderSettings | CoreSettings,
    *,
    weight_decay: float,
    on_step: OnStep | None = None,
) -> Network:
    """Train a network and return it with the moving average of its weights.

    Args:
        network: its weights are changed.
        loss: loss of a fresh batch.
        settings: number of steps, learning rate and decay of the average.
        weight_decay: AdamW weight decay.
        on_step: called with the step and its loss.
    """
    options = OptimizerOptions(
        settings.learning_rate, weight_decay, warmup_steps=_WARMUP_STEPS, schedule=_to_a_hundredth
    )
    budget = Budget(max_steps=settings.num_steps)
    averaged = copy.deepcopy(network)
    for value in OptimizerLoop(network, options, budget).run(loss):
        # Begins with a longer memory than that of a first update.
        update_average(averaged, network, decay=settings.ema_decay, num_updates=budget.step)
        if on_step is not None:
            on_step(budget.step, value)
    return averaged.eval()


def _to_a_hundredth(share: float) -> float:
    """Half a cosine from 1 down to 0.01."""
    return 0.01 + 0.99 * half_cosine(share)
