"""Comparison of hand-eye methods on the same scenes: time and errors, in turns."""

import gc
import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from typing import Any, NamedTuple

import numpy as np

from benchmarks.calibration.rivals import METHODS, Method
from benchmarks.figures import Figure
from benchmarks.rounds import interleaved
from benchmarks.simulated.board_scenes import Scene, mount_difference
from benchmarks.stages import Bar
from dextouch.errors import InvalidInputError
from dextouch.geometry import invert
from services.alignment.calibration.motion import twist


class Solved(NamedTuple):
    """One method on one scene; `nees` per degree of freedom and `sigma` where available."""

    ms: float
    error_deg: float
    error_mm: float
    nees: float | None = None
    sigma_deg: float | None = None
    sigma_mm: float | None = None


@dataclass(frozen=True)
class MethodResult:
    """Results of one method on all scenes, in the order of the seeds."""

    name: str
    num_seeds: int
    ms: Figure
    error_deg: Figure
    error_mm: Figure
    nees: Figure | None
    sigma_deg: Figure | None
    sigma_mm: Figure | None


def compare(scenes: Sequence[Scene], bar: Bar) -> dict[str, MethodResult]:
    """Run every method on every scene, after a warm-up on the first one."""
    for method in METHODS:
        method.solve(scenes[0])
    gc.collect()
    with bar("hand-eye", len(METHODS) * len(scenes)) as step:
        rounds = interleaved(
            {method.name: partial(_score_at, method, scenes) for method in METHODS},
            len(scenes),
            on_step=step,
        )
    results = {}
    for name, solved in rounds.items():
        columns: dict[str, Any] = {
            key: None if None in values else Figure.of(values)
            for key, values in zip(Solved._fields, zip(*solved, strict=True), strict=True)
        }
        results[name] = MethodResult(name, len(solved), **columns)
    return results


def score(method: Method, scene: Scene) -> Solved:
    """Time (of this thread's processor) and error of one method on one scene.

    Raises:
        InvalidInputError: the method refuses the scene, or gives no finite mount.
    """
    begun_s = time.thread_time()
    answer = method.solve(scene)
    ms = (time.thread_time() - begun_s) * 1e3
    angle_rad, distance_m = mount_difference(answer.T_tracker_camera, scene.T_tracker_camera)
    error_deg, error_mm = float(np.rad2deg(angle_rad)), distance_m * 1e3
    if answer.covariance is None:
        return Solved(ms, error_deg, error_mm)
    error = twist(invert(answer.T_tracker_camera) @ scene.T_tracker_camera)
    variances = np.diag(answer.covariance)
    return Solved(
        ms,
        error_deg,
        error_mm,
        nees=float(error @ np.linalg.solve(answer.covariance, error) / 6),
        sigma_deg=float(np.rad2deg(np.sqrt(variances[:3].sum()))),
        sigma_mm=float(np.sqrt(variances[3:].sum()) * 1e3),
    )


def _score_at(method: Method, scenes: Sequence[Scene], index: int) -> Solved:
    return score(method, scenes[index])


def not_worse_share(
    ours: MethodResult, rival: MethodResult, *, tolerance_sigmas: float
) -> tuple[float, float]:
    """Share of seeds with an error of at most the rival's plus a tolerance in our sigmas.

    Returns the share by rotation and that by translation.

    Raises:
        InvalidInputError: ours has no sigma.
    """
    if ours.sigma_deg is None or ours.sigma_mm is None:
        raise InvalidInputError(f"{ours.name}: has no sigma to define the tolerance")

    def share(errors: Figure, others: Figure, sigmas: Figure) -> float:
        limits = np.array(others.values) + tolerance_sigmas * np.array(sigmas.values)
        return float(np.mean(np.array(errors.values) <= limits))

    return (
        share(ours.error_deg, rival.error_deg, ours.sigma_deg),
        share(ours.error_mm, rival.error_mm, ours.sigma_mm),
    )


Results = Mapping[str, MethodResult]
