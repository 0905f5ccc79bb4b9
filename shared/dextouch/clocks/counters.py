"""Conversion of a sample's wrapping stamps or sequence numbers to continuous device time."""

from typing import Literal

from dextouch.errors import InvalidInputError
from dextouch.streams import StreamDescriptor

ABSENT = -1
# Stamps coarser than this share of the sample period are less accurate than counting samples.
COARSE_SHARE = 0.25

Source = Literal["device", "sequence", "arrival"]


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


class DeviceCounter:
    """Continuous device time from stamps, or else from sequence numbers times the period.

    The first sample decides: stamps if present, unless they are coarser than a quarter of the
    period and samples are numbered.

    Args:
        descriptor: the stream's descriptor; needed for counters that wrap, for the resolution
            of stamps, and for streams that have only a sequence number.

    Attributes:
        source: of device time; None before the first sample.
        resolution_ns: device time is truncated to multiples of this.
    """

    def __init__(self, descriptor: StreamDescriptor | None) -> None:
        self._descriptor = descriptor
        self._period_ns = 0 if descriptor is None else descriptor.period_ns()
        self.resolution_ns = 0
        self._modulus_ns: int | None = None
        self._last: tuple[int, int] | None = None
        self.source: Source | None = None

    def straighten(
        self, t_host_ns: int, t_device_ns: int | None, sequence: int | None
    ) -> int | None:
        """Device time of one sample, in ns; None if the device provides no counter.

        Raises:
            InvalidInputError: a stamp or number that earlier samples had is missing.
        """
        t_device_ns = None if t_device_ns == ABSENT else t_device_ns
        sequence = None if sequence == ABSENT else sequence
        if self.source is None:
            self._choose(has_time=t_device_ns is not None, has_sequence=sequence is not None)
        if self.source == "arrival":
            return None
        if self.source == "device" and t_device_ns is not None:
            return self._unwrap(t_device_ns, t_host_ns)
        if self.source == "sequence" and sequence is not None:
            return self._unwrap(sequence * self._period_ns, t_host_ns)
        raise InvalidInputError(
            f"online clock: a sample at {t_host_ns} ns came without its {self.source} stamp, "
            "which earlier samples had; expected the same fields in every sample of a stream"
        )

    def _choose(self, *, has_time: bool, has_sequence: bool) -> None:
        if self._descriptor is None:
            self.source = "device" if has_time else "arrival"
            return
        device = self._descriptor.capabilities
        if has_time and not (has_sequence and prefers_sequence(device.tick_ns, self._period_ns)):
            self.source = "device"
            self.resolution_ns = device.tick_ns
            self._modulus_ns = _modulus(device.device_time_bits, device.tick_ns)
        elif has_sequence:
            self.source = "sequence"
            self._modulus_ns = _modulus(device.sequence_bits, self._period_ns)
        else:
            self.source = "arrival"

    def _unwrap(self, count_ns: int, t_host_ns: int) -> int:
        straight = count_ns
        if self._modulus_ns is not None and self._last is not None:
            expected_ns = self._last[0] + t_host_ns - self._last[1]
            straight = nearest_congruent(count_ns, expected_ns, self._modulus_ns)
        self._last = (straight, t_host_ns)
        return straight


def nearest_congruent(count: int, expected: int, modulus: int) -> int:
    """The number nearest to `expected` that is congruent to `count` modulo `modulus`."""
    half = modulus // 2
    return expected + (count - expected + half) % modulus - half


def prefers_sequence(tick_ns: int, period_ns: int) -> bool:
    """Whether stamps are so coarse that sequence numbers are the better clock."""
    return tick_ns > COARSE_SHARE * period_ns


def _modulus(bits: int, unit_ns: int) -> int | None:
    """Period of the counter's wraparound in ns; None if it never wraps."""
    return None if bits > 62 else 2**bits * unit_ns
