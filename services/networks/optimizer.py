"""Optimizer loop: AdamW, a cosine schedule, clipped gradients, and limits of time and steps."""

import math
import time
from collections.abc import Callable, Iterable, Iterator
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
    `max_gradient_norm` are clipped.
    """

    learning_rate: float
    weight_decay: float
    max_gradient_norm: float = 1.0
    warmup_steps: int = 1
    schedule: Callable[[float], float] = half_cosine
    betas: tuple[float, float] = (0.9, 0.999)
    fused: bool = True

    def rate(self, step: int, share: float) -> float:
        """Learning rate of a step, counted from 0, after some share of the run."""
        warmup = min(1.0, (step + 1) / self.warmup_steps)
        return self.learning_rate * warmup * self.schedule(share)


class Budget:
    """Completed steps, CPU and wall seconds of a run; it ends when one of them reaches its limit.

    With `paced_by_steps` the schedule follows the steps alone, where these have a limit.
    """

    def __init__(
        self,
        max_cpu_s: float = math.inf,
        max_steps: int | None = None,
        max_wall_s: float = math.inf,
        *,
        paced_by_steps: bool = False,
    ) -> None:
        self._max_cpu_s, self._max_steps, self._max_wall_s = max_cpu_s, max_steps, max_wall_s
        self._paced_by_steps = paced_by_steps
        self.step = 0
        self.cpu_s = self.wall_s = 0.0
        self.start()

    def start(self) -> None:
        """Count seconds from now on, in addition to `cpu_s` and `wall_s`."""
        self._start_s = time.process_time() - self.cpu_s
        self._start_wall_s = time.monotonic() - self.wall_s

    def advance(self) -> None:
        """Complete a step."""
        self.step += 1
        self.cpu_s = time.process_time() - self._start_s
        self.wall_s = time.monotonic() - self._start_wall_s

    def share(self) -> float:
        """Completed fraction of the run, by the tightest of the limits."""
        by_time = max(self.cpu_s / self._max_cpu_s, self.wall_s / self._max_wall_s)
        return max(by_time, self._share_of_steps())

    def schedule_share(self) -> float:
        """Completed fraction that the learning rate follows."""
        is_by_steps = self._paced_by_steps and self._max_steps is not None
        return self._share_of_steps() if is_by_steps else self.share()

    def _share_of_steps(self) -> float:
        return 0.0 if self._max_steps is None else self.step / self._max_steps

    @contextmanager
    def paused(self) -> Iterator[None]:
        """Do not count the seconds of the block."""
        begin_s, begin_wall_s = time.process_time(), time.monotonic()
        yield
        self._start_s += time.process_time() - begin_s
        self._start_wall_s += time.monotonic() - begin_wall_s


class OptimizerLoop:
    """Training of one network until its budget is used up; weights without gradient stay."""

    def __init__(self, network: nn.Module, options: OptimizerOptions, budget: Budget) -> None:
        self.options, self.budget = options, budget
        self._network = network
        self.optimizer = torch.optim.AdamW(
            learned_weights(network).values(),
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

    def learn(self, loss: Tensor) -> None:
        """Take one step down the gradient of a loss; the budget does not advance.

        Raises NonFiniteError for gradients that are NaN or infinite.
        """
        self.optimizer.zero_grad()
        torch.autograd.backward(loss)
        self.step(loss=loss)

    def step(self, **losses: Tensor) -> None:
        """Take one step down the gradients that the weights have; errors show the losses."""
        for group in self.optimizer.param_groups:
            group["lr"] = self.options.rate(self.budget.step, self.budget.schedule_share())
        weights, most = self._network.parameters(), self.options.max_gradient_norm
        if not torch.isfinite(nn.utils.clip_grad_norm_(weights, most)):
            values = ", ".join(f"{name} {one.item():.3g}" for name, one in losses.items())
            raise NonFiniteError(
                f"training: gradients of step {self.budget.step} of "
                f"{type(self._network).__name__} are NaN or infinite ({values}), expected finite "
                "ones; no weight was changed: look for NaN in the episodes, or lower the learning "
                "rate"
            )
        self.optimizer.step()


def learned_weights(network: nn.Module) -> dict[str, nn.Parameter]:
    """The weights that need gradients, by name."""
    return {name: weight for name, weight in network.named_parameters() if weight.requires_grad}


@torch.no_grad()
def update_average(
    averaged: Iterable[Tensor], weights: Iterable[Tensor], *, decay: float, num_updates: int
) -> None:
    """Move averaged weights towards those of a network (exponential moving average).

    The decay is reached after many updates: with few before this one the memory is shorter, so that
    short runs do not keep the initial weights.
    """
    decay = min(decay, (1 + num_updates) / (10 + num_updates))
    for mean, weight in zip(averaged, weights, strict=True):
        mean.lerp_(weight, 1.0 - decay)
