"""Offsets from questions and answers: their error, their sigma, steps and refusals."""

import numpy as np
import pytest

from dextouch.clocks import KnownSkew, RoundTrip, RoundTripClock
from dextouch.errors import ClockFitError, InvalidInputError

START_NS = 10**18


def ask(clock, rng, *, count, offset_ns, skew=0.0, ways_ns=(3e5, 3e5), first_s=0.0):
    """Exchanges once a second over two ways with their own smallest delays."""
    remote = lambda t_ns: int(t_ns + offset_ns + (t_ns - START_NS) * skew)  # noqa: E731
    for k in range(count):
        sent_ns = START_NS + int((first_s + k) * 1e9)
        there_ns, back_ns = (int(way_ns + rng.exponential(3e5)) for way_ns in ways_ns)
        read_ns = sent_ns + there_ns
        answered_ns = read_ns + 50_000
        clock.add(RoundTrip(sent_ns, remote(read_ns), remote(answered_ns), answered_ns + back_ns))
    return remote


def test_error_is_as_large_as_its_sigma_says():
    errors = []
    for seed in range(60):
        rng = np.random.default_rng(seed)
        clock = RoundTripClock()
        remote = ask(
            clock,
            rng,
            count=int(rng.integers(1, 200)),
            offset_ns=int(rng.integers(-(10**15), 10**15)),
            skew=rng.uniform(-5e-5, 5e-5),
            ways_ns=rng.uniform(1e5, 1e6, 2),
        )
        found = clock.estimate()
        true_ns = remote(found.at_local_ns) - found.at_local_ns
        errors.append((found.offset_ns - true_ns) / found.sigma_ns)
        assert clock.num_steps == 0
        assert found.delay_ns > 0
    assert np.mean(np.abs(errors) <= 2) >= 0.95
    # Not merely by being cautious.
    assert 0.3 <= np.sqrt(np.mean(np.square(errors))) <= 1.3


def test_drift_is_known_after_minutes():
    clock = RoundTripClock()
    remote = ask(clock, np.random.default_rng(0), count=300, offset_ns=0, skew=4e-5)
    assert clock.estimate().skew_ppm == pytest.approx(40, abs=3)
    later_ns = START_NS + 360 * 10**9
    assert clock.estimate(later_ns).offset_ns == pytest.approx(remote(later_ns) - later_ns, abs=3e5)
    assert clock.estimate(later_ns).sigma_ns >= clock.estimate().sigma_ns


def test_a_drift_that_samples_know_makes_the_first_seconds_sure():
    clock = RoundTripClock()
    remote = ask(clock, np.random.default_rng(0), count=20, offset_ns=0, skew=8e-5)
    alone, told = clock.estimate(), clock.estimate(skew=KnownSkew(80.0, 2.0))
    true_ns = remote(told.at_local_ns) - told.at_local_ns
    assert told.skew_ppm == 80.0
    assert abs(told.offset_ns - true_ns) <= 3 * told.sigma_ns
    assert told.sigma_ns < 0.5 * alone.sigma_ns
    vague = clock.estimate(skew=KnownSkew(-80.0, 1000.0))
    assert vague == alone, "what is known worse is not used"


@pytest.mark.parametrize("step_ns", [5_000_000, -5_000_000, 10**12])
def test_a_stepped_remote_clock_starts_anew(step_ns):
    clock, rng = RoundTripClock(), np.random.default_rng(1)
    ask(clock, rng, count=100, offset_ns=7)
    ask(clock, rng, count=20, offset_ns=7 + step_ns, first_s=100)
    assert (clock.num_steps, clock.num_exchanges) == (1, 20)
    assert clock.estimate().offset_ns == pytest.approx(7 + step_ns, abs=1_000_000)


def test_latency_of_a_path_is_found():
    """A device whose samples take 4 ms; its answers come back in 0.6 ms."""
    clock = RoundTripClock()
    ask(clock, np.random.default_rng(2), count=50, offset_ns=-123_456_789)
    true_ns = START_NS + 49 * 10**9
    found = clock.latency(t_remote_ns=true_ns - 123_456_789, t_estimated_ns=true_ns + 4_000_000)
    assert abs(found.latency_ns - 4_000_000) <= 2 * found.sigma_ns
    assert found.sigma_ns < 500_000


def test_impossible_exchanges_are_refused():
    clock = RoundTripClock()
    with pytest.raises(ClockFitError):
        clock.estimate()
    with pytest.raises(InvalidInputError, match="order"):
        clock.add(RoundTrip(100, 0, 0, 99))
    with pytest.raises(InvalidInputError, match="unit"):
        clock.add(RoundTrip(100, 0, 50, 120))
    clock.add(RoundTrip(100, 0, 0, 120))
    with pytest.raises(InvalidInputError, match="order"):
        clock.add(RoundTrip(90, 0, 0, 120))


def test_memory_of_a_day_is_bounded():
    clock = RoundTripClock()
    ask(clock, np.random.default_rng(3), count=5000, offset_ns=0, skew=1e-5)
    assert clock.num_exchanges == 5000
    assert clock.estimate().sigma_ns < 500_000
