"""Time offsets of brisk motion and of taps against known ones: error, sigma, refusals."""

import sys

import numpy as np
import pytest

from dextouch.errors import InvalidInputError
from services.alignment.calibration.motion import DegenerateMotionError
from services.alignment.calibration.time_offset import estimate_tap_offset, estimate_time_offset

BASE_NS = 1_700_000_000_000_000_000


def motion(t_s, seed, num_axes, max_hz=6.0):
    rng = np.random.default_rng(seed)
    shape = (num_axes, 8)
    rate_hz, phase = rng.uniform(0.3, max_hz, shape), rng.uniform(0, 2 * np.pi, shape)
    return np.sin(2 * np.pi * rate_hz * t_s[:, None, None] + phase).sum(axis=2)


def streams(seed, *, num_axes=3, noise=0.2, seconds=10.0):
    rng = np.random.default_rng(seed)
    offset_s = rng.uniform(-0.3, 0.3)
    t_a, t_b = np.arange(0, seconds, 1 / 60) + 0.003, np.arange(0, seconds, 1 / 90)
    a, b = motion(t_a, seed, num_axes), 2.5 * motion(t_b, seed, num_axes) + 1.0
    a, b = (x + noise * x.std() * rng.normal(size=x.shape) for x in (a, b))
    stamps = [np.rint(t * 1e9).astype(np.int64) + BASE_NS for t in (t_a, t_b - offset_s)]
    return (stamps[0], a, stamps[1], b), offset_s


@pytest.mark.slow
def test_offset_of_a_hundred_seeds(capsys):
    errors_ms, sigmas_ms = [], []
    for seed in range(100):
        taken, offset_s = streams(seed)
        found = estimate_time_offset(*taken)
        errors_ms.append(abs(found.offset_ns * 1e-6 - offset_s * 1e3))
        sigmas_ms.append(found.sigma_ns * 1e-6)
    errors_ms, sigmas_ms = np.array(errors_ms), np.array(sigmas_ms)
    good = np.mean((errors_ms <= 2) & (errors_ms <= 2 * sigmas_ms))
    with capsys.disabled():
        sys.stdout.write(
            f"\ntime offset, 100 seeds: {np.sqrt(np.mean(errors_ms**2)):.2f} ms RMS | "
            f"within 2 ms and 2 sigma: {100 * good:.0f} %, bound 95"
        )
    assert good >= 0.95


@pytest.mark.parametrize(("num_axes", "bound_ms"), [(1, 2.5), (3, 1.0)])
def test_offset_of_a_few_seeds(num_axes, bound_ms, capsys):
    errors_ms, sigmas = [], []
    for seed in range(4):
        taken, offset_s = streams(seed, num_axes=num_axes)
        found = estimate_time_offset(*taken)
        errors_ms.append(found.offset_ns * 1e-6 - offset_s * 1e3)
        sigmas.append(abs(errors_ms[-1]) / (found.sigma_ns * 1e-6))
    rms_ms = float(np.sqrt(np.mean(np.square(errors_ms))))
    with capsys.disabled():
        sys.stdout.write(
            f"\ntime offset, {num_axes} axes, 10 s: {rms_ms:.2f} ms, bound {bound_ms} | "
            f"error in sigmas {max(sigmas):.1f}, bound 3"
        )
    assert rms_ms <= bound_ms
    assert max(sigmas) <= 3


@pytest.mark.slow
def test_sigma_covers_the_spread_of_stamps_that_jitter(capsys):
    """Noise alone would allow half the sigma; stamps of real streams jitter by milliseconds."""
    ratios = {"noise": [], "jitter": []}
    for seed in range(24):
        for name, noise, jitter_s in (("noise", 0.2, 0.0), ("jitter", 0.02, 0.002)):
            (t_a, a, t_b, b), offset_s = streams(seed, noise=noise)
            rng = np.random.default_rng(1000 + seed)
            late_ns = [
                np.rint(rng.normal(0, jitter_s, len(t)) * 1e9).astype(int) for t in (t_a, t_b)
            ]
            found = estimate_time_offset(np.sort(t_a + late_ns[0]), a, np.sort(t_b + late_ns[1]), b)
            ratios[name].append((found.offset_ns - offset_s * 1e9) / found.sigma_ns)
    spread = {name: float(np.sqrt(np.mean(np.square(found)))) for name, found in ratios.items()}
    within = float(np.mean(np.abs(ratios["jitter"]) <= 2))
    with capsys.disabled():
        sys.stdout.write(
            f"\ntime offset, errors in sigmas: {spread['noise']:.2f} of noise, bounds 0.25, 0.75 | "
            f"{spread['jitter']:.2f} of jitter, bound 1.5, {100 * within:.0f} % within two"
        )
    assert 0.25 <= spread["noise"] <= 0.75
    assert spread["jitter"] <= 1.5
    assert within >= 0.85


def test_motion_lost_in_noise_is_refused():
    for seed in range(3):
        taken, _ = streams(seed, noise=4.0)
        with pytest.raises(InvalidInputError, match="time offset"):
            estimate_time_offset(*taken)


def test_motion_that_shows_no_offset_is_refused():
    (t_a, a, t_b, b), _ = streams(1)
    with pytest.raises(DegenerateMotionError, match="same brisk motion"):
        estimate_time_offset(t_a, a * 0, t_b, b)
    with pytest.raises(DegenerateMotionError, match="same brisk motion"):
        estimate_time_offset(t_a, a, t_b, np.random.default_rng(0).normal(size=b.shape))
    repeating = [np.sin(2 * np.pi * 2 * (t - t_a[0]) * 1e-9) for t in (t_a, t_b)]
    with pytest.raises(DegenerateMotionError, match="repeats"):
        estimate_time_offset(t_a, repeating[0], t_b, repeating[1])


def test_bad_signals_are_refused():
    (t_a, a, t_b, b), _ = streams(2)
    with pytest.raises(InvalidInputError):
        estimate_time_offset(t_a[::-1], a, t_b, b)
    with pytest.raises(InvalidInputError):
        estimate_time_offset(t_a, a * np.nan, t_b, b)
    with pytest.raises(InvalidInputError):
        estimate_time_offset(t_a, a, t_b, b[:, :2])
    with pytest.raises(InvalidInputError, match="lasts"):
        estimate_time_offset(t_a[:30], a[:30], t_b, b)


def taps(seed, *, num=8, speed_m_per_s=0.4):
    """A hand that falls onto a table and rests there, seen by a glove and by a tracker."""
    rng = np.random.default_rng(seed)
    offset_s = rng.uniform(-0.05, 0.05)
    touches_s = 1.0 + np.cumsum(rng.uniform(1.0, 1.3, num))
    t_a, t_b = np.arange(0, touches_s[-1] + 1, 1 / 60), np.arange(0, touches_s[-1] + 1, 1 / 100)
    since_a, since_b = (t[:, None] - touches_s for t in (t_a, t_b))
    pressure = np.where((since_a >= 0) & (since_a < 0.3), 20.0, 0.0).max(axis=1)
    falling = np.where((since_b > -0.25) & (since_b < 0), -speed_m_per_s * since_b, 0.0)
    rising = np.where(since_b >= 0.3, np.minimum(speed_m_per_s * (since_b - 0.3), 0.1), 0.0)
    height = np.where(since_b <= -0.25, 0.1, 0.0).min(axis=1) + (falling + rising).sum(axis=1)
    height = height + 0.0005 * rng.normal(size=len(t_b))
    stamps = [np.rint(t * 1e9).astype(np.int64) + BASE_NS for t in (t_a, t_b - offset_s)]
    return (stamps[0], pressure, stamps[1], height), offset_s


@pytest.mark.long
def test_taps_are_the_fallback(capsys):
    errors_ms, ratios = [], []
    for seed in range(6):
        taken, offset_s = taps(seed)
        found = estimate_tap_offset(*taken)
        errors_ms.append(found.offset_ns * 1e-6 - offset_s * 1e3)
        ratios.append(abs(errors_ms[-1]) / (found.sigma_ns * 1e-6))
    rms_ms = float(np.sqrt(np.mean(np.square(errors_ms))))
    with capsys.disabled():
        sys.stdout.write(
            f"\ntap offset, 8 taps: {rms_ms:.2f} ms RMS, bound 3 | {max(ratios):.1f} sigma, bound 3"
        )
    assert rms_ms <= 3
    assert max(ratios) <= 3


def test_what_is_no_tap_is_refused():
    (t_a, pressure, t_b, height), _ = taps(0)
    with pytest.raises(DegenerateMotionError, match="tap"):
        estimate_tap_offset(t_a, 0 * pressure, t_b, height)
    with pytest.raises(DegenerateMotionError, match="tap"):
        estimate_tap_offset(t_a, pressure, t_b, 0 * height)
    with pytest.raises(InvalidInputError, match="NaN"):
        estimate_tap_offset(t_a, pressure, t_b, height * np.nan)


@pytest.mark.parametrize("estimate", [estimate_time_offset, estimate_tap_offset])
def test_streams_without_samples_are_refused(estimate):
    """As of a device that was unplugged; one stream or both."""
    times_ns, values = BASE_NS + np.arange(300) * 10_000_000, np.ones(300)
    nothing = np.zeros(0, dtype=np.int64), np.zeros(0)
    for streams_of_take in ((*nothing, *nothing), (*nothing, times_ns, values)):
        with pytest.raises(InvalidInputError, match="got 0 stamps"):
            estimate(*streams_of_take)


def test_samples_that_come_in_bursts_take_no_finer_grid():
    """Four at a time within microseconds, as a busy host takes them from its buffers."""
    rng = np.random.default_rng(0)
    t_ns = np.arange(1200) * 10_000_000
    signal = np.convolve(rng.normal(size=1200), np.hanning(30), "same")
    number = np.arange(1200)
    bursts_ns = (number // 4 * 4 + 3) * 10_000_000 + number % 4 * 1000
    found = estimate_time_offset(t_ns, signal, bursts_ns, signal)
    # On average a sample comes one and a half periods late.
    assert abs(found.offset_ns + 15e6) < 3 * found.sigma_ns
    assert found.sigma_ns < 5e6
