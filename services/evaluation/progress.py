"""Progress of a long job on standard error: a bar on a terminal, a line per tenth elsewhere."""

from types import TracebackType

from rich.console import Console
from rich.progress import BarColumn, TextColumn, TimeRemainingColumn
from rich.progress import Progress as RichProgress


class Progress:
    """A progress bar on a terminal; elsewhere (a log, a pipe) a line at every tenth.

    Args:
        title: name of the job.
        total: number of steps.
    """

    def __init__(self, title: str, total: int) -> None:
        self._console = console = Console(stderr=True)
        self._title, self._total, self._done = title, total, 0
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
        if not self._console.is_terminal and self._done * 10 // self._total > tenths:
            self._console.print(
                f"   {self._title} {self._done} of {self._total}  {text}".rstrip(),
                highlight=False,
            )
