"""Errors and reported sigmas of cameras calibrated from different numbers of views."""

import time
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float64

from benchmarks.figures import Figure
from benchmarks.simulated.board_scenes import DISTORTION, K, simulated_boards
from benchmarks.stages import Bar
from services.alignment.calibration.intrinsics import FoundBoards, calibrate_found

NAMES = ("fx", "fy", "cx", "cy", "k1", "k2", "p1", "p2", "k3")
# Below this number of cameras the spread is too uncertain to compare.
MIN_SEEDS = 10


@dataclass(frozen=True)
class CameraResult:
    """Cameras calibrated from `num_views` views, in the order of the seeds.

    `focal_error` is |df| / f, `centre_px` the distance of the principal point, `rms_px` the
    residual, which is no measure of accuracy, `coverage` the share of the image that corners cover,
    `ms` processor time of this thread. `sigma_over_spread` is, by parameter, the reported sigma
    (RMS over the seeds) over the spread of the errors; ideally 1, empty for few seeds.
    """

    num_views: int
    focal_error: Figure
    centre_px: Figure
    rms_px: Figure
    coverage: Figure
    ms: Figure
    sigma_over_spread: dict[str, float]


def measure_cameras(counts: tuple[int, ...], num_seeds: int, bar: Bar) -> list[CameraResult]:
    """Cameras from each number of views, for each seed."""
    with bar("intrinsics", len(counts) * num_seeds) as step:
        results = []
        for num_views in counts:
            rows = []
            for seed in range(num_seeds):
                step(f"{num_views} views")
                rows.append(_calibrate(simulated_boards(20_000 + seed, num_views)))
            results.append(_result(num_views, np.array(rows)))
        return results


def _calibrate(boards: FoundBoards) -> Float64[np.ndarray, "21"]:
    """Errors (9), sigmas (9), residual, coverage, time."""
    begun_s = time.thread_time()
    found = calibrate_found(boards)
    ms = (time.thread_time() - begun_s) * 1e3
    place = [0, 1, 0, 1], [0, 1, 2, 2]
    return np.array(
        [
            *(found.K[place] - K[place]),
            *(found.distortion - DISTORTION),
            *found.sigma_fxfycxcy_px,
            *found.sigma_distortion,
            found.rms_px,
            found.coverage,
            ms,
        ]
    )


def _result(num_views: int, rows: np.ndarray) -> CameraResult:
    errors, sigmas = rows[:, :9], rows[:, 9:18]
    ratios: dict[str, float] = {}
    if len(rows) >= MIN_SEEDS:
        shares = np.sqrt(np.square(sigmas).mean(axis=0)) / errors.std(axis=0)
        ratios = dict(zip(NAMES, (float(share) for share in shares), strict=True))
    focal = np.abs(errors[:, :2] / K[[0, 1], [0, 1]]).max(axis=1)
    return CameraResult(
        num_views,
        focal_error=Figure.of(focal.tolist()),
        centre_px=Figure.of(np.linalg.norm(errors[:, 2:4], axis=1).tolist()),
        rms_px=Figure.of(rows[:, 18].tolist()),
        coverage=Figure.of(rows[:, 19].tolist()),
        ms=Figure.of(rows[:, 20].tolist()),
        sigma_over_spread=ratios,
    )
