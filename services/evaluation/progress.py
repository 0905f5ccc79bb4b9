"""Progress of a long job on standard error: a bar on a terminal, lines elsewhere."""

from rich.console import Console
from rich.progress import BarColumn, TextColumn, TimeRemainingColumn
from rich.progress import Progress as RichProgress

from dextouch.command_line import ProgressLines


class Progress:
    """A progress bar on a terminal; elsewhere a line at every tenth and every few seconds."""

    def __init__(self, title: str, total: int) -> None:
        console = Console(stderr=True)
        self._lines = ProgressLines(title)
        self._total, self._done = total, 0
        text = TextColumn("{task.fields[text]}")
        columns = (TextColumn(title), BarColumn(), text, TimeRemainingColumn())
        self._bar = RichProgress(*columns, console=console, disable=not console.is_terminal)
        self._task = self._bar.add_task(title, total=total, text="")

    def __enter__(self) -> "Progress":
        self._bar.start()
        return self

    def __exit__(self, *error: object) -> None:
        self._bar.stop()

    def advance(self, **figures: float) -> None:
        """Complete one step; the figures are shown beside the bar."""
        text = "  ".join(f"{name} {value:.3g}" for name, value in figures.items())
        self._bar.update(self._task, advance=1, text=text)
        tenths = self._done * 10 // self._total
        self._done += 1
        is_tenth = self._done * 10 // self._total > tenths
        self._lines.show(f"{self._done} of {self._total}  {text}", is_last=is_tenth)
