"""Health check of the computer itself: how late it wakes the station's threads."""

import os
from collections.abc import Callable

import numpy as np

from services.acquisition.health.evaluation import Evaluation, Rolling

# A tenth of a second apart: the last 10 s at least half full.
MIN_WAKES = 50
PERCENTILE = 90


class HostJudge:
    """How late a periodic thread of the station wakes, which an overloaded computer delays.

    The 90th percentile of 10 s: a single stop of the process, such as a laptop's sleep, is none.

    Args:
        load: tasks that run or wait for a processor, and the number of processors.
    """

    def __init__(self, load: Callable[[], tuple[float, int]] | None = None) -> None:
        self._load = load or _load
        self._late = Rolling()

    def note(self, now_ns: int, late_ns: int) -> None:
        """A thread that was due `late_ns` ago has woken at `now_ns`."""
        self._late.add(np.array([now_ns]), np.array([late_ns * 1e-9]), now_ns)

    def __call__(self, evaluation: Evaluation) -> None:
        """One evaluation."""
        empty = np.empty(0)
        wakes_s = self._late.add(empty.astype(np.int64), empty, evaluation.now_ns)
        if len(wakes_s) < MIN_WAKES:
            return
        late_s = float(np.percentile(wakes_s, PERCENTILE))
        evaluation.figures["host_wake_p90_seconds"] = late_s
        num_tasks, num_cores = self._load()
        text = (
            f"the station's threads wake {late_s * 1e3:.0f} ms late "
            f"({num_tasks:.0f} tasks on {num_cores} processors)"
        )
        evaluation.judge("overload", late_s, text)


def _load() -> tuple[float, int]:
    return os.getloadavg()[0], os.cpu_count() or 1
