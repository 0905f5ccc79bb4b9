"""Counters, ticks, lines and steps against values worked out by hand or by another library."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial import ConvexHull

from dextouch.clocks import OnlineClock, fit_clock
from dextouch.clocks.clock_model import ClockModel, ClockSegment, corrected_stamps, find_steps
from dextouch.clocks.envelopes import LowerHull
from dextouch.clocks.online_clocks import DeviceCounter
from dextouch.errors import ClockFitError, InvalidInputError
from dextouch.streams import ClockCapabilities, SampleBatch, StreamDescriptor
from services.alignment.synchronization.stream_clock import time_stream

PERIOD_NS = 10_000_000
MS = 1_000_000
# 16 bits of milliseconds come round every 65.536 s.
MILLIS = ClockCapabilities(device_time=True, device_time_bits=16, tick_ns=MS)


def descriptor(capabilities):
    return StreamDescriptor(
        name="glove",
        kind="scalar",
        shape=(1,),
        dtype="float32",
        unit="1",
        nominal_rate_hz=100,
        capabilities=capabilities,
    )


@pytest.mark.parametrize("pause_s", [10, 40, 60, 100, 300])
def test_a_counter_goes_on_after_a_pause_of_any_length(pause_s):
    """Between two equal counts lie 0, 65.536 s, …; only the host's clock tells which."""
    counter = DeviceCounter(descriptor(MILLIS))
    before_ms, after_ms = 65_000, 65_000 + pause_s * 1000
    assert counter.straighten(10**15, before_ms * MS, None) == before_ms * MS
    # The second sample waits 3 ms longer than the first.
    t_host_ns = 10**15 + (pause_s * 1000 + 3) * MS
    assert counter.straighten(t_host_ns, after_ms % 65_536 * MS, None) == after_ms * MS


@pytest.mark.parametrize(
    ("bits", "before", "after"), [(62, 2**62 - 1, 2**62 + 3), (63, 2**62 + 2**61, 3)]
)
def test_a_counter_too_wide_to_wrap_starts_anew(bits, before, after):
    """62 bits of nanoseconds come round after 146 years, and a stamp still holds the sum."""
    wide = ClockCapabilities(device_time=True, device_time_bits=bits, tick_ns=1)
    counter = DeviceCounter(descriptor(wide))
    counter.straighten(10**15, before, None)
    assert counter.straighten(10**15 + 4, 3, None) == after


def test_a_pause_of_more_than_half_a_wrap_is_no_step():
    clock = OnlineClock(descriptor(MILLIS))
    sent_ms = np.concatenate([np.arange(0, 6000, 10), np.arange(46_000, 52_000, 10)])
    for t_ms in sent_ms.tolist():
        clock.update(t_host_ns=10**15 + t_ms * MS, t_device_ns=t_ms % 65_536 * MS)
    assert clock.num_steps == 0


def ticking_take():
    """Samples at all phases of a tick of 1 ms; every one arrives 2 ms after it was taken."""
    true_ns = 10**15 + np.arange(3000, dtype=np.int64) * 10_037_000
    return true_ns, true_ns // MS * MS, true_ns + 2 * MS


def test_times_of_ticking_stamps_have_no_bias_online():
    """A tick cuts off 0 … 1 ms, half a millisecond in the mean."""
    true_ns, device_ns, host_ns = ticking_take()
    clock = OnlineClock(descriptor(ClockCapabilities(device_time=True, tick_ns=MS)))
    pairs = zip(host_ns.tolist(), device_ns.tolist(), strict=True)
    got = [clock.update(t_host_ns=host, t_device_ns=device) for host, device in pairs]
    error_ns = np.array(got[600:]) - true_ns[600:] - 2 * MS
    assert abs(error_ns.mean()) < 50_000
    assert np.abs(error_ns).max() < 600_000


def test_times_of_ticking_stamps_have_no_bias_offline():
    true_ns, device_ns, host_ns = ticking_take()
    batch = SampleBatch(
        t_host_ns=host_ns,
        t_device_ns=device_ns,
        sequence=np.full(3000, -1),
        values=np.zeros((3000, 1), dtype=np.float32),
    )
    stream = descriptor(ClockCapabilities(device_time=True, tick_ns=MS))
    error_ns = time_stream(batch, stream).t_host_ns - true_ns - 2 * MS
    assert abs(error_ns.mean()) < 50_000


@pytest.mark.parametrize("seconds", [30, 300])
def test_a_model_goes_on_beyond_its_ends(seconds):
    """By 50 ppm: 3 ms a minute."""
    device_ns = np.arange(seconds * 100, dtype=np.int64) * PERIOD_NS
    to_host_ns = lambda t_ns: 10**15 + t_ns + t_ns * 50 // 1_000_000  # noqa: E731
    model = fit_clock(device_ns, to_host_ns(device_ns))
    beyond_ns = np.array([-60, -1, seconds, seconds + 60], dtype=np.int64) * 10**9
    np.testing.assert_allclose(model.to_host_ns(beyond_ns) - to_host_ns(beyond_ns), 0, atol=1000)


@settings(max_examples=60)
@given(
    st.lists(
        st.tuples(st.integers(0, 12), st.integers(-1000, 1000)), min_size=4, max_size=40
    ).filter(lambda points: len({x for x, _ in points}) > 2)
)
def test_the_lower_hull_is_that_of_qhull(points):
    """Several points may share an x: the lowest of them counts, in whatever order they come."""
    points = sorted(points, key=lambda point: point[0])
    hull = LowerHull()
    for x, y in points:
        hull.add(float(x), float(y))
    # A roof far above makes every vertex below it one of the lower hull.
    first, last = points[0][0], points[-1][0]
    roofed = np.array([*points, (first, 10**6), (last, 10**6)], dtype=np.float64)
    vertices = roofed[ConvexHull(roofed).vertices]
    wanted = sorted(map(tuple, vertices[vertices[:, 1] < 10**6].tolist()))
    assert list(hull) == wanted


def test_a_step_is_found_where_samples_were_lost_beside_another_odd_distance():
    """The timer hesitates once, ten samples later the clock jumps back and five samples are lost.

    By hand: 2.7 periods back and five lost make a distance of 1 + 5 - 2.7 = 3.3 periods, 0.3 beside
    a whole number; the hesitation alone is 0.45 beside one.
    """
    taken_ns = np.arange(1000, dtype=np.int64) * PERIOD_NS
    taken_ns[490:] += 4_500_000
    device_ns = taken_ns - (np.arange(1000) >= 500) * 27_000_000
    arrived = np.r_[0:500, 505:1000]
    waits_ns = np.arange(1000) * 7919 % 97 * 5000
    host_ns = (10**15 + taken_ns + waits_ns)[arrived]
    assert find_steps(device_ns[arrived], host_ns).cuts == [500]


def test_wrong_stamps_lie_alone_or_in_pairs_between_two_that_agree():
    right_ns = np.delete(np.arange(200, dtype=np.int64), [21, 60, 61]) * PERIOD_NS
    stamps_ns, host_ns = right_ns.copy(), right_ns + 5 * MS
    for wrong, by_ns in ((20, 3 * MS), (100, 43 * MS), (150, -2 * MS), (151, 4 * MS)):
        stamps_ns[wrong] += by_ns
    assert corrected_stamps(stamps_ns, host_ns).tolist() == right_ns.tolist()
    # Beside three lost ones the arrival tells which of the four it is.
    after_loss_ns = np.delete(np.arange(200, dtype=np.int64), [80, 81, 83]) * PERIOD_NS
    wrong_ns = after_loss_ns + 4 * MS * (after_loss_ns == 82 * PERIOD_NS)
    assert corrected_stamps(wrong_ns, after_loss_ns + MS).tolist() == after_loss_ns.tolist()


def test_what_is_no_wrong_stamp_stays():
    """Three in a row, a step, the ends, what overtook another, and devices without a rhythm."""
    stepped_ns = np.arange(200, dtype=np.int64) * PERIOD_NS
    stepped_ns[50:53] += 4_000_000
    stepped_ns[120:] += 7_000_000
    stepped_ns[[0, -1]] += 2_000_000
    stepped_ns[[80, 81]] = stepped_ns[[81, 80]]
    irregular_ns = np.sort(np.random.default_rng(0).uniform(0, 2e9, 200).astype(np.int64))
    for stamps_ns in (stepped_ns, irregular_ns):
        assert corrected_stamps(stamps_ns, stamps_ns + MS).tolist() == stamps_ns.tolist()


def test_no_sample_is_dated_after_its_arrival():
    device_ns = np.arange(600, dtype=np.int64) * PERIOD_NS
    host_ns = 10**15 + device_ns + 2 * MS
    model = fit_clock(device_ns, host_ns)
    ahead_ns = device_ns[300:301] + 7 * MS
    assert model.to_host_ns(ahead_ns, host_ns[300:301]).tolist() == host_ns[300:301].tolist()
    assert model.to_host_ns(ahead_ns).tolist() == (host_ns[300:301] + 7 * MS).tolist()


def test_an_arrival_between_two_segments_belongs_to_the_nearer_one():
    """The clock is set back by 3 s between two samples; later samples of others are dated too."""
    taken_ns = np.arange(800, dtype=np.int64) * PERIOD_NS
    stepped_ns = (np.arange(800) >= 400) * 3_000_000_000
    model = fit_clock(taken_ns - stepped_ns, 10**15 + taken_ns)
    for after_ms, device_ns in ((4, 3_992 * MS), (6, 994 * MS)):
        # Sent by the old clock, and by the new one; both arrive 2 ms later.
        arrived_ns = np.array([10**15 + (3_990 + after_ms) * MS])
        dated_ns = model.to_host_ns(np.array([device_ns]), arrived_ns)
        np.testing.assert_allclose(dated_ns - arrived_ns, -2 * MS, atol=10)


def test_late_samples_beside_a_gap_do_not_bend_the_line():
    """Of the window from 60 to 120 s, 10 s and two late samples are left: a slope of 0.4 %."""
    device_ns = np.arange(15_000, dtype=np.int64) * PERIOD_NS
    device_ns = device_ns[(device_ns <= 70 * 10**9) | (device_ns >= 119_980_000_000)]
    late_ns = np.where(device_ns // 10**9 == 119, 200 * MS, 0)
    host_ns = np.maximum.accumulate(10**15 + device_ns + late_ns)
    model = fit_clock(device_ns, host_ns)
    assert model.num_steps == 0
    np.testing.assert_allclose(model.to_host_ns(device_ns) - device_ns - 10**15, 0, atol=MS)


def segment(start_device_ns, stop_device_ns, offset_ns):
    start_host_ns = start_device_ns + offset_ns
    knots = np.array([0.0, 1.0]), np.zeros(2)
    return ClockSegment(start_device_ns, stop_device_ns, start_host_ns, 0, offset_ns, *knots)


@pytest.mark.parametrize(("back_to_ns", "is_ambiguous"), [(1001, False), (1000, True), (5, True)])
def test_a_device_time_that_came_twice_needs_an_arrival(back_to_ns, is_ambiguous):
    segments = segment(0, 1000, 10**15), segment(back_to_ns, 3000, 10**15 + 2000)
    model = ClockModel(segments, skew_ppm=0.0, residual_rms_ns=0.0)
    assert model.is_ambiguous == is_ambiguous
    if is_ambiguous:
        with pytest.raises(InvalidInputError, match="two moments"):
            model.to_host_ns(np.array([1000]))
    else:
        assert model.to_host_ns(np.array([1000, 1001])).tolist() == [10**15 + 1000, 10**15 + 3001]


@pytest.mark.parametrize(
    ("count", "backs", "is_refused"),
    [(12, 1, False), (12, 2, True), (300, 3, False), (300, 4, True)],
)
def test_a_clock_may_be_set_back_once_or_every_hundredth_sample(count, backs, is_refused):
    device_ns = np.arange(count, dtype=np.int64) * PERIOD_NS + 10**12
    host_ns = device_ns + 10**15
    for number in range(1, backs + 1):
        device_ns[number * count // (backs + 1) :] -= 3_000_000_000
    if not is_refused:
        assert fit_clock(device_ns, host_ns).num_steps == backs
        return
    with pytest.raises(ClockFitError, match=f"{backs} of {count} device stamps run back"):
        fit_clock(device_ns, host_ns)


def test_samples_of_one_clump_lie_on_their_own_side_of_a_step():
    """Four samples before the step and six after it arrive at the same moment."""
    taken_ns = np.arange(800, dtype=np.int64) * PERIOD_NS
    device_ns = taken_ns - (np.arange(800) >= 400) * 3_000_000_000
    host_ns = 10**15 + taken_ns + 2 * MS
    host_ns[396:406] = host_ns[405]
    model = fit_clock(device_ns, host_ns)
    error_ns = model.to_host_ns(device_ns, host_ns) - 10**15 - taken_ns - 2 * MS
    np.testing.assert_allclose(error_ns, 0, atol=10)
