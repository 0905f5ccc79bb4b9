"""Distances of a device's stamps in; its sample period, where it keeps one, out."""

from statistics import fmean, median

LEARNED_DISTANCES = 32
# So many of the learned distances must be one period long; the others are lost samples.
MIN_REGULAR_SHARE = 0.75
NEAR_SHARE = 0.05
RATE = 0.01
# The stamps of a regular device are this near to its period in the mean.
MAX_SCATTER_S = 100e-6
ODD_S = 100e-6
ODD_SCATTERS = 5.0
# After so many odd distances in a row the period is learned again.
MAX_ODD = 8


class Rhythm:
    """How far apart a device's stamps are.

    A device that samples by a timer stamps at whole periods, lost samples or not. Only a jump of
    its clock, or a restart of the timer, makes a distance of two stamps odd.
    """

    def __init__(self) -> None:
        self._distances: list[float] = []
        self._period_s = 0.0
        self._scatter_s = 0.0
        self._num_odd = 0

    @property
    def period_s(self) -> float | None:
        """Distance of two samples by the device's clock; None while unknown, or irregular."""
        if self._period_s > 0.0 and self._scatter_s <= MAX_SCATTER_S:
            return self._period_s
        return None

    def is_odd(self, distance_s: float) -> bool:
        """Whether a regular device's distance is no whole number of periods."""
        period_s = self.period_s
        if period_s is None:
            return False
        num = max(1, round(distance_s / period_s))
        return abs(distance_s - num * period_s) > ODD_S + ODD_SCATTERS * self._scatter_s

    def is_kept(self, distance_s: float) -> bool:
        """Whether a distance is one period of a regular device: no jump, nothing lost."""
        period_s = self.period_s
        return (
            period_s is not None
            and round(distance_s / period_s) == 1
            and not self.is_odd(distance_s)
        )

    def add(self, distance_s: float) -> None:
        """Take in the next distance, of whatever sign."""
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
