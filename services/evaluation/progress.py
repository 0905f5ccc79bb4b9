"""Steps of a long job in; a progress bar on a terminal, silence elsewhere."""

from types import TracebackType

from rich.console import Console
from rich.progress import BarColumn, TextColumn, TimeRemainingColumn
from rich.progress import Progress as RichProgress


class Progress:
    """A progress bar on standard error, drawn only when a person is looking.

    Args:
        title: what is going on.
        total: number of steps.
    """

    def __init__(self, title: str, total: int) -> None:
        console = Console(stderr=True)
        columns = (
            TextColumn(title),
            BarColumn(),
            TextColumn("{task.fields[told]}"),
            TimeRemainingColumn(),
        )
        self._bar = RichProgress(*columns, console=console, disable=not console.is_terminal)
        self._task = self._bar.add_task(title, total=total, told="")

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
        """One step is done; the figures are shown beside the bar."""
        told = "  ".join(f"{name} {value:.3g}" for name, value in figures.items())
        self._bar.update(self._task, advance=1, told=told)
