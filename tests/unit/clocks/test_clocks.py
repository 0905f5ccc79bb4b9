"""Counters, hulls, clock models and their refusals."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from dextouch.clocks import OnlineClock, count_lost_samples, fit_clock, unwrap_counter
from dextouch.clocks.envelopes import MAX_VERTICES, LowerHull
from dextouch.errors import ClockFitError, InvalidInputError, ShapeError
from dextouch.streams import ClockCapabilities, StreamDescriptor

PERIOD_NS = 16_666_667


def descriptor(**capabilities):
    return StreamDescriptor(
        name="glove",
        kind="tactile",
        shape=(360,),
        dtype="uint16",
        unit="counts",
        nominal_rate_hz=60,
        capabilities=ClockCapabilities(**capabilities),
    )


@given(st.lists(st.integers(1, 120), min_size=1, max_size=50), st.integers(0, 255))
def test_unwrapped_counter_keeps_every_step(steps, start):
    straight = np.cumsum([start, *steps])
    np.testing.assert_array_equal(np.diff(unwrap_counter(straight % 256, modulus=256)), steps)


def test_arrivals_resolve_silences_longer_than_a_wrap():
    straight = np.array([0, 100, 5000, 5100])
    arrivals = straight + 10**15 + np.array([3, 0, 20, 1])
    np.testing.assert_array_equal(
        unwrap_counter(straight % 1000, modulus=1000, hint=arrivals), straight
    )


def test_bad_counters_are_refused():
    with pytest.raises(InvalidInputError):
        unwrap_counter(np.array([0, 256]), modulus=256)
    with pytest.raises(ShapeError):
        unwrap_counter(np.array([0.5]), modulus=256)
    with pytest.raises(InvalidInputError):
        count_lost_samples(np.arange(3), bits=4)


def test_lost_samples_are_counted_but_not_restarts():
    assert count_lost_samples(np.array([254, 255, 1, 2, 2, 7, 0]), bits=8) == 5


@settings(max_examples=50)
@given(st.lists(st.floats(-100, 100), min_size=2, max_size=60), st.floats(0, 1))
def test_supporting_line_is_highest_line_below_all_points(heights, where):
    hull = LowerHull()
    for x, y in enumerate(heights):
        hull.add(float(x), y)
    at = where * (len(heights) - 1)
    line = hull.supporting_line(at)
    assert all(line.at(float(x)) <= y + 1e-9 for x, y in enumerate(heights))
    # Brute force: the lower envelope at `at` is the least chord over it.
    chords = [
        heights[a] + (heights[b] - heights[a]) * (at - a) / (b - a)
        for a in range(len(heights))
        for b in range(a + 1, len(heights))
        if a <= at <= b
    ]
    assert line.at(at) == pytest.approx(min(chords), abs=1e-9)


def test_hull_memory_is_bounded():
    hull = LowerHull()
    for n in range(5000):
        hull.add(n * 0.01, float(n * n))
    assert len(list(hull)) <= MAX_VERTICES


@pytest.mark.parametrize(
    ("device", "host", "cause"),
    [
        (np.arange(5), np.arange(5), "too_few"),
        (np.arange(20.0) * np.nan, np.arange(20), "not_finite"),
        (np.arange(20), np.arange(20)[::-1], "not_increasing"),
        (np.arange(20)[::-1], np.arange(20), "not_increasing"),
        (np.full(20, 7), np.arange(20), "not_increasing"),
        (np.arange(20), np.arange(21), "length"),
    ],
)
def test_refusals_name_their_cause(device, host, cause):
    with pytest.raises(ClockFitError) as refusal:
        fit_clock(device, host)
    assert refusal.value.details["cause"] == cause


def test_exact_clock_is_met_to_the_nanosecond_far_from_zero():
    device = 2**60 + np.arange(1000, dtype=np.int64) * PERIOD_NS
    model = fit_clock(device, device - 2**61)
    np.testing.assert_array_equal(model.to_host_ns(device), device - 2**61)
    assert (model.skew_ppm, model.num_steps) == (0.0, 0)


def test_clock_that_went_back_needs_arrivals():
    host = np.arange(1200, dtype=np.int64) * PERIOD_NS
    device = np.where(host < host[600], host, host - 5_000_000_000)
    model = fit_clock(device, host)
    with pytest.raises(InvalidInputError, match="t_host_ns"):
        model.to_host_ns(device)
    np.testing.assert_allclose(model.to_host_ns(device, host), host, atol=10)


def test_online_clock_follows_wrapping_and_sequence_only_devices():
    true = np.arange(600, dtype=np.int64) * PERIOD_NS + 10**15
    late = true + 2_000_000 + (np.arange(600) * 7919 % 97) * 50_000
    ticks_ns = true // 1_000_000 * 1_000_000
    wrapped = ticks_ns % (2**16 * 1_000_000)
    by_time = OnlineClock(descriptor(device_time=True, device_time_bits=16, tick_ns=1_000_000))
    by_sequence = OnlineClock(descriptor(sequence=True, sequence_bits=8))
    got_time = [
        by_time.update(t_host_ns=int(h), t_device_ns=int(d))
        for h, d in zip(late, wrapped, strict=True)
    ]
    got_sequence = [
        by_sequence.update(t_host_ns=int(h), sequence=n % 256) for n, h in enumerate(late)
    ]
    assert (by_time.source, by_sequence.source) == ("device", "sequence")
    # Stamps of 1 ms cut off up to as much; in the mean little is left of it.
    error_ns = np.array(got_time[120:]) - true[120:] - 2_000_000
    np.testing.assert_allclose(error_ns, 0, atol=1_000_000)
    assert abs(error_ns.mean()) < 300_000
    np.testing.assert_allclose(np.array(got_sequence[120:]) - true[120:], 2_000_000, atol=50_000)


def test_online_clock_without_stamps_gives_arrivals_in_order():
    clock = OnlineClock()
    assert [clock.update(t_host_ns=t, t_device_ns=-1) for t in (5, 9, 9, 9)] == [5, 9, 10, 11]
    assert clock.source == "arrival"


def test_vanishing_stamps_are_refused():
    clock = OnlineClock()
    clock.update(t_host_ns=5, t_device_ns=1)
    with pytest.raises(InvalidInputError, match="device"):
        clock.update(t_host_ns=6)
