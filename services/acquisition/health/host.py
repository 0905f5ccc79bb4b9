"""Health checks of the computer itself: its load, its sleep, and its wall clock."""

import os
from collections import deque
from collections.abc import Callable
from pathlib import Path

import numpy as np

from services.acquisition.clock import HostWatch, StationClock
from services.acquisition.health.evaluation import WINDOW_NS, Evaluation, Rolling

# A tenth of a second apart: the last 10 s at least half full.
MIN_WAKES = 50
PERCENTILE = 90
# How long a sleep, or a setting of the wall clock, is shown.
SUSPENDED_SHOWN_NS = 20_000_000_000
CLOCK_SET_SHOWN_NS = 60_000_000_000


class HostCheck:
    """How late a periodic thread of the station wakes, which an overloaded computer delays.

    The 90th percentile of 10 s: a single stop of the process, such as a laptop's sleep, is none.

    Args:
        load: tasks that run or wait for a processor, and the number of processors.
        cpu_times: of the processors since the start of the computer: used, and all.
    """

    def __init__(
        self,
        load: Callable[[], tuple[float, int]] | None = None,
        cpu_times: Callable[[], tuple[int, int] | None] | None = None,
    ) -> None:
        self._load = load or _load
        self._late = Rolling()
        self._cpu_times = cpu_times or _cpu_times
        # The times of the last 10 s, whose ends give the share that was used.
        self._times: deque[tuple[int, int, int]] = deque()

    def note(self, now_ns: int, late_ns: int) -> None:
        """A thread that was due `late_ns` ago has woken at `now_ns`."""
        self._late.add(np.array([now_ns]), np.array([late_ns * 1e-9]), now_ns)

    def __call__(self, evaluation: Evaluation) -> None:
        """One evaluation."""
        self._judge_processors(evaluation)
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

    def _judge_processors(self, evaluation: Evaluation) -> None:
        times = self._cpu_times()
        if times is None:
            return
        self._times.append((evaluation.now_ns, *times))
        while len(self._times) > 2 and self._times[1][0] <= evaluation.now_ns - WINDOW_NS:
            self._times.popleft()
        for figure, earlier in (("host_cpu_ratio", -2), ("host_cpu_10s_ratio", 0)):
            _, used, ticks = self._times[max(earlier, -len(self._times))]
            if times[1] > ticks:
                evaluation.figures[figure] = (times[0] - used) / (times[1] - ticks)


def _load() -> tuple[float, int]:
    return os.getloadavg()[0], os.cpu_count() or 1


def _cpu_times(stat: Path = Path("/proc/stat")) -> tuple[int, int] | None:
    """Ticks of all processors together, from the first line of /proc/stat (proc(5))."""
    try:
        first = stat.read_text(encoding="ascii").split("\n", 1)[0].split()
    except OSError:
        return None
    # user, nice, system, idle, iowait, irq, softirq, steal; guests are part of user and nice.
    ticks = [int(number) for number in first[1:9]]
    return sum(ticks) - sum(ticks[3:5]), sum(ticks)


class HostClockCheck:
    """Whether the computer slept, or its wall clock was set, since the last evaluations.

    Args:
        clock: of the station.
    """

    def __init__(self, clock: StationClock) -> None:
        self._watch = HostWatch(clock)

    def __call__(self, evaluation: Evaluation) -> None:
        """One evaluation."""
        self._watch.look()
        shown = (
            ("host_suspended", SUSPENDED_SHOWN_NS, "it was suspended for {:.1f} s"),
            ("wall_clock_set", CLOCK_SET_SHOWN_NS, "its wall clock was set by {:.1f} s"),
        )
        for code, shown_ns, text in shown:
            recent_ns = [
                step_ns
                for t_ns, step_ns in self._watch.events[code]
                if t_ns > evaluation.now_ns - shown_ns
            ]
            evaluation.judge(code, len(recent_ns), text.format(sum(recent_ns) * 1e-9))
