"""Steps of a regular device's clock: their size comes from the stamps, where the stamps tell it."""

import numpy as np
import pytest

from dextouch.clocks import OnlineClock
from dextouch.clocks.envelopes import LEARNED_DISTANCES, MAX_ODD, Rhythm

PERIOD_NS = 16_666_667
LATE_NS = 500_000


def test_a_rhythm_is_learned_refined_and_forgotten():
    rhythm = Rhythm()
    assert (rhythm.period_s, rhythm.is_odd(0.013)) == (None, False)
    for number in range(LEARNED_DISTANCES):
        rhythm.add(0.02 if number % 8 == 3 else 0.01)
    assert rhythm.period_s == 0.01
    assert not rhythm.is_odd(0.03)
    assert rhythm.is_odd(0.013)
    assert rhythm.is_odd(-0.013)
    for _ in range(1000):
        rhythm.add(0.01001)
    assert rhythm.period_s == pytest.approx(0.01001, rel=1e-6)
    for _ in range(MAX_ODD + 1):
        rhythm.add(0.013)
    assert rhythm.period_s is None


@pytest.mark.parametrize("scatter_s", [0.0005, 0.003])
def test_an_irregular_device_has_no_rhythm(scatter_s):
    rng = np.random.default_rng(0)
    rhythm = Rhythm()
    for distance_s in rng.normal(0.0167, scatter_s, 500):
        rhythm.add(float(distance_s))
    assert rhythm.period_s is None
    assert not rhythm.is_odd(0.013)


def errors_ms(clock, device_ns, true_ns, delay_ns):
    times = zip(device_ns.tolist(), (true_ns + delay_ns).tolist(), strict=True)
    got = [clock.update(t_host_ns=host, t_device_ns=device) for device, host in times]
    return (np.array(got) - true_ns) * 1e-6


@pytest.mark.parametrize("step_ns", [-30_000_000, 200_000_000, -5_000_000_000, -23_456_789])
@pytest.mark.parametrize("first_late_ns", [LATE_NS, 40_000_000])
def test_a_step_of_a_regular_device_needs_no_quick_sample(step_ns, first_late_ns):
    """The next hundred samples all wait for half a millisecond and more; they are dated exactly."""
    true_ns = np.arange(700, dtype=np.int64) * PERIOD_NS + 10**15
    stepped = np.arange(700) >= 600
    delay_ns = np.arange(700) * 7919 % 97 * 30_000 + stepped * LATE_NS
    delay_ns[600] = first_late_ns
    # Nothing overtakes: a late packet holds up those behind it.
    delay_ns = np.maximum.accumulate(true_ns + delay_ns) - true_ns
    clock = OnlineClock()
    error = errors_ms(clock, true_ns - 10**14 + stepped * step_ns, true_ns, delay_ns)
    # A sample that waits for more than a period hides whole periods of the step at first.
    settled_index = 600 if first_late_ns == LATE_NS else 604
    np.testing.assert_allclose(error[60:600], 0, atol=0.1)
    np.testing.assert_allclose(error[settled_index:], 0, atol=0.1)
    assert clock.num_steps == 1


@pytest.mark.parametrize("phase_ns", [600_000, 3_000_000, 9_000_000, 16_000_000])
def test_a_restarted_device_samples_at_other_moments(phase_ns):
    """Then its stamps do not tell the step, and what was moved by them is given up."""
    restarted = np.arange(1200) >= 600
    true_ns = np.arange(1200, dtype=np.int64) * PERIOD_NS + 10**15 + restarted * phase_ns
    delay_ns = np.arange(1200) * 7919 % 97 * 30_000
    device_ns = true_ns - 10**14
    device_ns[600:] -= device_ns[600]
    clock = OnlineClock()
    error = errors_ms(clock, device_ns, true_ns, delay_ns)
    np.testing.assert_allclose(error[1100:], 0, atol=0.1)
    np.testing.assert_allclose(error[640:], 0, atol=0.65)
    assert clock.num_steps == 1


def late_after(seconds, *, lasts_s, late_ns):
    """A minute of ordinary delays; for a while every sample waits longer."""
    true_ns = np.arange(60 * 60, dtype=np.int64) * PERIOD_NS + 10**15
    since_s = (true_ns - true_ns[0]) * 1e-9 - seconds
    delay_ns = np.arange(len(true_ns)) * 7919 % 97 * 30_000
    delay_ns = delay_ns + late_ns * ((since_s >= 0) & (since_s < lasts_s))
    return true_ns, np.maximum.accumulate(true_ns + delay_ns) - true_ns


@pytest.mark.parametrize("lasts_s", [1.5, 8.0])
@pytest.mark.parametrize("late_ns", [5_000_000, 60_000_000])
def test_a_busy_host_is_no_step_of_a_regular_devices_clock(lasts_s, late_ns):
    true_ns, delay_ns = late_after(30, lasts_s=lasts_s, late_ns=late_ns)
    clock = OnlineClock()
    error = errors_ms(clock, true_ns - 10**14, true_ns, delay_ns)
    np.testing.assert_allclose(error[60:], 0, atol=0.1)
    assert clock.num_steps == 0


def test_a_path_that_became_longer_for_good_is_believed_after_ten_seconds():
    true_ns, delay_ns = late_after(30, lasts_s=1000, late_ns=5_000_000)
    clock = OnlineClock()
    error = errors_ms(clock, true_ns - 10**14, true_ns, delay_ns)
    np.testing.assert_allclose(error[60 * 29 : 60 * 39], 0, atol=0.1)
    np.testing.assert_allclose(error[60 * 41 :], 5, atol=0.1)
    assert clock.num_steps == 1
