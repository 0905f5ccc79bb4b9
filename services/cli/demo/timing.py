"""Wall time of the named stages of a run, with progress output."""

import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager


class Stages:
    """Records the wall time of every stage, in order."""

    def __init__(self) -> None:
        self.seconds: dict[str, float] = {}

    @contextmanager
    def stage(self, name: str, what: str) -> Iterator[None]:
        """Context manager that times a stage and prints `what` at its start."""
        print(f"{len(self.seconds) + 1}. {what} …", file=sys.stderr, flush=True)
        begin_s = time.perf_counter()
        try:
            yield
        finally:
            self.seconds[name] = time.perf_counter() - begin_s
        print(f"   {self.seconds[name]:.1f} s", file=sys.stderr, flush=True)

    def rows(self) -> list[dict[str, object]]:
        """Rows for `report.json`."""
        return [
            {"name": name, "seconds": round(seconds, 3)} for name, seconds in self.seconds.items()
        ]
