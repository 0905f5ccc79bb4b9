"""Sample period of a device, learned from the distances of its stamps."""

from statistics import fmean, median

LEARNED_DISTANCES = 32
# Minimum share of distances that are one period long; the others are lost samples.
MIN_REGULAR_SHARE = 0.75
NEAR_SHARE = 0.05
RATE = 0.01
# Maximum mean deviation from the period for a regular device.
MAX_SCATTER_S = 100e-6
ODD_S = 100e-6
ODD_SCATTERS = 5.0
# After this many irregular distances in a row, the period is learned again.
MAX_ODD = 8


class Rhythm:
    """Regularity of a device's stamps.

    The stamps of a timer-driven device are whole periods apart, even with lost samples. Only a jump
    of its clock, or a restart of the timer, gives an irregular distance.
    """

    def __init__(self) -> None:
        self._distances: list[float] = []
        self._period_s = 0.0
        self._scatter_s = 0.0
        self._num_odd = 0

    @property
    def period_s(self) -> float | None:
        """Sample period by the device's clock; None while unknown or irregular."""
        if self._period_s > 0.0 and self._scatter_s <= MAX_SCATTER_S:
            return self._period_s
        return None

    def is_odd(self, distance_s: float) -> bool:
        """Whether a distance is not a whole number of periods of a regular device."""
        period_s = self.period_s
        if period_s is None:
            return False
        num = max(1, round(distance_s / period_s))
        return abs(distance_s - num * period_s) > ODD_S + ODD_SCATTERS * self._scatter_s

    def is_kept(self, distance_s: float) -> bool:
        """Whether a distance is exactly one period of a regular device: no jump, no loss."""
        period_s = self.period_s
        return (
            period_s is not None
            and round(distance_s / period_s) == 1
            and not self.is_odd(distance_s)
        )

    def add(self, distance_s: float) -> None:
        """Add the next distance, of either sign."""
        if self._period_s <= 0.0:
            self._learn(distance_s)
            return
        departure_s = distance_s - self._period_s
        if abs(departure_s) <= NEAR_SHARE * self._period_s:
            self._num_odd = 0
            self._period_s += RATE * departure_s
            self._scatter_s += RATE * (abs(departure_s) - self._scatter_s)
            return
        self._num_odd += 1
        if self._num_odd > MAX_ODD:
            self._period_s = 0.0

    def _learn(self, distance_s: float) -> None:
        self._distances.append(distance_s)
        if len(self._distances) < LEARNED_DISTANCES:
            return
        distances, self._distances = self._distances, []
        period_s = median(distances)
        near = [abs(d - period_s) for d in distances if abs(d - period_s) <= NEAR_SHARE * period_s]
        if len(near) >= MIN_REGULAR_SHARE * LEARNED_DISTANCES:
            self._period_s, self._scatter_s, self._num_odd = period_s, fmean(near), 0
