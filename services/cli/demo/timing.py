"""Named stages of a run: how long each took, told to whoever is watching."""

import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager


class Stages:
    """Keeps the wall time of every stage, in the order in which they ran."""

    def __init__(self) -> None:
        self.seconds: dict[str, float] = {}

    @contextmanager
    def stage(self, name: str, what: str) -> Iterator[None]:
        """Time one stage; `what` is what a person is told while it runs."""
        print(f"{len(self.seconds) + 1}. {what} …", file=sys.stderr, flush=True)
        begin_s = time.perf_counter()
        try:
            yield
        finally:
            self.seconds[name] = time.perf_counter() - begin_s
        print(f"   {self.seconds[name]:.1f} s", file=sys.stderr, flush=True)

    def rows(self) -> list[dict[str, object]]:
        """As `report.json` holds them."""
        return [
            {"name": name, "seconds": round(seconds, 3)} for name, seconds in self.seconds.items()
        ]
