"""Clock of a steady device without stamps: counts samples, detects losses by looking ahead.

The clock of such a device is its sample count. Whether a sample is late, or the one before it was
lost, is decided from the following samples: the promptest of the next ten has hardly been delayed.
"""

from collections import deque
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from jaxtyping import Int64

from dextouch.clocks.online_clock import COUNTED_SLOPE_SPAN_S
from dextouch.clocks.running_envelope import RunningEnvelope
from dextouch.errors import InvalidInputError

LOOK_AHEAD = 10
# A sample counts as lost where everything behind is later by nearly a period: delays are common,
# losses are rare.
LOST_SHARE = 0.75
# While a queue drains, the look-ahead may be extended by this factor.
MAX_WAIT = 6
# A device whose samples are counted must be a steady one. Beyond these its nominal rate is wrong
# or it samples when it likes, and its arrivals say more.
MAX_STEADY_SKEW_PPM = 20_000.0
MAX_STEADY_LOSS = 0.1
MAX_STEPS_PER_SAMPLE = 0.001


class CountedSample(NamedTuple):
    """A counted sample.

    Attributes:
        number: inferred sample number, 0 for the first.
        t_host_ns: time at which it left the device, on the host's clock.
    """

    number: int
    t_host_ns: int


class CountingClock:
    """Estimates the times of samples of a steady device without stamps and sequence numbers.

    Times are available ten samples later, or once a queue has drained.

    Args:
        period_ns: nominal sample period, accurate within a few percent.

    Attributes:
        num_lost: lost samples, up to the last final time.
    """

    def __init__(self, period_ns: int) -> None:
        if period_ns < 1:
            raise InvalidInputError(
                f"counting clock: got a period of {period_ns} ns, expected at least 1"
            )
        self._period_ns = period_ns
        self._waiting: deque[int] = deque()
        self._envelope = RunningEnvelope(min_slope_span_s=COUNTED_SLOPE_SPAN_S, is_counted=True)
        self._start_ns: int | None = None
        self._index = -1
        self.num_lost = 0
        self._last_final_ns: int | None = None

    @property
    def num_steps(self) -> int:
        """Number of device restarts and of corrected miscounts."""
        return self._envelope.num_steps

    @property
    def skew_ppm(self) -> float:
        """Relative excess of the sample period over the nominal one, in ppm."""
        return self._envelope.slope_ns_per_s * 1e-3

    @property
    def is_steady(self) -> bool:
        """Whether the device is so steady that counting is more accurate than arrival times."""
        num_arrived = self._index + 1 - self.num_lost
        return (
            abs(self.skew_ppm) <= MAX_STEADY_SKEW_PPM
            and self.num_lost <= MAX_STEADY_LOSS * num_arrived
            and self.num_steps <= MAX_STEPS_PER_SAMPLE * num_arrived
        )

    def advance(self, t_host_ns: int) -> tuple[CountedSample, ...]:
        """Add one arrival on the host's monotonic clock; returns the samples decided by it.

        Raises:
            InvalidInputError: it precedes the last arrival.
        """
        if self._waiting and t_host_ns < self._waiting[-1]:
            raise InvalidInputError(
                f"counting clock: got an arrival at {t_host_ns} ns after one at "
                f"{self._waiting[-1]} ns, expected the order of arrival"
            )
        if self._start_ns is None:
            self._start_ns = t_host_ns
        self._waiting.append(t_host_ns)
        final: list[CountedSample] = []
        while len(self._waiting) > LOOK_AHEAD and (sample := self._decide()) is not None:
            final.append(sample)
        return tuple(final)

    def flush(self) -> tuple[CountedSample, ...]:
        """Final times of the pending samples, with less than the full look-ahead."""
        decided = (self._decide(is_last_chance=True) for _ in range(len(self._waiting)))
        return tuple(sample for sample in decided if sample is not None)

    def _lateness_ns(self, count: int) -> list[float]:
        """Delay of the first pending samples if none were lost."""
        start_ns = self._start_ns if self._start_ns is not None else 0
        period_ns = self._period_ns * (1 + self._envelope.slope_ns_per_s * 1e-9)
        x_ns = (self._index + 1) * self._period_ns
        origin_ns = start_ns + x_ns + round(self._envelope.at(x_ns * 1e-9))
        return [self._waiting[k] - origin_ns - k * period_ns for k in range(count)]

    def _num_lost_before(self, *, is_last_chance: bool) -> int | None:
        """Number of samples lost before the oldest pending one; None while undecided."""
        if self._index < 0:
            return 0
        threshold_ns = LOST_SHARE * self._period_ns
        if self._lateness_ns(1)[0] < threshold_ns:
            return 0
        late_ns = self._lateness_ns(len(self._waiting))
        least_ns = min(late_ns)
        if least_ns < threshold_ns:
            return 0
        # A queue that is still draining: the following samples are delayed less.
        draining = late_ns[-1] <= least_ns
        if draining and not is_last_chance and len(late_ns) < MAX_WAIT * LOOK_AHEAD:
            return None
        return int(least_ns / self._period_ns + 1.0 - LOST_SHARE)

    def _decide(self, *, is_last_chance: bool = False) -> CountedSample | None:
        num_lost = self._num_lost_before(is_last_chance=is_last_chance)
        if num_lost is None or self._start_ns is None:
            return None
        self.num_lost += num_lost
        self._index += 1 + num_lost
        since_ns = self._waiting.popleft() - self._start_ns
        x_ns = self._index * self._period_ns
        offset_ns = self._envelope.add(x_ns * 1e-9, float(since_ns - x_ns), since_ns * 1e-9)
        final_ns = self._start_ns + x_ns + round(offset_ns)
        if self._last_final_ns is not None:
            final_ns = max(final_ns, self._last_final_ns + 1)
        self._last_final_ns = final_ns
        return CountedSample(self._index, final_ns)


@dataclass(frozen=True)
class CountedTake:
    """Estimated times of a whole take without stamps.

    Attributes:
        number: inferred sample numbers, 0 for the first.
        t_host_ns: times at which samples left the device, on the host's clock, strictly increasing.
        skew_ppm: relative excess of the sample period over the nominal one, at the end.
        num_lost: number of lost samples.
        num_steps: number of device restarts and of corrected miscounts.
        is_steady: whether these times are more accurate than the arrivals.
    """

    number: Int64[np.ndarray, " n"]
    t_host_ns: Int64[np.ndarray, " n"]
    skew_ppm: float
    num_lost: int
    num_steps: int
    is_steady: bool


def date_by_counting(t_host_ns: np.ndarray, *, period_ns: int) -> CountedTake:
    """Estimate the sample times of a steady device from its arrivals alone.

    Args:
        t_host_ns: arrivals [n] in order, int64.
        period_ns: nominal sample period, accurate within a few percent.

    Raises:
        InvalidInputError: arrivals out of order.
    """
    clock = CountingClock(period_ns)
    counted: list[CountedSample] = []
    for arrival_ns in np.asarray(t_host_ns, dtype=np.int64).tolist():
        counted.extend(clock.advance(arrival_ns))
    counted.extend(clock.flush())
    return CountedTake(
        number=np.array([sample.number for sample in counted], dtype=np.int64),
        t_host_ns=np.array([sample.t_host_ns for sample in counted], dtype=np.int64),
        skew_ppm=clock.skew_ppm,
        num_lost=clock.num_lost,
        num_steps=clock.num_steps,
        is_steady=clock.is_steady,
    )
