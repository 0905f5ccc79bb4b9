"""Optimizer loop: AdamW, a cosine schedule, clipped gradients, and limits of CPU time and steps."""

import math
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass

import torch
from torch import Tensor, nn

from dextouch.errors import NonFiniteError


def half_cosine(share: float) -> float:
    """Half a cosine from 1 at the start of a run to 0 at its end."""
    return 0.5 * (1.0 + math.cos(math.pi * min(share, 1.0)))


def floored_cosine(share: float) -> float:
    """`half_cosine`, but at least 0.01."""
    return max(half_cosine(share), 0.01)


@dataclass(frozen=True)
class OptimizerOptions:
    """AdamW whose learning rate warms up linearly to its peak, scaled by a schedule.

    `schedule` maps the completed share of a run to a factor. Gradients longer than
    `max_gradient_norm` are clipped; None neither clips nor checks them.
    """

    learning_rate: float
    weight_decay: float
    max_gradient_norm: float | None = 1.0
    warmup_steps: int = 1
    schedule: Callable[[float], float] = half_cosine
    betas: tuple[float, float] = (0.9, 0.999)
    fused: bool = True

    def rate(self, step: int, share: float) -> float:
        """Learning rate of a step, counted from 0, after some share of the run."""
        warmup = min(1.0, (step + 1) / self.warmup_steps)
        return self.learning_rate * warmup * self.schedule(share)


class Budget:
    """Completed steps and CPU seconds of a run; it ends when either reaches its limit.

    Args:
        max_cpu_s: limit of CPU seconds.
        max_steps: limit of steps; None for no limit.
    """

    def __init__(self, max_cpu_s: float = math.inf, max_steps: int | None = None) -> None:
        self._max_cpu_s, self._max_steps = max_cpu_s, max_steps
        self.step = 0
        self.cpu_s = 0.0
        self.start()

    def start(self) -> None:
        """Count CPU seconds from now on, in addition to `cpu_s`."""
        self._start_s = time.process_time() - self.cpu_s

    def advance(self) -> None:
        """Complete a step."""
        self.step += 1
        self.cpu_s = time.process_time() - self._start_s

    def share(self) -> float:
        """Completed fraction of the run, by the tighter of the two limits."""
        by_time = self.cpu_s / self._max_cpu_s
        return by_time if self._max_steps is None else max(by_time, self.step / self._max_steps)

    @contextmanager
    def paused(self) -> Iterator[None]:
        """Do not count the CPU seconds of the block."""
        begin_s = time.process_time()
        yield
        self._start_s += time.process_time() - begin_s


class OptimizerLoop:
    """Training of one network until its budget is used up.

    Args:
        network: network whose weights are changed.
        options: learning rate, weight decay and so on.
        budget: limits of the run.
    """

    def __init__(self, network: nn.Module, options: OptimizerOptions, budget: Budget) -> None:
        self.options, self.budget = options, budget
        self._network = network
        self.optimizer = torch.optim.AdamW(
            network.parameters(),
            lr=options.learning_rate,
            weight_decay=options.weight_decay,
            betas=options.betas,
            fused=options.fused,
        )

    def run(self, loss: Callable[[], Tensor]) -> Iterator[float]:
        """Take steps until the budget is used up; yields the loss of each after it was taken."""
        self.budget.start()
        while self.budget.share() < 1.0:
            value = loss()
            self.learn(value)
            self.budget.advance()
            yield value.item()

    def learn(self, loss: Tensor, **parts: Tensor) -> None:
        """Take one step down the gradient of a loss; the budget does not advance.

        Args:
            loss: scalar to reduce.
            parts: losses that error messages name beside it.

        Raises:
            NonFiniteError: gradients that are NaN or infinite.
        """
        for group in self.optimizer.param_groups:
            group["lr"] = self.options.rate(self.budget.step, self.budget.share())
        self.optimizer.zero_grad()
        torch.autograd.backward(loss)
        if self.options.max_gradient_norm is not None:
            norm = nn.utils.clip_grad_norm_(
                self._network.parameters(), self.options.max_gradient_norm
            )
            if not torch.isfinite(norm):
                terms = {"loss": loss, **parts}
                values = ", ".join(f"{name} {one.item():.3g}" for name, one in terms.items())
                raise NonFiniteError(
                    f"training: gradients of step {self.budget.step} of "
                    f"{type(self._network).__name__} are NaN or infinite ({values}), expected "
                    "finite ones; no weight was changed: look for NaN in the episodes, or lower "
                    "the learning rate"
                )
        self.optimizer.step()


@torch.no_grad()
def update_average(
    averaged: nn.Module, network: nn.Module, *, decay: float, num_updates: int
) -> None:
    """Move averaged weights towards those of a network (exponential moving average).

    Its memory is shorter at first, so that short runs do not keep the initial weights. Buffers stay
    as they are.

    Args:
        averaged: a network of the same shape.
        network: its weights are added.
        decay: decay after many updates, such as 0.995.
        num_updates: number of updates before this one.
    """
    decay = min(decay, (1 + num_updates) / (10 + num_updates))
    for mean, weight in zip(averaged.parameters(), network.parameters(), strict=True):
        mean.lerp_(weight, 1.0 - decay)
