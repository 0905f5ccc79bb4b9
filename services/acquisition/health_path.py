"""Health check that compares a measured path delay with the calibrated one."""

import math
from collections.abc import Mapping

import numpy as np

from dextouch.schemas import Matrix
from services.acquisition.health_blocks import Block
from services.acquisition.health_levels import Verdict
from services.acquisition.path_latency import PathWatch
from services.acquisition.schemas import HealthFinding

MAX_SIGMAS = 5.0


class PathJudge:
    """Compares a stream's measured path delay with the station's calibration.

    Args:
        stream: name of the stream.
        paths: gives measured delays.
        calibration: of the station; without a delay of the stream there is nothing to compare.
    """

    def __init__(self, stream: str, paths: PathWatch, calibration: Mapping[str, Matrix]) -> None:
        self._stream = stream
        self._paths = paths
        self._calibrated_ns = _number(calibration, f"{stream}_latency_ns")
        # A delay without a sigma is compared by the sigma of the measurement alone.
        self._calibrated_sigma_ns = _number(calibration, f"{stream}_latency_sigma_ns") or 0.0

    def judge(self, block: Block, now_ns: int) -> Verdict:
        """One evaluation."""
        del block, now_ns
        figures: dict[str, float] = {}
        num_failures = self._paths.num_failures(self._stream)
        if num_failures is not None:
            figures["time_requests_failed"] = float(num_failures)
        measured = self._paths.latencies().get(self._stream)
        if measured is None:
            return Verdict((), figures)
        figures["path_latency_seconds"] = measured.latency_ns * 1e-9
        figures["path_latency_sigma_seconds"] = measured.sigma_ns * 1e-9
        if self._calibrated_ns is None:
            return Verdict((), figures)
        limit_ns = MAX_SIGMAS * math.hypot(measured.sigma_ns, self._calibrated_sigma_ns)
        if abs(measured.latency_ns - self._calibrated_ns) <= limit_ns:
            return Verdict((), figures)
        text = (
            f"its path delay is {measured.latency_ns * 1e-6:.1f} ms by its replies and "
            f"{self._calibrated_ns * 1e-6:.1f} ms by the calibration, more than "
            f"{limit_ns * 1e-6:.1f} ms apart"
        )
        finding = HealthFinding(code="latency_calibration", level="WARN", message=text)
        return Verdict((finding,), figures)


def _number(calibration: Mapping[str, Matrix], name: str) -> float | None:
    matrix = calibration.get(name)
    return None if matrix is None or np.size(matrix) != 1 else float(np.ravel(matrix)[0])
