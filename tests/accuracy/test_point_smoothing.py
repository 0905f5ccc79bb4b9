"""Smoothing of tracked points: its noise, its lag, and what it leaves alone."""

import sys

import numpy as np
import pytest

from services.alignment.retargeting.solver.solve import noise_of_bones, smooth_forward, smoothed

SIGMA_M = 1.5e-3


def along_x(x_m):
    points = np.zeros((len(x_m), 1, 3))
    points[:, 0, 0] = x_m
    return points


@pytest.mark.parametrize("speed", [0.02, 0.3, 1.0, 30.0])
def test_a_steady_point_is_behind_as_computed(speed):
    """Each sample moves by `speed` of √v = √3 sigma; then e³ = speed (e² + v) is the distance e."""
    root_m = np.sqrt(3) * SIGMA_M
    step_m = speed * root_m
    wanted = along_x(step_m * np.arange(2000))
    found = wanted.copy()
    smooth_forward(found, 3 * SIGMA_M**2)
    (distance_m,) = (
        root.real
        for root in np.roots([1.0, -step_m, 0.0, -step_m * root_m**2])
        if abs(root.imag) < 1e-9
    )
    behind_m = wanted[-1, 0, 0] - found[-1, 0, 0]
    assert behind_m == pytest.approx(distance_m - step_m, rel=1e-6)
    assert behind_m <= root_m / 2
    # Both ways: none in the middle.
    middle = smoothed(wanted, SIGMA_M)[1000, 0, 0]
    assert middle == pytest.approx(wanted[1000, 0, 0], abs=1e-9)


def test_noise_at_rest_is_reduced(capsys):
    noisy = np.random.default_rng(1).normal(scale=SIGMA_M, size=(5000, 4, 3))
    live = noisy.copy()
    smooth_forward(live, 3 * SIGMA_M**2)
    both = smoothed(noisy, SIGMA_M)
    steps = [np.abs(np.diff(one, axis=0)).mean() for one in (noisy, live, both)]
    with capsys.disabled():
        sys.stdout.write(
            f"\nnoise of {SIGMA_M * 1e3:g} mm: left {live.std() / SIGMA_M:.2f} live, "
            f"{both.std() / SIGMA_M:.2f} of recordings (bound 0.75); steps "
            f"{steps[1] / steps[0]:.2f} and {steps[2] / steps[0]:.2f} (bound 0.6)"
        )
    assert live.std() <= 0.75 * SIGMA_M
    assert both.std() <= 0.75 * SIGMA_M
    assert max(steps[1:]) <= 0.6 * steps[0]


@pytest.mark.parametrize("fault", [1.0, 1000.0, np.nan])
def test_noise_is_found_from_bones(fault, capsys):
    """Bones of 30 mm with noise at both ends; one sample in thirty is in millimetres, or lost."""
    rng, nodes = np.random.default_rng(4), np.arange(20).reshape(5, 4)
    places = np.zeros((20, 3))
    places[:, 0] = 0.03 * np.arange(20)
    bones = np.zeros((5, 3, 3))
    for index in range(600):
        sample = places + rng.normal(scale=SIGMA_M, size=places.shape)
        found = noise_of_bones(bones, sample * (fault if index % 30 == 29 else 1.0), nodes)
    with capsys.disabled():
        sys.stdout.write(f"\nnoise found, faults x {fault:g}: {np.sqrt(found / 3) * 1e3:.2f} mm")
    assert np.sqrt(found / 3) == pytest.approx(SIGMA_M, rel=0.1)


def test_without_noise_nothing_changes():
    points = np.random.default_rng(2).random((50, 25, 3))
    np.testing.assert_allclose(smoothed(points, 0.0), points, atol=1e-15)


def test_missing_points_stay_missing_and_harm_no_other():
    points = np.random.default_rng(3).normal(size=(60, 2, 3))
    lost = points.copy()
    lost[20:30, 0] = np.nan
    lost[:5, 1, 2] = np.nan
    found = smoothed(lost, SIGMA_M)
    np.testing.assert_array_equal(np.isfinite(found).all(axis=-1), np.isfinite(lost).all(axis=-1))
    # Of a metre: a step so far is followed at once.
    known = np.isfinite(lost).all(axis=-1)
    np.testing.assert_allclose(found[known], points[known], atol=1e-3)
