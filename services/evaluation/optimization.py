"""Training loop of networks of the evaluation, with a progress bar."""

from collections.abc import Callable, Iterator
from types import TracebackType
from typing import Protocol, runtime_checkable

import torch
from rich.console import Console
from rich.progress import BarColumn, TextColumn, TimeRemainingColumn
from rich.progress import Progress as RichProgress
from torch import Tensor, nn

from dextouch.command_line import ProgressLines
from services.networks.optimizer import Budget, OptimizerLoop, OptimizerOptions

# Progress of a long job on standard error: a bar on a terminal, lines elsewhere.


class Progress:
    """A progress bar on a terminal; elsewhere a line at every tenth and every few seconds.

    Args:
        title: name of the job.
        total: number of steps.
    """

    def __init__(self, title: str, total: int) -> None:
        console = Console(stderr=True)
        self._lines = ProgressLines(title)
        self._total, self._done = total, 0
        columns = (
            TextColumn(title),
            BarColumn(),
            TextColumn("{task.fields[text]}"),
            TimeRemainingColumn(),
        )
        self._bar = RichProgress(*columns, console=console, disable=not console.is_terminal)
        self._task = self._bar.add_task(title, total=total, text="")

    def __enter__(self) -> "Progress":
        self._bar.start()
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        self._bar.stop()

    def advance(self, **figures: float) -> None:
        """Complete one step; the figures are shown beside the bar."""
        text = "  ".join(f"{name} {value:.3g}" for name, value in figures.items())
        self._bar.update(self._task, advance=1, text=text)
        tenths = self._done * 10 // self._total
        self._done += 1
        is_tenth = self._done * 10 // self._total > tenths
        self._lines.show(f"{self._done} of {self._total}  {text}", is_last=is_tenth)


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
