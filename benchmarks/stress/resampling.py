"""Stress of resampling: values and poses on the grid of an episode."""

import numpy as np

from benchmarks.stress.cells import Check, StageCells
from dextouch.errors import DegenerateRotationError, NonFiniteError
from dextouch.geometry import pose_from_transform, transform
from dextouch.geometry.rotations import rotation_angle, rotation_from_vector
from services.alignment.synchronization.resampling import (
    GridPlacement,
    grid_times_ns,
    place_on_grid,
    poses_on_grid,
    vectors_on_grid,
)

STAGE = StageCells("resampling")
_PERIOD_NS, _GAP_NS = 10_000_000, 50_000_000
_T_NS = np.arange(11, dtype=np.int64) * _PERIOD_NS


@STAGE.cell("rotations", "turns of 0, 1e-12, π - 1e-9 and π between samples; a flipped quaternion")
def _rotations(check: Check) -> None:
    at = _placed(np.array([0, 2_500_000, 5_000_000, 10_000_000]))
    axis = np.array([0.6, 0.0, 0.8])
    for angle in (0.0, 1e-12, 1.0, np.pi - 1e-9, np.pi):
        poses = np.repeat(pose_from_transform(np.eye(4))[None], 11, axis=0)
        turned = pose_from_transform(transform(rotation_from_vector(angle * axis), np.zeros(3)))
        for sign in (1.0, -1.0):
            poses[1:, 3:] = sign * turned[3:]
            angles = rotation_angle(poses_on_grid(poses, at)[:, :3, :3])
            off = np.abs(angles - np.array([0.0, 0.25, 0.5, 1.0]) * angle).max()
            check.at_most("angles on the way off", off, 1e-7, "rad")
    poses[4, 3:] = 0.0
    check.refused("a lost quaternion", poses_on_grid, poses, at, kind=DegenerateRotationError)


@STAGE.cell("clock", "gaps, stamps that stand or go back, a stream of one sample, edges")
def _clock(check: Check) -> None:
    gap = np.concatenate([_T_NS[:5], _T_NS[5:] + 10 * _PERIOD_NS])
    grid = np.arange(0, 200_000_000, 5_000_000)
    at = _placed(grid, gap)
    inside = (grid > gap[4]) & (grid < gap[5])
    check.true("no step inside a gap is valid", not at.valid[inside].any())
    check.true(
        "all others are", at.valid[(grid <= gap[4]) | ((grid >= gap[5]) & (grid <= gap[-1]))].all()
    )
    for what, times in (
        ("stamps that stand", np.repeat(_T_NS[:6], 2)),
        ("stamps that go back", _T_NS[::-1].copy()),
    ):
        check.refused(what, _placed, grid, times)
    check.true("one sample places nothing", not _placed(grid, _T_NS[:1]).valid.any())


@STAGE.cell("non_finite", "a NaN among values; NaN and infinity in a pose; values of 1e308, 5e-324")
def _non_finite(check: Check) -> None:
    at = _placed(np.arange(0, 100_000_001, 2_500_000))
    values = np.ones((11, 2))
    values[5, 1] = np.nan
    got = vectors_on_grid(values, at)
    touched = (at.left == 4) | (at.left == 5)
    check.true("NaN reaches its neighbours only", np.isfinite(got[~touched]).all())
    check.true("… and its own column only", np.isfinite(got[:, 0]).all())
    for size in (1e308, 5e-324):
        check.at_most(
            f"values of {size:g} off",
            float(np.abs(vectors_on_grid(np.full((11, 1), size), at) / size - 1).max()),
            1e-15 if size > 1 else 1.0,
        )
    for bad in (np.nan, np.inf):
        poses = np.repeat(pose_from_transform(np.eye(4))[None], 11, axis=0)
        poses[3, 5] = bad
        check.refused(f"{bad} in a pose", poses_on_grid, poses, at, kind=NonFiniteError)


@STAGE.cell("touch", "pressures of 0 and 650 kPa in turns, on the grid and past both edges")
def _touch(check: Check) -> None:
    values = np.zeros((11, 320))
    values[1::2] = 650.0
    grid = np.arange(-15_000_000, 115_000_001, 2_500_000)
    got = vectors_on_grid(values, _placed(grid))
    inside = (grid >= 0) & (grid <= _T_NS[-1])
    check.at_most("largest inside", got[inside].max(), 650.0, "kPa")
    check.at_most("most below zero inside", -got[inside].min(), 0.0, "kPa")
    # Beyond the edges values are extrapolated linearly, for at most 1.5 periods.
    check.at_most("past the edges", np.abs(got).max(), 2.5 * 650.0, "kPa")


@STAGE.cell("ends", "steps exactly on samples: weights of 0 and 1")
def _ends(check: Check) -> None:
    values = np.random.default_rng(0).normal(size=(11, 3)) * 1e6
    check.equal("values on samples", vectors_on_grid(values, _placed(_T_NS)), values)
    check.true("all valid", _placed(_T_NS).valid.all())
    just = _placed(np.array([-1, _T_NS[-1] + 1]))
    check.at_most(
        "a nanosecond outside", np.abs(vectors_on_grid(values, just) - values[[0, -1]]).max(), 1.0
    )


@STAGE.cell("precision", "float16 values; the grid at 15 Hz after a day and a year")
def _precision(check: Check) -> None:
    values = np.random.default_rng(1).normal(size=(11, 3)).astype(np.float16)
    got = vectors_on_grid(values, _placed(_T_NS))
    check.true("answers float64", got.dtype == np.float64)
    check.equal("float16 values on samples", got, values.astype(np.float64))
    shift = 365 * 86_400 * 10**9
    grid = np.array([3_333_333, 47_777_777])
    late = _placed(grid + shift, _T_NS + shift)
    check.equal("weights after a year", late.weight, _placed(grid).weight)


@STAGE.cell("long_run", "the grid of 1008 steps at 15 Hz, and of a day")
def _long_run(check: Check) -> None:
    for num in (1008, 15 * 86_400):
        steps = np.arange(num, dtype=object) if num < 2000 else np.array([num - 1], dtype=object)
        exact = np.array([(2 * 10**9 * int(k) + 15) // 30 for k in steps])
        grid = grid_times_ns(num, 15.0)[-len(exact) :]
        check.at_most(f"step {num - 1} off", float(np.abs(grid - exact).max()), 1, "ns")


@STAGE.cell("batch", "41 steps at once and one by one")
def _batch(check: Check) -> None:
    grid = np.arange(0, 100_000_001, 2_500_000)
    values = np.random.default_rng(2).normal(size=(11, 3))
    whole = vectors_on_grid(values, _placed(grid))
    alone = [vectors_on_grid(values, _placed(grid[k : k + 1])) for k in range(len(grid))]
    check.equal("values", whole, np.concatenate(alone))


STAGE.does_not_apply(
    one_axis="nothing is estimated from motion here; see hand-eye",
    device="numpy arrays live in the host's memory",
)


def _placed(grid_ns: np.ndarray, t_ns: np.ndarray = _T_NS) -> GridPlacement:
    return place_on_grid(t_ns, grid_ns, period_ns=_PERIOD_NS, max_gap_ns=_GAP_NS)
