"""Detection of steps and stops of a device's clock, and of single wrong stamps, in a whole take.

`fit_clock` splits a take at these before fitting, since a line across a step is wrong on both
sides.
"""

from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float64, Int64
from numpy.lib.stride_tricks import sliding_window_view

CONFIRM_S = 1.0
STEP_NS = 1_000_000.0
# A step must also exceed the usual scatter of the one-second minima by this factor.
SPREAD_FACTOR = 8.0
# A single stamp is wrong if its deviation exceeds the usual one by this factor.
WRONG_SCATTERS = 3.0
# How near to a change of level a jump of the stamps lies, in samples: a few late ones before a
# rise look risen too. Without regular stamps to tell, only next to it.
REACH = 30
IRREGULAR_REACH = 3
# Tolerances for matching jumps of stamps to changes of level, as shares of a sample period and of
# the change: the levels scatter.
MATCH_SHARE = 0.2
MATCH_CHANGE_SHARE = 0.5
REGULAR_QUANTILE = 0.9
# A clock that stood still shows in no distance of stamps, only in the arrivals: within a fifth of a
# second they become late, and stay so. A rise of so much must last for so long, by both clocks.
SUDDEN_RISES = ((25e6, 1_000_000_000), (5e6, 10_000_000_000))
# The path may have become longer little by little and then stay so: the fit follows after a minute
# anyway. A continuing rise is a change of rate.
GRADUAL_RISE = (5e6, 60_000_000_000)
SUDDEN_S = 0.2
# It was a delay if this many arrivals return within this time; single stamps may be wrong.
RETURN_NS = 120_000_000_000
MIN_RETURNED = 3
# What rises so near to the end of a take, and stays, is more often a delay than a stop, unless it
# rises by more than paths hold back without pause.
END_NS = 5_000_000_000
MAX_END_DELAY_NS = 500e6


class Steps(NamedTuple):
    """Steps and delays found in a take.

    Attributes:
        cuts: first samples after a step or a stop, in order.
        waiting: mask [n] of samples in delays of a second or more.
        is_unsure: whether stops and delays cannot be distinguished, because the take ends or the
            clock steps too soon after one, or stamps are irregular.
    """

    cuts: list[int]
    waiting: Bool[np.ndarray, " n"]
    is_unsure: bool


class _Rise(NamedTuple):
    """A lasting rise of the offset: a delay that ended before `last`, or (None) a stop."""

    first: int
    last: int | None
    is_unsure: bool


def find_steps(device: np.ndarray, host: np.ndarray) -> Steps:
    """Find steps and stops of a device's clock.

    A step persists, a delay does not: the minimum apparent offset of the second before is compared
    with that of the second after. For a regular device, a step is also visible in the distance of
    its stamps. A rise not visible there was a delay if it ended within two minutes; otherwise the
    clock stopped, or the path delay increased permanently, which is indistinguishable. In the last
    five seconds of a take a rise below half a second counts as a delay. Device time that goes back
    is always a step.
    """
    waiting = np.zeros(len(device), dtype=bool)
    is_unsure = False
    cuts: list[int] = (np.flatnonzero(np.diff(device) < 0) + 1).tolist()
    period_ns = float(np.median(np.diff(host)))
    count = int(np.clip(CONFIRM_S * 1e9 / max(period_ns, 1.0), 5, 500))
    if len(device) > 2 * count:
        levels = _Levels(device, host, count)
        stamps = _Stamps(device)
        for cut, change_ns in levels.changes():
            exact = stamps.place(cut, change_ns)
            if exact is not None and all(abs(exact - known) > count for known in cuts):
                cuts.append(exact)
                is_unsure |= change_ns > 0 and not stamps.is_regular
        for rise in levels.rises(sorted(cuts)):
            is_unsure |= rise.is_unsure
            if rise.last is None:
                cuts.append(rise.first)
            else:
                waiting[rise.first : rise.last] = True
    return Steps(sorted(set(cuts)), waiting, is_unsure)


def find_wrong_stamps(device: np.ndarray) -> Int64[np.ndarray, " k"]:
    """Indices of single stamps that are not whole periods from their two neighbours.

    Only for regular devices; for others none are found.
    """
    if len(device) < 3 or not (stamps := _Stamps(device)).is_regular:
        return np.empty(0, dtype=np.int64)
    period_ns = max(stamps.period_ns, 1.0)
    both_ns = (device[2:] - device[:-2]).astype(np.float64)
    first_ns = (device[1:-1] - device[:-2]).astype(np.float64)
    num_both = np.rint(both_ns / period_ns)
    num_first = np.clip(np.rint(first_ns / period_ns), 1, np.maximum(num_both - 1, 1))
    limit_ns = max(STEP_NS, WRONG_SCATTERS * stamps.scatter_ns)
    neighbours_agree = (num_both >= 2) & (np.abs(both_ns - num_both * period_ns) < limit_ns)
    is_off = np.abs(first_ns - num_first * period_ns) > limit_ns
    return np.flatnonzero(neighbours_agree & is_off).astype(np.int64) + 1


class _Levels:
    """Minimum apparent offsets of the second before and after each sample."""

    def __init__(self, device: np.ndarray, host: np.ndarray, count: int) -> None:
        self._device, self._host, self._count = device, host, count
        offset_ns = (host - device - (host[0] - device[0])).astype(np.float64)
        minima = sliding_window_view(offset_ns, count).min(axis=1)
        # At sample i (count … n - count): the least of the `count` samples before, and from it on.
        change_ns = minima[count:] - minima[: len(minima) - count]
        middle_ns = float(np.median(change_ns))
        spread_ns = float(np.median(np.abs(change_ns - middle_ns)))
        self._threshold_ns = STEP_NS + SPREAD_FACTOR * spread_ns
        # The median is a whole number of ticks where arrivals are; the mean is not.
        drift_ns = float(change_ns[np.abs(change_ns - middle_ns) <= self._threshold_ns].mean())
        self._change_ns = change_ns - drift_ns
        # The same from sample 1 on: before the first second is over, the least since the start.
        least_ns = np.minimum.accumulate(offset_ns[: count - 1])
        self._rise_ns = np.concatenate([minima[1:count] - least_ns, self._change_ns])
        # With the drift removed, levels that are minutes apart can be compared.
        elapsed = (host - host[0]) / float(np.median(host[count:] - host[:-count]))
        self._straight_ns = offset_ns - drift_ns * elapsed

    def changes(self) -> list[tuple[int, float]]:
        """Lasting changes of the one-second minimum, with their size."""
        change_ns, threshold_ns = self._change_ns, self._threshold_ns
        # A fall is visible up to the first fallen sample, a rise from the first risen one on.
        falls = [(b, change_ns[a : b + 1].min()) for a, b in _runs(-change_ns, threshold_ns)]
        rises = [(a, change_ns[a : b + 1].max()) for a, b in _runs(change_ns, threshold_ns)]
        return sorted((self._count + index, float(height)) for index, height in falls + rises)

    def rises(self, cuts: list[int]) -> list[_Rise]:
        """Lasting rises of the offset between known cuts, with their ends."""
        bounds = [0, *cuts, len(self._device)]
        found: list[_Rise] = []
        known = 0
        for index in (np.flatnonzero(self._rise_ns > self._threshold_ns) + 1).tolist():
            after = int(np.searchsorted(bounds, index, side="right"))
            first = max(bounds[after - 1], known, index - self._count)
            if first < index and (rise := self._rise(first, index, bounds[after])) is not None:
                found.append(rise)
                known = rise.first if rise.last is None else rise.last
        return found

    def _rise(self, first: int, index: int, last: int) -> _Rise | None:
        """The lasting rise at `index` above the samples from `first`, before the step at `last`."""
        y, host, device = self._straight_ns, self._host[index:last], self._device[index:last]
        before_ns = y[first:index].min()
        num_sudden = max(2, round(SUDDEN_S / CONFIRM_S * self._count))
        for least_ns, lasts_ns in (*SUDDEN_RISES, GRADUAL_RISE):
            ends = [int(np.searchsorted(t, t[0] + lasts_ns)) for t in (host, device)]
            num = max(*ends, self._count)
            if num >= last - index:
                return None
            risen = y[index : index + num]
            if risen.min() - before_ns <= max(least_ns, self._threshold_ns):
                continue
            level_ns = risen[num // 2 :].min()
            # Samples below the new level were delayed at the old one.
            early = np.flatnonzero(risen < level_ns - STEP_NS)
            start = index + int(early[-1]) + 1 if len(early) else index
            middle_ns = (before_ns + level_ns) / 2
            is_sudden = y[max(start - num_sudden, first) : start].min() < middle_ns
            rest_ns = risen[3 * num // 4 :].min() - risen[num // 4 : num // 2].min()
            is_level = (least_ns, lasts_ns) == GRADUAL_RISE and abs(rest_ns) < middle_ns - before_ns
            if is_sudden or is_level:
                return self._stop_or_delay(start, (first, index, last), (before_ns, level_ns))
        return None

    def _stop_or_delay(
        self, start: int, around: tuple[int, int, int], levels_ns: tuple[float, float]
    ) -> _Rise:
        """Classify a rise: after a delay, arrivals return below the middle of the two levels."""
        first, index, last = around
        host = self._host[index:last]
        within = int(np.searchsorted(host, host[0] + RETURN_NS))
        back = np.flatnonzero(self._straight_ns[index : index + within] < sum(levels_ns) / 2)
        if len(back) >= MIN_RETURNED:
            return _Rise(start, index + int(back[0]), is_unsure=False)
        is_at_end = last == len(self._host) and host[-1] - host[0] < END_NS
        is_delay = is_at_end and levels_ns[1] - levels_ns[0] < MAX_END_DELAY_NS
        # Less than a second of samples is too short to judge the end of the take.
        is_delay = is_delay and index - first >= self._count
        return _Rise(start, last if is_delay else None, is_unsure=within == len(host))


def _runs(change: np.ndarray, threshold: float) -> list[tuple[int, int]]:
    """First and last index of every run above the threshold."""
    above = np.concatenate([[False], change > threshold, [False]])
    edges = np.flatnonzero(np.diff(above.astype(np.int8)))
    return [(int(a), int(b) - 1) for a, b in edges.reshape(-1, 2)]


class _Stamps:
    """Distances of a device's stamps, to locate changes of level."""

    def __init__(self, device: np.ndarray) -> None:
        steps: Float64[np.ndarray, " m"] = np.diff(device).astype(np.float64)
        self.period_ns = float(np.median(steps))
        self._departures_ns = steps - self.period_ns
        self._tolerance_ns = MATCH_SHARE * self.period_ns
        beside_ns = self._beside_period(self._departures_ns)
        self.scatter_ns = float(np.quantile(beside_ns, REGULAR_QUANTILE))
        self.is_regular = self.scatter_ns < self._tolerance_ns / 2

    def place(self, cut: int, change_ns: float) -> int | None:
        """The first sample after the step near `cut`; None if it was only a delay."""
        reach = REACH if self.is_regular else IRREGULAR_REACH
        first, last = max(cut - reach, 1), min(cut + reach, len(self._departures_ns))
        departures_ns = self._departures_ns[first - 1 : last]
        if not self.is_regular:
            exact = int(np.argmax(np.abs(departures_ns)))
            return cut if np.abs(departures_ns[exact]) < STEP_NS / 2 else first + exact
        rest_ns = departures_ns + change_ns
        # Lost samples add whole periods to a distance, a delay adds none; what is left over of a
        # change by whole periods without any such jump is a delay.
        num_lost = np.maximum(np.rint(rest_ns / max(self.period_ns, 1.0)), 0)
        jumped = (num_lost == 0) | (self._beside_period(departures_ns) > self._tolerance_ns)
        misses_ns = np.abs(rest_ns - num_lost * self.period_ns)
        nearest = int(np.argmin(np.where(jumped, misses_ns, np.inf)))
        if jumped[nearest] and misses_ns[nearest] <= min(
            self._tolerance_ns, abs(change_ns) * MATCH_CHANGE_SHARE
        ):
            return first + nearest
        odd_ns = self._beside_period(departures_ns)
        odd = int(np.argmax(odd_ns))
        return first + odd if odd_ns[odd] > self._tolerance_ns else None

    def _beside_period(self, departures_ns: np.ndarray) -> Float64[np.ndarray, " m"]:
        """Distance of each to the nearest whole number of sample periods."""
        period_ns = max(self.period_ns, 1.0)
        return np.abs(departures_ns - period_ns * np.rint(departures_ns / period_ns))
