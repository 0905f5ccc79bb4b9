"""Health checks of the station itself: calibration, disk, uploads, its computer and its clocks."""

import math
import os
import shutil
import time
from collections import deque
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path

import numpy as np

from dextouch.schemas import Matrix
from dextouch.streams import TAXEL_UNIT, StreamDescriptor
from services.acquisition.clock import HostWatch, StationClock
from services.acquisition.health.evaluation import (
    WINDOW_NS,
    CountWindow,
    Evaluation,
    Finding,
    Rolling,
)
from services.acquisition.health.glove_records import is_ours
from services.acquisition.supervisor import DeviceSupervisor
from services.acquisition.watches import PathWatch

MIN_RATE_SPAN_NS = 900_000_000
CALIBRATED_AT = "calibrated_at_unix_s"
# Half of the last 10 s must be known. A wake stands for the wait before it and for how late it was,
# a second of that at most: one long stop is no overload.
WAIT_S = 0.1
MAX_COUNTED_LATE_S = 1.0
MIN_KNOWN_S = 5.0
PERCENTILE = 90
# How long a sleep, or a setting of the wall clock, is shown.
SUSPENDED_SHOWN_NS = 20_000_000_000
CLOCK_SET_SHOWN_NS = 60_000_000_000


class DiskCheck:
    """How long the spool's disk would last if everything that arrives now were recorded."""

    def __init__(
        self,
        spool_root: Path,
        supervisors: Sequence[DeviceSupervisor],
        now_ns: int,
        *,
        free_bytes: Callable[[], int] | None = None,
    ) -> None:
        self._free_bytes = free_bytes or (lambda: shutil.disk_usage(spool_root).free)
        streams = [stream for s in supervisors for stream in s.streams.values()]
        self._arrived = CountWindow(lambda: {"bytes": sum(s.num_bytes for s in streams)}, now_ns)

    def __call__(self, evaluation: Evaluation) -> None:
        """One evaluation."""
        num_bytes = self._arrived.growth(evaluation.now_ns)["bytes"]
        elapsed_ns = evaluation.now_ns - self._arrived.history[0][0]
        try:
            free = self._free_bytes()
        except OSError as error:
            text = f"the spool's disk cannot be read: {error.strerror}"
            evaluation.findings.append(Finding("disk", "ERROR", text))
            return
        evaluation.figures["disk_free_bytes"] = float(free)
        if elapsed_ns >= MIN_RATE_SPAN_NS and num_bytes > 0:
            left_s = evaluation.figures["disk_left_seconds"] = free / num_bytes * elapsed_ns * 1e-9
            text = f"the disk is full in {left_s / 60:.0f} minutes; upload or delete takes"
            evaluation.judge("disk", -left_s, text)


class CalibrationCheck:
    """Whether the calibration that travels with recordings is there, and how old it is.

    The age is judged where the record says when it was made (`calibrated_at_unix_s`, 1 × 1, or
    the same behind a stream's name); a record that does not say gets no age, not a young one.
    """

    def __init__(
        self,
        descriptors: Sequence[StreamDescriptor],
        calibration: Mapping[str, Matrix],
        *,
        unix_s: Callable[[], float] = time.time,
    ) -> None:
        self._unix_s = unix_s
        self._missing = [
            name for name in needed_matrices(descriptors) if not np.size(calibration.get(name, ()))
        ]
        numbers = {name: number(calibration, name) for name in calibration}
        known = {name: value for name, value in numbers.items() if value is not None}
        self._made_unix_s = [v for name, v in known.items() if name.endswith(CALIBRATED_AT)]
        self._sigmas_ns = [v for name, v in known.items() if name.endswith("_latency_sigma_ns")]

    def __call__(self, evaluation: Evaluation) -> None:
        """One evaluation."""
        text = f"calibration lacks {', '.join(self._missing)}; calibrate the station"
        evaluation.judge("calibration_missing", len(self._missing), text)
        if self._sigmas_ns:
            evaluation.figures["latency_sigma_seconds"] = max(self._sigmas_ns) * 1e-9
        if self._made_unix_s:
            age_s = self._unix_s() - min(self._made_unix_s)
            evaluation.figures["calibration_age_seconds"] = age_s
            text = f"the oldest calibration is {age_s / 86_400:.0f} days old; calibrate again"
            evaluation.judge("calibration_age", age_s, text)


def tared_unix_s(descriptor: StreamDescriptor, calibration: Mapping[str, Matrix]) -> float | None:
    """When a glove was tared; None of other streams, and where the calibration does not say."""
    is_glove = descriptor.kind == "tactile"
    return number(calibration, f"{descriptor.name}_{CALIBRATED_AT}") if is_glove else None


class PathCheck:
    """Compares a stream's measured path delay with that of the station's calibration, if any."""

    def __init__(self, stream: str, paths: PathWatch, calibration: Mapping[str, Matrix]) -> None:
        self._stream = stream
        self._paths = paths
        self._calibrated_ns = number(calibration, f"{stream}_latency_ns")
        # A delay without a sigma is compared by the sigma of the measurement alone.
        self._calibrated_sigma_ns = number(calibration, f"{stream}_latency_sigma_ns") or 0.0

    def __call__(self, evaluation: Evaluation) -> None:
        """One evaluation."""
        num_failures = self._paths.num_failures(self._stream)
        if num_failures is not None:
            evaluation.figures["time_requests_failed"] = float(num_failures)
        measured = self._paths.latencies().get(self._stream)
        if measured is None:
            return
        evaluation.figures["path_latency_seconds"] = measured.latency_ns * 1e-9
        evaluation.figures["path_latency_sigma_seconds"] = measured.sigma_ns * 1e-9
        if self._calibrated_ns is not None:
            sigma_ns = math.hypot(measured.sigma_ns, self._calibrated_sigma_ns)
            sigmas = abs(measured.latency_ns - self._calibrated_ns) / sigma_ns
            text = (
                f"its path delay is {measured.latency_ns * 1e-6:.1f} ms by its replies and "
                f"{self._calibrated_ns * 1e-6:.1f} ms by the calibration, {sigmas:.1f} sigma apart"
            )
            evaluation.judge("latency_calibration", sigmas, text)


def judge_uploads(evaluation: Evaluation, refused: Mapping[str, str]) -> None:
    """Whether the store refused takes for good, by its words for each."""
    if refused:
        first, reason = next(iter(refused.items()))
        others = f" and {len(refused) - 1} more" if len(refused) > 1 else ""
        text = f"the store refuses take {first}{others}: {reason}"
        evaluation.judge("upload_refused", len(refused), text)


def number(calibration: Mapping[str, Matrix], name: str) -> float | None:
    """The one number of a 1 × 1 matrix of the calibration; None where there is no such."""
    matrix = calibration.get(name)
    return None if matrix is None or np.size(matrix) != 1 else float(np.ravel(matrix)[0])


def needed_matrices(descriptors: Sequence[StreamDescriptor]) -> list[str]:
    """Matrices without which no episode can be made of these streams (docs/streams.md)."""
    needed = []
    for descriptor in descriptors:
        if descriptor.name == "camera_head":
            needed.append("K_head")
        has_layout = descriptor.layout is not None
        is_raw = descriptor.unit != TAXEL_UNIT
        if descriptor.kind == "tactile" and is_raw and (descriptor.unit == "counts" or has_layout):
            needed.append(f"{descriptor.name}_tare_counts")
            if not (has_layout and descriptor.tactile_layout.nominal_kpa_per_unit is not None):
                needed.append(f"{descriptor.name}_gain_counts_per_kpa")
            if not (has_layout or is_ours(descriptor)):
                needed.append(f"{descriptor.name}_cells")
    return needed


class HostCheck:
    """How late a periodic thread of the station wakes, which an overloaded computer delays.

    The 90th percentile of 10 s: a single stop of the process, such as a laptop's sleep, is none.
    """

    def __init__(self, load: Callable[[], tuple[float, int]] | None = None) -> None:
        self._load = load or (lambda: (os.getloadavg()[0], os.cpu_count() or 1))
        self._late = Rolling()
        self._cpu_times = _cpu_times
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
        if (WAIT_S + np.minimum(wakes_s, MAX_COUNTED_LATE_S)).sum() < MIN_KNOWN_S:
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
    """Whether the computer slept, or its wall clock was set, since the last evaluations."""

    def __init__(self, clock: StationClock) -> None:
        self._watch = HostWatch(clock)

    def __call__(self, evaluation: Evaluation) -> None:
        """One evaluation."""
        self._watch.look()
        rules = (
            ("host_suspended", SUSPENDED_SHOWN_NS, "it was suspended for {:.1f} s"),
            ("wall_clock_set", CLOCK_SET_SHOWN_NS, "its wall clock was set by {:.1f} s"),
        )
        for code, shown_ns, text in rules:
            recent_ns = [
                step_ns
                for t_ns, step_ns in self._watch.events[code]
                if t_ns > evaluation.now_ns - shown_ns
            ]
            evaluation.judge(code, len(recent_ns), text.format(sum(recent_ns) * 1e-9))
