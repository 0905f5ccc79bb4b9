"""Device stamps and arrivals of a take in, the samples at which the device's clock jumped out."""

import numpy as np
from jaxtyping import Float64
from numpy.lib.stride_tricks import sliding_window_view

CONFIRM_S = 1.0
STEP_NS = 1_000_000.0
# A step must also stand out this far above the usual scatter of the one-second minima.
SPREAD_FACTOR = 8.0
# How near to a change of level a jump of the stamps lies, in samples: a few late ones before a
# rise look risen too. Without regular stamps to tell, only next to it.
REACH = 30
IRREGULAR_REACH = 3
# Jumps of stamps and changes of level are the same to these shares of a sample period and of the
# change: the levels scatter.
MATCH_SHARE = 0.2
MATCH_CHANGE_SHARE = 0.5
REGULAR_QUANTILE = 0.9


def find_steps(device: np.ndarray, host: np.ndarray) -> list[int]:
    """Indices of the first samples after a step of the device's clock, in increasing order.

    A step lasts, a delay does not: the smallest apparent offset of the second before is compared
    with that of the second after. Where a device samples regularly, a step shows in the distance
    of its stamps too, and what does not show there was a delay, however long. Where device time
    runs back there is a step in any case.
    """
    backward = (np.flatnonzero(np.diff(device) < 0) + 1).tolist()
    period_ns = float(np.median(np.diff(host)))
    count = int(np.clip(CONFIRM_S * 1e9 / max(period_ns, 1.0), 5, 500))
    cuts: list[int] = list(backward)
    if len(device) > 2 * count:
        offset_ns = (host - device - (host[0] - device[0])).astype(np.float64)
        stamps = _Stamps(device)
        for cut, change_ns in _level_changes(offset_ns, count):
            exact = stamps.place(cut, change_ns)
            if exact is not None and all(abs(exact - known) > count for known in cuts):
                cuts.append(exact)
    return sorted(set(cuts))


def _level_changes(offset_ns: np.ndarray, count: int) -> list[tuple[int, float]]:
    """Where the one-second minimum changes for good, and by how much."""
    minima = sliding_window_view(offset_ns, count).min(axis=1)
    # At sample i (count … n - count): the least of the `count` samples before, and from it on.
    change = minima[count:] - minima[: len(minima) - count]
    spread = float(np.median(np.abs(change - np.median(change))))
    threshold = STEP_NS + SPREAD_FACTOR * spread
    # A fall shows until the first fallen sample, a rise from the first risen one on.
    falls = [(last, change[first : last + 1].min()) for first, last in _runs(-change, threshold)]
    rises = [(first, change[first : last + 1].max()) for first, last in _runs(change, threshold)]
    return sorted((count + index, float(height)) for index, height in falls + rises)


def _runs(change: np.ndarray, threshold: float) -> list[tuple[int, int]]:
    """First and last index of every stretch above the threshold."""
    above = np.concatenate([[False], change > threshold, [False]])
    edges = np.flatnonzero(np.diff(above.astype(np.int8)))
    return [(int(a), int(b) - 1) for a, b in edges.reshape(-1, 2)]


class _Stamps:
    """The distances of a device's stamps: does a change of level show in them, and where?"""

    def __init__(self, device: np.ndarray) -> None:
        steps: Float64[np.ndarray, " m"] = np.diff(device).astype(np.float64)
        self._period_ns = float(np.median(steps))
        self._departures_ns = steps - self._period_ns
        self._tolerance_ns = MATCH_SHARE * self._period_ns
        scatter_ns = np.quantile(self._beside_period(self._departures_ns), REGULAR_QUANTILE)
        self._is_regular = bool(scatter_ns < self._tolerance_ns / 2)

    def place(self, cut: int, change_ns: float) -> int | None:
        """The first sample after the step near `cut`; None where there was none, only a delay.

        Args:
            cut: first sample after a change of level, give or take a few.
            change_ns: of the apparent offset: a clock that goes back makes it rise.
        """
        reach = REACH if self._is_regular else IRREGULAR_REACH
        first, last = max(cut - reach, 1), min(cut + reach, len(self._departures_ns))
        departures_ns = self._departures_ns[first - 1 : last]
        if not self._is_regular:
            exact = int(np.argmax(np.abs(departures_ns)))
            return cut if np.abs(departures_ns[exact]) < STEP_NS / 2 else first + exact
        rest_ns = departures_ns + change_ns
        # Lost samples add whole periods to a distance, a delay adds none; what is left over of a
        # change by whole periods without any such jump is a delay.
        num_lost = np.maximum(np.rint(rest_ns / max(self._period_ns, 1.0)), 0)
        jumped = (num_lost == 0) | (self._beside_period(departures_ns) > self._tolerance_ns)
        misses_ns = np.abs(rest_ns - num_lost * self._period_ns)
        nearest = int(np.argmin(np.where(jumped, misses_ns, np.inf)))
        if jumped[nearest] and misses_ns[nearest] <= min(
            self._tolerance_ns, abs(change_ns) * MATCH_CHANGE_SHARE
        ):
            return first + nearest
        odd_ns = self._beside_period(departures_ns)
        odd = int(np.argmax(odd_ns))
        return first + odd if odd_ns[odd] > self._tolerance_ns else None

    def _beside_period(self, departures_ns: np.ndarray) -> Float64[np.ndarray, " m"]:
        """How far each lies from a whole number of sample periods."""
        period_ns = max(self._period_ns, 1.0)
        return np.abs(departures_ns - period_ns * np.rint(departures_ns / period_ns))
