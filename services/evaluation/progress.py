"""Steps of a long job in; a progress bar on a terminal, silence elsewhere."""

import sys
from types import TracebackType


class Progress:
    """A one-line progress bar on standard error, drawn only when a person is looking.

    Args:
        title: what is going on.
        total: number of steps.
    """

    def __init__(self, title: str, total: int) -> None:
        self.title = title
        self.total = total
        self.done = 0
        self._shown_percent = -1
        self._visible = sys.stderr.isatty()

    def __enter__(self) -> "Progress":
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        if self._visible:
            sys.stderr.write("\n")

    def advance(self, **figures: float) -> None:
        """One step is done; the figures are shown beside the bar."""
        self.done += 1
        percent = 100 * self.done // self.total
        if not self._visible or percent == self._shown_percent:
            return
        self._shown_percent = percent
        bar = "█" * (percent // 4) + "·" * (25 - percent // 4)
        told = " ".join(f"{name} {value:.3g}" for name, value in figures.items())
        sys.stderr.write(f"\r{self.title} {bar} {percent:3d} % {told}   ")
        sys.stderr.flush()
