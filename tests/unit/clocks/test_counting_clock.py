"""Samples without stamps: what is counted, what is final, and what is refused."""

import numpy as np
import pytest

from dextouch.clocks import CountingClock, date_by_counting
from dextouch.clocks.online_clocks import LOOK_AHEAD
from dextouch.errors import InvalidInputError

PERIOD_NS = 10_000_000


def arrivals(numbers, late=()):
    times_ns = np.asarray(numbers, dtype=np.int64) * PERIOD_NS + 10**15
    for place, wait_ns in late:
        times_ns[place] += wait_ns
    return np.maximum.accumulate(times_ns)


def test_final_times_come_ten_samples_later_and_in_order():
    clock = CountingClock(PERIOD_NS)
    final = []
    for k, arrival_ns in enumerate(arrivals(range(100)).tolist()):
        final.extend(clock.advance(arrival_ns))
        assert len(final) == max(0, k + 1 - LOOK_AHEAD)
    final.extend(clock.flush())
    assert [sample.number for sample in final] == list(range(100))
    np.testing.assert_allclose([s.t_host_ns for s in final], arrivals(range(100)), atol=10)


def test_lost_samples_are_counted_and_late_ones_are_not():
    numbers = [n for n in range(200) if n not in {50, 90, 91}]
    late = [(30, 40_000_000), (120, 70_000_000)]
    found = date_by_counting(arrivals(numbers, late), period_ns=PERIOD_NS)
    assert found.number.tolist() == numbers
    assert (found.num_lost, found.num_steps) == (3, 0)
    np.testing.assert_allclose(found.t_host_ns, arrivals(numbers), atol=1000)


def test_a_draining_queue_is_waited_for():
    """Thirty samples arrive at once: only the last of them tells that none was lost."""
    times_ns = arrivals(range(200))
    times_ns[100:131] = times_ns[130]
    found = date_by_counting(times_ns, period_ns=PERIOD_NS)
    assert found.number.tolist() == list(range(200))
    np.testing.assert_allclose(found.t_host_ns, arrivals(range(200)), atol=1000)


def test_arrivals_out_of_order_are_refused():
    clock = CountingClock(PERIOD_NS)
    clock.advance(100)
    with pytest.raises(InvalidInputError, match="order of arrival"):
        clock.advance(99)
    with pytest.raises(InvalidInputError, match="period"):
        CountingClock(0)
