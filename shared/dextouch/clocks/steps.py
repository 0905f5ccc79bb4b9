"""Device stamps and arrivals of a take in, the samples at which the device's clock jumped out."""

import numpy as np
from jaxtyping import Float64
from numpy.lib.stride_tricks import sliding_window_view

CONFIRM_S = 1.0
THRESHOLD_NS = 4_000_000.0
# A step must also stand out this far above the usual scatter of the one-second minima.
SPREAD_FACTOR = 8.0


def find_steps(device: np.ndarray, host: np.ndarray) -> list[int]:
    """Indices of the first samples after a step of the device's clock, in increasing order.

    A step lasts, a delay does not: the smallest apparent offset of the second before is compared
    with that of the second after. Where device time runs back there is a step in any case.
    """
    backward = (np.flatnonzero(np.diff(device) < 0) + 1).tolist()
    period_ns = float(np.median(np.diff(host)))
    count = int(np.clip(CONFIRM_S * 1e9 / max(period_ns, 1.0), 5, 500))
    cuts: list[int] = list(backward)
    if len(device) > 2 * count:
        offset_ns = (host - device - (host[0] - device[0])).astype(np.float64)
        for cut in _level_changes(offset_ns, count):
            exact = _largest_jump(device, cut)
            if all(abs(exact - known) > count for known in cuts):
                cuts.append(exact)
    return sorted(set(cuts))


def _level_changes(offset_ns: np.ndarray, count: int) -> list[int]:
    minima = sliding_window_view(offset_ns, count).min(axis=1)
    # At sample i (count … n - count): the least of the `count` samples before, and from it on.
    change = minima[count:] - minima[: len(minima) - count]
    spread = float(np.median(np.abs(change - np.median(change))))
    threshold = THRESHOLD_NS + SPREAD_FACTOR * spread
    # A fall shows until the first fallen sample, a rise from the first risen one on.
    falls = [last for _, last in _runs(-change, threshold)]
    rises = [first for first, _ in _runs(change, threshold)]
    return sorted(count + index for index in falls + rises)


def _runs(change: np.ndarray, threshold: float) -> list[tuple[int, int]]:
    """First and last index of every stretch above the threshold."""
    above = np.concatenate([[False], change > threshold, [False]])
    edges = np.flatnonzero(np.diff(above.astype(np.int8)))
    return [(int(a), int(b) - 1) for a, b in edges.reshape(-1, 2)]


def _largest_jump(device: np.ndarray, cut: int, *, reach: int = 3) -> int:
    """The sample next to `cut` before which device time departs most from its usual step."""
    first, last = max(cut - reach, 1), min(cut + reach + 1, len(device))
    around: Float64[np.ndarray, " m"] = np.diff(device[first - 1 : last]).astype(np.float64)
    departure = np.abs(around - np.median(around))
    return cut if departure.max() < THRESHOLD_NS / 2 else first + int(np.argmax(departure))
