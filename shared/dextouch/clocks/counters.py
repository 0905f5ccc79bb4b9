"""Unwrapping of device counters, and detection of lost samples from sequence numbers."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Int64

from dextouch.errors import InvalidInputError, ShapeError

# Stamps coarser than this share of the sample period are less accurate than counting samples.
COARSE_SHARE = 0.25


class TickCounter:
    """Unwraps a counter whose ticks are not whole nanoseconds (48 MHz).

    Args:
        bits: width of the counter.
        ticks_per_s: its rate.
    """

    def __init__(self, bits: int, ticks_per_s: int) -> None:
        if not 8 <= bits <= 62 or ticks_per_s < 1:
            raise InvalidInputError(
                f"tick counter: got {bits} bits at {ticks_per_s} ticks a second, expected 8 … 62 "
                "bits and at least 1 tick a second"
            )
        self._modulus = 2**bits
        self._ticks_per_s = ticks_per_s
        self._last: tuple[int, int] | None = None

    def to_ns(self, count: int, t_host_ns: int) -> int:
        """Exact, unwrapped device time in ns of a count that arrived at a host time.

        Raises:
            InvalidInputError: a count outside the counter's range.
        """
        if not 0 <= count < self._modulus:
            raise InvalidInputError(
                f"tick counter: got a count of {count}, expected 0 … {self._modulus - 1}"
            )
        straight = count
        if self._last is not None:
            waited_ticks = (t_host_ns - self._last[1]) * self._ticks_per_s // 10**9
            straight = nearest_congruent(count, self._last[0] + waited_ticks, self._modulus)
        self._last = (straight, t_host_ns)
        return straight * 10**9 // self._ticks_per_s


def nearest_congruent(count: int, expected: int, modulus: int) -> int:
    """The number nearest to `expected` that is congruent to `count` modulo `modulus`."""
    half = modulus // 2
    return expected + (count - expected + half) % modulus - half


def prefers_sequence(tick_ns: int, period_ns: int) -> bool:
    """Whether stamps are so coarse that sequence numbers are the better clock."""
    return tick_ns > COARSE_SHARE * period_ns


@dataclass(frozen=True)
class SequenceReport:
    """Lost samples of a stream.

    `num_missing_before[i]` samples are missing between sample i-1 and i (0 for the first, at a
    duplicate and at a restart); `restart_indices` are samples whose number went back or stood.
    """

    num_missing_before: Int64[np.ndarray, " n"]
    restart_indices: Int64[np.ndarray, " r"]

    @property
    def num_missing(self) -> int:
        """Total number of lost samples."""
        return int(self.num_missing_before.sum())


def unwrap_counter(
    raw: np.ndarray, *, modulus: int, hint: np.ndarray | None = None
) -> Int64[np.ndarray, " n"]:
    """Unwrap a counter that wraps at `modulus`.

    Args:
        raw: integer counts [n], each in 0 … modulus - 1.
        modulus: count at which the counter starts again from zero, 2 … 2**62.
        hint: another clock in the same unit [n] (arrival times). It gives the number of wraps in a
            gap longer than a wrap; without it a step of more than half a modulus counts as one
            wrap, a smaller step back as a step back.

    Raises:
        ShapeError: not one axis of integers, or a hint of another length.
        InvalidInputError: a count outside 0 … modulus - 1, or an invalid modulus.
    """
    counts = np.asarray(raw)
    if counts.ndim != 1 or not np.issubdtype(counts.dtype, np.integer):
        raise ShapeError(f"counter: got {counts.dtype} {counts.shape}, expected integers [n]")
    if not 2 <= modulus <= 2**62:
        raise InvalidInputError(f"counter: got modulus {modulus}, expected 2 … 2**62")
    if counts.size and (int(counts.min()) < 0 or int(counts.max()) >= modulus):
        raise InvalidInputError(
            f"counter: got counts {counts.min()} … {counts.max()}, expected 0 … {modulus - 1}"
        )
    straight = counts.astype(np.int64)
    steps: Int64[np.ndarray, " m"] = np.diff(straight)
    expected = np.zeros_like(steps) if hint is None else np.diff(np.asarray(hint, dtype=np.int64))
    if expected.shape != steps.shape:
        raise ShapeError(f"counter: got {counts.size} counts and a hint of another length")
    half = modulus // 2
    # The congruent step nearest to the expected one.
    steps = expected + np.mod(steps - expected + half, modulus) - half
    return np.concatenate([straight[:1], straight[:1] + np.cumsum(steps)]).astype(np.int64)


def find_lost_samples(sequence: np.ndarray, *, bits: int = 64) -> SequenceReport:
    """Gaps and restarts in a stream's sequence numbers.

    Args:
        sequence: numbers [n] as the device sent them.
        bits: width of the device's counter, 8 … 64 (64 never wraps in practice).
    """
    if not 8 <= bits <= 64:
        raise InvalidInputError(f"sequence: got a counter of {bits} bits, expected 8 … 64")
    numbers = np.asarray(sequence, dtype=np.int64)
    straight = numbers if bits > 62 else unwrap_counter(numbers, modulus=2**bits)
    steps = np.diff(straight, prepend=straight[:1] - 1)
    return SequenceReport(np.maximum(steps - 1, 0), np.flatnonzero(steps <= 0).astype(np.int64))
