"""The window of the last seconds that the judges look at."""

import numpy as np

from services.acquisition.health.evaluation import MIN_ROLLING, CountWindow, Rolling


def test_only_the_last_span_is_kept_whatever_comes(rng):
    rolling = Rolling(1000)
    all_ns, all_values = np.empty(0, dtype=np.int64), np.empty(0)
    for now_ns in range(0, 20_000, 300):
        count = int(rng.integers(0, 200))
        # Stamps need not be in order: a device may be opened anew.
        t_ns, values = rng.integers(now_ns - 300, now_ns + 1, count), rng.normal(size=count)
        all_ns, all_values = np.append(all_ns, t_ns), np.append(all_values, values)
        kept = all_ns >= now_ns - 1000
        np.testing.assert_array_equal(rolling.add(t_ns, values, now_ns), all_values[kept])
        np.testing.assert_array_equal(rolling.values, all_values[kept])
        np.testing.assert_array_equal(rolling.t_ns, all_ns[kept])


def test_its_arrays_stay_the_same_once_a_span_is_full(rng):
    rolling = Rolling(1000)
    arrays = set()
    for now_ns in range(0, 50_000, 100):
        t_ns = np.full(int(rng.integers(20, 30)), now_ns)
        rolling.add(t_ns, np.ones(len(t_ns)), now_ns)
        if now_ns > 1000:
            arrays.add((id(rolling._t_ns), id(rolling._values), len(rolling._t_ns)))
    assert len(arrays) == 1
    assert len(rolling._t_ns) == 8 * MIN_ROLLING


def test_counts_grow_since_the_last_look_that_is_ten_seconds_old():
    # Second of each look, the counter then, and by hand its growth: since the first look, from 10 s
    # on since the one at 0, 4, 8 and 19 s.
    looks = [(4, 1, 1), (8, 2, 2), (10, 4, 4), (14, 8, 7), (19, 16, 14), (40, 20, 4)]
    counts = {"lost": 0}
    window = CountWindow(lambda: dict(counts))
    for second, count, grown in looks:
        counts["lost"] = count
        assert window.growth(second * 10**9)["lost"] == grown
