"""Health checks of the station itself: disk, calibration and refused uploads."""

import shutil
import time
from collections import deque
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path

import numpy as np

from dextouch.schemas import Matrix
from dextouch.streams import StreamDescriptor
from dextouch.tactile.layout import NUM_RAW_TAXELS
from services.acquisition.health_levels import Verdict
from services.acquisition.schemas import HealthFinding
from services.acquisition.supervisor import DeviceSupervisor

RATE_WINDOW_NS = 10_000_000_000
MIN_RATE_SPAN_NS = 900_000_000
DISK_WARN_S = 30 * 60.0
DISK_ERROR_S = 5 * 60.0
CALIBRATION_WARN_S = 7 * 86_400.0
CALIBRATED_AT = "calibrated_at_unix_s"


class DiskJudge:
    """How long the spool's disk would last if everything that arrives now were recorded.

    Args:
        spool_root: folder of the takes.
        supervisors: whose readers count payload bytes.
        free_bytes: of the disk; asks the operating system if None.
    """

    def __init__(
        self,
        spool_root: Path,
        supervisors: Sequence[DeviceSupervisor],
        *,
        free_bytes: Callable[[], int] | None = None,
    ) -> None:
        self._spool_root = spool_root
        self._supervisors = supervisors
        self._free_bytes = free_bytes or self._ask
        self._counts: deque[tuple[int, int]] = deque()

    def judge(self, now_ns: int) -> Verdict:
        """One evaluation."""
        total = sum(
            stream.num_bytes for s in self._supervisors for stream in s.counters.streams.values()
        )
        counts = self._counts
        counts.append((now_ns, total))
        while len(counts) > 2 and counts[1][0] <= now_ns - RATE_WINDOW_NS:
            counts.popleft()
        elapsed_ns = now_ns - counts[0][0]
        try:
            free = self._free_bytes()
        except OSError as error:
            text = f"the spool's disk cannot be read: {error.strerror}"
            return Verdict((HealthFinding(code="disk", level="ERROR", message=text),))
        rate = (total - counts[0][1]) / max(1e-9, elapsed_ns * 1e-9)
        figures = {"disk_free_bytes": float(free)}
        if elapsed_ns < MIN_RATE_SPAN_NS or rate <= 0:
            return Verdict((), figures)
        left_s = free / rate
        figures["disk_left_seconds"] = left_s
        if left_s >= DISK_WARN_S:
            return Verdict((), figures)
        text = f"the disk is full in {left_s / 60:.0f} minutes; upload or delete takes"
        level: str = "ERROR" if left_s < DISK_ERROR_S else "WARN"
        finding = HealthFinding.model_validate({"code": "disk", "level": level, "message": text})
        return Verdict((finding,), figures)

    def _ask(self) -> int:
        return shutil.disk_usage(self._spool_root).free


class CalibrationJudge:
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
        self._made_unix_s = {
            name: float(np.ravel(matrix)[0])
            for name, matrix in calibration.items()
            if name.endswith(CALIBRATED_AT) and np.size(matrix) == 1
        }
        self._sigmas_s = [
            float(np.ravel(matrix)[0]) * 1e-9
            for name, matrix in calibration.items()
            if name.endswith("_latency_sigma_ns") and np.size(matrix) == 1
        ]

    def judge(self, now_ns: int) -> Verdict:
        """One evaluation."""
        del now_ns
        findings = []
        if self._missing:
            text = f"calibration lacks {', '.join(self._missing)}; calibrate the station"
            findings.append(HealthFinding(code="calibration_missing", level="ERROR", message=text))
        figures = {}
        if self._sigmas_s:
            figures["latency_sigma_seconds"] = max(self._sigmas_s)
        if self._made_unix_s:
            age_s = self._unix_s() - min(self._made_unix_s.values())
            figures["calibration_age_seconds"] = age_s
            if age_s > CALIBRATION_WARN_S:
                text = f"the oldest calibration is {age_s / 86_400:.0f} days old; calibrate again"
                findings.append(HealthFinding(code="calibration_age", level="WARN", message=text))
        return Verdict(tuple(findings), figures)


class UploadJudge:
    """Whether the store refused takes for good.

    Args:
        refused: the store's words by take.
    """

    def __init__(self, refused: Callable[[], Mapping[str, str]]) -> None:
        self._refused = refused

    def judge(self, now_ns: int) -> Verdict:
        """One evaluation."""
        del now_ns
        refused = self._refused()
        if not refused:
            return Verdict()
        first, reason = next(iter(refused.items()))
        others = f" and {len(refused) - 1} more" if len(refused) > 1 else ""
        text = f"the store refuses take {first}{others}: {reason}"
        return Verdict((HealthFinding(code="upload_refused", level="WARN", message=text),))


def needed_matrices(descriptors: Sequence[StreamDescriptor]) -> list[str]:
    """Matrices without which no episode can be made of these streams (docs/streams.md)."""
    needed = []
    for descriptor in descriptors:
        if descriptor.name == "camera_head":
            needed.append("K_head")
        if descriptor.kind == "tactile" and descriptor.unit == "counts":
            needed += [f"{descriptor.name}_tare_counts", f"{descriptor.name}_gain_counts_per_kpa"]
            if descriptor.shape != (NUM_RAW_TAXELS,):
                needed.append(f"{descriptor.name}_cells")
    return needed
